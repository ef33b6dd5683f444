"""Facets: guided super-resolution by a mixture of planes, dsr's own network.

Renderings are most sensitive to errors of normals on smooth surfaces, where convolutions that predict disparity pixel
by pixel leave a faint texture. The disparity of a plane is linear in the pixel, so this network predicts planes
instead. Each low-resolution pixel proposes a few planes ("facets"), built from the differences to its neighbours. Each
high-resolution pixel mixes the planes of the 3 x 3 low-resolution pixels around it, extended to its position, with
weights predicted from the colour image; at an edge the network switches from one plane to another. Three properties
hold for any weights: planes are reproduced exactly, the network commutes with an affine map of the disparity, and the
result does not overshoot the extended planes.

The planes of a low-resolution pixel differ from the differences that they are built from by at most a multiple of the
local *bend* (the largest second difference around it). The bend is 0 on planes, and large beside a depth step, where
the low-resolution value mixes both sides.

A network of planes takes over what it can from a trained one: from Facets, or from itself for another factor.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.networks.facets_layers import (
    HEAD,
    Residual,
    enlarge_and_join,
    make_pyramid,
    mean_colour,
    photo_input,
    scale_down,
    silence,
)
from dsr.methods.networks.facets_planes import NEIGHBOURS, Stencil, mix_planes, stencil
from dsr.methods.networks.network import DisparityNetwork, NormalisedNetwork

# differences of normalised disparity that become about 1 in the network's compressed and linear inputs
_FAINT, _STRONG = 1e-3, 0.25
_RARE = -5.0  # logit of what is added to the choices of Facets
_WIDENED = ("photo.weight", "coarse.weight")  # may have more inputs, after those of the other network


class Facets(NormalisedNetwork):
    """The network.

    Args:
        scale: upsampling factor, 2, 4, 8 or 16.
        width: channels at the low resolution.
        blocks: residual blocks there.
        facets: number of planes that each low-resolution pixel proposes.
        slopes: whether planes have slopes; if not, each is a constant, and the network predicts an interpolation kernel
            for each pixel (an ablation).

    """

    def __init__(self, scale: int, width: int = 96, blocks: int = 6, facets: int = 2, *, slopes: bool = True) -> None:
        super().__init__()
        check_scale(scale)
        if min(width, facets) < 1 or blocks < 0:
            raise ValueError(
                f"model: expected width and facets of at least 1, blocks of at least 0; got {width}, {facets}, {blocks}"
            )
        self.scale, self.width, self.blocks, self.facets, self.slopes = scale, width, blocks, facets, slopes
        # of each residual block 2; 1 of the neighbours' planes, 3 convolutions, 2 of the differences
        self.receptive_field_radius = 2 * blocks + 6
        levels = scale.bit_length() - 1
        self.photo, self.down, up, join = make_pyramid(levels, width)
        self.coarse = nn.Conv2d(10, width, 3, padding=1)
        self.trunk = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.planes = scale_down(nn.Conv2d(width, 3 * facets + 6, 3, padding=1))
        self.up, self.join = up, join
        self.choice = scale_down(nn.Conv2d(HEAD, NEIGHBOURS * facets, 3, padding=1))

    def context(self, rgb: Tensor, disparity: Tensor) -> tuple[Tensor | None, ...]:
        """Return the range and the mean colour of the image, (B, 3, 1, 1)."""
        return (*super().context(rgb, disparity), mean_colour(rgb))

    def forward(self, rgb: Tensor, values: Tensor, mean: Tensor | None = None) -> Tensor:
        """Return normalised disparity; ``mean`` is the mean colour of the image that ``rgb`` is a window of."""
        around = stencil(values)
        dtype = self.photo.weight.dtype
        pyramid = [functional.relu(self.photo(photo_input(rgb, mean).to(dtype)), inplace=True)]
        for layer in self.down:
            pyramid.append(functional.relu(layer(pyramid[-1]), inplace=True))
        x = self.trunk(functional.relu(pyramid[-1] + self.coarse(_lr_input(around).to(dtype))))
        planes = self._propose_planes(self.planes(x), around)
        for up, join, features in zip(self.up, self.join, reversed(pyramid[:-1]), strict=True):
            x = functional.relu(enlarge_and_join(up, join, x, features), inplace=True)
        return mix_planes(planes, self.choice(x), self.scale)[0]

    def _propose_planes(self, output: Tensor, around: Stencil) -> Tensor:
        """Return the planes of each low-resolution pixel, (B, facets, 3, h, w): value at its centre and slopes."""
        output = output.to(torch.promote_types(around.value.dtype, torch.float32))
        batch, _, height, width = output.shape
        moves, picks = output.split((3 * self.facets, 6), dim=1)
        picks = picks.unflatten(1, (2, 3))
        first = picks.new_tensor([0.0, 2.0, 0.0])[:, None, None]  # mostly the central difference at first
        picks = (picks + first).softmax(dim=2)
        slopes = (picks * around.slopes).sum(dim=2)  # (B, 2, h, w)
        base = torch.cat((around.value, slopes), dim=1)[:, None]
        planes = base + moves.view(batch, self.facets, 3, height, width) * around.bend[:, None]
        return planes if self.slopes else torch.cat((planes[:, :, :1], torch.zeros_like(planes[:, :, 1:])), dim=2)


def _lr_input(around: Stencil) -> Tensor:
    """Return (B, 10, h, w): differences compressed so that small ones count, linear differences, and directions."""
    differences = torch.cat((around.value - around.mean, around.slopes[:, :, 1], around.bend), dim=1).float()
    turns = around.turns.float() / around.bend.float().clamp(min=torch.finfo(torch.float32).tiny)
    return torch.cat((torch.asinh(differences / _FAINT) / 3, differences / _STRONG, turns), dim=1)


def start_from_facets(net: DisparityNetwork, first: Facets, levels: int) -> None:
    """Take over the weights of Facets for the same or another factor; both sets of a block's weights start as its own.

    ``net`` is a :class:`~dsr.methods.networks.facets_unet.FacetsUNet`, changed in place, ``levels`` the number of
    smoothed copies of the map, whose values and slopes it offers beside the map's own.
    """
    theirs = dict(first.state_dict())
    planes = {name: theirs.pop(name) for name in ("planes.weight", "planes.bias")}
    finer = _levels(net) - _levels(first)
    taken = []
    for name, value in theirs.items():
        if name.startswith("trunk."):
            number, rest = name.removeprefix("trunk.").split(".", 1)
            taken += [(f"trunk.{number}.ways.{way}.{rest}", value) for way in range(2)]
        else:
            taken.append((_shift(name, finer), value))
    _copy(net, taken)
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

    Both are a :class:`~dsr.methods.networks.facets_unet.FacetsUNet` with the same width, blocks and facets.
    """
    theirs, finer = first.state_dict(), _levels(net) - _levels(first)
    own = net.state_dict()  # the channels of the U-net, ``wide``, may differ
    whole = all(own[name].shape == value.shape for name, value in theirs.items() if name.startswith("wide."))
    taken = {name: value for name, value in theirs.items() if whole or not name.startswith("wide.")}
    _copy(net, [(_shift(name, finer), value) for name, value in taken.items()])
    layers = {name: list(net.get_submodule(name).children()) for name in ("down", "up", "join")}
    for level in range(finer):
        weight: Tensor = silence(layers["down"][-1 - level]).get_parameter("weight")
        for channel in range(min(weight.shape[:2])):  # means of 2 x 2 pixels
            weight[channel, channel, 1:3, 1:3] = 0.25
        weight = silence(layers["up"][level]).get_parameter("weight")
        for channel in range(min(weight.shape[0] // 4, weight.shape[1])):  # each pixel four times
            weight[4 * channel : 4 * channel + 4, channel] = 1
        join = layers["join"][level]
        for parameter in join.parameters():
            parameter.mul_(0.1)
        weight = join.get_parameter("weight")
        for channel in range(min(weight.shape[:2])):  # and little else
            weight[channel, channel, 1, 1] += 1


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


def _shift(name: str, steps: int) -> str:
    """Return a parameter's name at another factor, where the layers towards the full resolution have other numbers."""
    kind, number, *rest = name.split(".")
    return ".".join((kind, str(int(number) + steps), *rest)) if kind in ("up", "join") else name
