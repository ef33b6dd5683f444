"""What a network of planes takes over from a trained one: from Facets, or from itself for another factor."""

from __future__ import annotations

from torch import Tensor, nn

from dsr.methods.networks.base import DisparityNetwork
from dsr.methods.networks.facets import Facets
from dsr.methods.networks.facets_layers import silence

_RARE = -5.0
"""Logit of what is added to the choices of Facets."""
_WIDENED = ("photo.weight", "coarse.weight")
"""Layers that may have more inputs, after those of the other network."""


def start_from_facets(net: DisparityNetwork, first: Facets, levels: int) -> None:
    """Take over the weights of Facets for the same or another factor; both sets of a block's weights start as its own.

    Args:
        net: a :class:`~dsr.methods.networks.facets_unet.FacetsUNet`, changed in place.
        first: the trained network.
        levels: smoothed copies of the map, whose values and slopes ``net`` offers beside the map's own.

    """
    theirs = dict(first.state_dict())
    planes = {name: theirs.pop(name) for name in ("planes.weight", "planes.bias")}
    finer = _levels(net) - _levels(first)
    _copy(net, [(each, value) for name, value in theirs.items() for each in _ways(_shift(name, finer))])
    own = net.state_dict()
    for name, value in planes.items():
        moves, picks = value.split((3 * first.facets, 6))
        new = own[name].unflatten(0, (first.facets, -1)).zero_()
        new[:, -3:] = moves.unflatten(0, (first.facets, 3))
        slopes = new[:, 1 + levels : -3].unflatten(1, (2, -1))
        slopes[:, :, :3] = picks.unflatten(0, (2, 3))
        if name.endswith("bias"):
            new[:, 1 : 1 + levels] = _RARE
            slopes[:, :, 3:] = _RARE


def start_from_another_factor(net: DisparityNetwork, first: DisparityNetwork) -> None:
    """Take over the weights for a factor: layers between resolutions that it has not begin as means and repetitions.

    Args:
        net: a :class:`~dsr.methods.networks.facets_unet.FacetsUNet`, changed in place.
        first: another one with the same width, blocks and facets.

    """
    theirs, finer = first.state_dict(), _levels(net) - _levels(first)
    whole = all(net.state_dict()[name].shape == value.shape for name, value in theirs.items() if _wide(name))
    _copy(net, [(_shift(name, finer), value) for name, value in theirs.items() if whole or not _wide(name)])
    down, up, join = (net.get_submodule(name) for name in ("down", "up", "join"))
    for level in range(finer):
        _average_pairs(list(down.children())[-1 - level])
        _repeat_pairs(list(up.children())[level], list(join.children())[level])


def _copy(net: DisparityNetwork, named: list[tuple[str, Tensor]]) -> None:
    """Copy weights of the same shape, and into layers that have more inputs, which count nothing at first."""
    own = net.state_dict()
    for name, value in named:
        if name not in own:
            continue
        if own[name].shape == value.shape:
            own[name].copy_(value)
        elif name in _WIDENED and own[name].shape[1] > value.shape[1]:
            own[name].zero_()[:, : value.shape[1]] = value


def _levels(net: DisparityNetwork) -> int:
    """Return how many times the photo's resolution is halved."""
    return len(list(net.get_submodule("up").children()))


def _wide(name: str) -> bool:
    """Return whether a parameter is one of the U-net, whose channels are an argument."""
    return name.startswith("wide.")


def _shift(name: str, steps: int) -> str:
    """Return a parameter's name at another factor, where the layers towards the full resolution have other numbers."""
    kind, number, *rest = name.split(".")
    return ".".join((kind, str(int(number) + steps), *rest)) if kind in ("up", "join") else name


def _ways(name: str) -> list[str]:
    """Return the names that a parameter of Facets has in both sets of a block's weights; its own elsewhere."""
    kind, _, rest = name.partition(".")
    if kind != "trunk":
        return [name]
    number, _, rest = rest.partition(".")
    return [f"trunk.{number}.ways.{way}.{rest}" for way in range(2)]


def _average_pairs(down: nn.Module) -> None:
    """Make a convolution that halves the resolution return the means of 2 x 2 pixels."""
    weight: Tensor = silence(down).get_parameter("weight")
    for channel in range(min(weight.shape[:2])):
        weight[channel, channel, 1:3, 1:3] = 0.25


def _repeat_pairs(up: nn.Module, join: nn.Module) -> None:
    """Make convolutions that double the resolution return each pixel four times, and little else."""
    weight: Tensor = silence(up).get_parameter("weight")
    for channel in range(min(weight.shape[0] // 4, weight.shape[1])):
        weight[4 * channel : 4 * channel + 4, channel] = 1
    for parameter in join.parameters():
        parameter.mul_(0.1)
    weight = join.get_parameter("weight")
    for channel in range(min(weight.shape[:2])):
        weight[channel, channel, 1, 1] += 1
