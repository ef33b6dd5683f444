"""Plan how a depth map is upsampled to a photo's size, and estimate the memory and time that it takes.

Facets and filters take any ratio of the sizes. Other networks are trained for fixed factors. A low-resolution depth map
is not resized: the photo is resized to a multiple of its size, and the network's result to the photo's size
(:mod:`dsr.geometry.resampling`).
RMSE_v and RMSE_d in mm of ``facets_box`` on Lucy and Plant, box averages at the given ratio, means of both scenes:

| ratio | photo resized, x4 | x8 | depth resized instead, x4 | x8 | cubic spline |
| --- | --- | --- | --- | --- | --- |
| 2 | 0.103, 20 | | 0.155, 80 | 0.185, 79 | 0.218, 35 |
| 3 | 0.119, 25 | | | | 0.245, 45 |
| 5 | 0.148, 45 | 0.140, 30 | | | 0.278, 62 |
| 6 | 0.162, 51 | 0.151, 33 | 0.251, 93 | 0.191, 75 | 0.294, 69 |
| 7.5 | | 0.163, 37 | | | 0.305, 71 |

The factor is therefore the smallest that reaches the photo's size. Larger ratios than 8 take two steps, x8 and then x4
on the result averaged to a quarter of the photo's size: at ratio 16 RMSE_v is 0.215, against 0.222 for x8 with the
result enlarged by 2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dsr.degradation.scales import SCALES
from dsr.inference.options import DEFAULT, USUAL_SCALE
from dsr.methods.base import Cost
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.networks.base import TILE, UNTILED
from dsr.methods.networks.peers.build import PEERS, build_peer
from dsr.methods.networks.peers.files import nearest_scale
from dsr.methods.networks.trained import build_trained
from dsr.methods.registry import SLACK, find_weights, has_weights, read_method
from dsr.utils.builder import load_target, takes, trait

LARGEST_OPTIMISED = 2**20
"""Pixels; optimising a network for a larger picture takes hours."""
OWN_SIZE = 1.25
"""A depth map whose sides differ from the photo's by no more than this factor is treated as having the photo's size."""
_ASPECT = 0.02
_UNKNOWN_COST = Cost(1000, 0)
"""The cost of a method that states none."""


@dataclass(frozen=True)
class Ability:
    """What a method can do.

    Args:
        kind: ``interpolation`` gives any size; a ``network`` has fixed factors and may be applied twice; any other
            method takes a ``sample``.
        steps: for each factor, the factors of the calls that give it; empty for any factor in one call.
        optimises: whether it optimises a network for each picture.
        cost: the method's rough cost; None if it states none.
        own_resolution: whether it takes a depth map of the photo's own size as it is.
        factors: those at which a method of any ratio computes, by names of weights, if it has only some.

    """

    kind: Literal["interpolation", "network", "sample"]
    steps: Mapping[int, tuple[int, ...]]
    optimises: bool = False
    cost: Cost | None = None
    own_resolution: bool = False
    factors: Mapping[str, float] = field(default_factory=dict)

    @property
    def single_steps(self) -> list[int]:
        """The factors of single calls, which the method is built for; empty for one that takes any."""
        return sorted({step for steps in self.steps.values() for step in steps})


@dataclass(frozen=True)
class Plan:
    """How a depth map is upsampled.

    Args:
        method: the method.
        scale: the approximate upsampling factor.
        steps: the networks' factors, one after the other; empty for interpolation.
        coarsened: the factor by which depth of the photo's own size is downsampled first; 1 for low-resolution depth.
        way: the sizes and the method in one line.
        text: the same and the memory that it takes.

    """

    method: str
    scale: int
    steps: tuple[int, ...]
    coarsened: int
    way: str
    text: str


def read_ability(method: str, directories: Sequence[Path] = (), settings: Mapping[str, Any] | None = None) -> Ability:
    """Read what a method of the registry can do.

    Args:
        method: its name.
        directories: the user's configuration directories.
        settings: its arguments that differ from its file, by name.

    Raises:
        ValueError: there is no such method, or one of fixed factors has no weights for any.

    """
    node = read_method(method, USUAL_SCALE, settings, directories)
    target = load_target("method", node)
    if target is Interpolation:
        return Ability("interpolation", {})
    optimises, cost = bool(trait("method", node, "optimises")), trait("method", node, "cost")
    if trait("method", node, "own_resolution"):
        packaged = node.get("weights_packaged")
        computed = packaged if isinstance(packaged, Mapping) else {}
        return Ability("sample", {}, optimises, cost, own_resolution=True, factors=computed)
    factors: tuple[int, ...] = SCALES
    if takes("method", node, "weights"):
        nodes = {scale: read_method(method, scale, settings, directories) for scale in SCALES}
        factors = tuple(scale for scale in SCALES if has_weights(nodes[scale], scale))
        if not factors:
            find_weights(node, USUAL_SCALE)  # its error says where to get them
            raise ValueError(f"method={method}: expected weights that it names, or that come with dsr; there are none")
    steps: dict[int, tuple[int, ...]] = {factor: (factor,) for factor in factors}
    if target is build_trained:
        return Ability("network", _with_second_step(steps))
    cost = PEERS[node["peer"]].cost if target is build_peer else cost
    return Ability("sample", steps, optimises, cost)


def _with_second_step(steps: dict[int, tuple[int, ...]]) -> dict[int, tuple[int, ...]]:
    """Return a network's steps with those of the factors that it reaches by a second step of 4."""
    if 4 not in steps:
        return steps
    second = {16: (8, 4), 32: (8, 4)} if 8 in steps else {16: (4, 4)}
    return second | steps if 16 not in steps else steps


def plan(
    photo_size: tuple[int, int],
    depth_size: tuple[int, int],
    scale: int | None = None,
    method: str = DEFAULT,
    directories: Sequence[Path] = (),
    settings: Mapping[str, Any] | None = None,
) -> Plan:
    """Plan what :func:`dsr.inference.upsample_depth` does.

    This plan does not apply to a depth map of the photo's size that was enlarged by repeating pixels: it is upsampled
    from the low-resolution map that it was before.

    Args:
        photo_size: height and width.
        depth_size: height and width.
        scale: the factor; None to choose it by the sizes, 4 if they are equal.
        method: its name in the registry.
        directories: the user's configuration directories.
        settings: the method's arguments that differ from its file, by name.

    Raises:
        ValueError: no such method, a scale that it has no weights for, or sizes that do not fit together.

    """
    ability = read_ability(method, directories, settings)
    ratio = _ratio(photo_size, depth_size)
    as_it_is = ratio <= OWN_SIZE and ability.own_resolution and scale in (None, 1)
    own = ratio <= OWN_SIZE and not as_it_is
    chosen = 1 if as_it_is else _scale(scale, USUAL_SCALE if own else ratio, method, ability)
    steps = ability.steps.get(chosen, ())
    pixels = math.prod(photo_size)
    if ability.optimises and pixels > LARGEST_OPTIMISED:
        raise ValueError(
            f"method={method}: expected a photo of up to {LARGEST_OPTIMISED} pixels, as it is optimised for each "
            f"picture, got {photo_size[0]} x {photo_size[1]}; method={DEFAULT} takes any"
        )
    coarsened = chosen if own else 1
    before = f"averaged over {chosen} x {chosen} pixels, " if own else ""
    what = f"{method} x{chosen}" + (
        f" in two steps ({', '.join(f'x{step}' for step in steps)})" if len(steps) > 1 else ""
    )
    worked_on = _worked_on(photo_size, depth_size, steps, coarsened)
    if ability.factors and not as_it_is:
        worked_on = round(math.prod(depth_size) * nearest_scale(ability.factors, chosen) ** 2)
    way = f"{depth_size[0]} x {depth_size[1]} depth {before}to {photo_size[0]} x {photo_size[1]} by {what}"
    text = f"{way}, in about {_memory(pixels, worked_on, ability) / 2**30:.1f} GB of memory"
    if ability.cost is not None:
        text += f" and {_duration(ability.cost.seconds * worked_on / 1e6)} on two CPU cores"
    return Plan(method, chosen, steps, coarsened, way, text)


def _ratio(photo_size: tuple[int, int], depth_size: tuple[int, int]) -> float:
    """Return how much larger the photo is than the depth map."""
    if min(*photo_size, *depth_size) < 1:
        raise ValueError(f"sizes: expected positive ones, got a photo of {photo_size} and depth of {depth_size}")
    down, across = (photo / depth for photo, depth in zip(photo_size, depth_size, strict=True))
    sizes = f"{depth_size[0]} x {depth_size[1]} for a photo of {photo_size[0]} x {photo_size[1]} (height x width)"
    if abs(down / across - 1) > max(_ASPECT, 1 / min(depth_size)):
        raise ValueError(f"depth: expected the photo's field of view and aspect within {_ASPECT:.0%}, got {sizes}")
    ratio = max(down, across)
    if ratio < 1 / OWN_SIZE:
        raise ValueError(f"depth: expected no more pixels than the photo, got {sizes}")
    return ratio


def _scale(requested: int | None, ratio: float, method: str, ability: Ability) -> int:
    """Return the requested factor, or the smallest that reaches the photo's size."""
    factors = ability.steps
    if not factors:
        if requested is not None and requested < 1:
            raise ValueError(f"scale: expected a positive whole number, got {requested}")
        return requested or math.ceil(ratio / SLACK - 1e-9)
    if requested is not None and requested not in factors:
        raise ValueError(f"scale: expected one of {', '.join(map(str, sorted(factors)))} for {method}, got {requested}")
    enough = [scale for scale in sorted(factors) if ratio <= SLACK * scale]
    if requested is None and not enough:
        raise ValueError(
            f"depth: expected at least 1/{max(factors)} of the photo's size for {method}, got 1/{ratio:.3g}"
        )
    return requested or enough[0]


def _worked_on(photo_size: tuple[int, int], depth_size: tuple[int, int], steps: tuple[int, ...], coarsened: int) -> int:
    """Return the number of pixels of the largest picture that a network computes."""
    if not steps or coarsened > 1:
        return math.prod(photo_size)
    first = math.prod(depth_size) * steps[0] ** 2
    return max(first, math.prod(photo_size)) if len(steps) > 1 else first


def _memory(pixels: int, worked_on: int, ability: Ability) -> float:
    """Estimate the memory in bytes, including the program's own 0.4 GB, or 0.6 GB if it trains."""
    if ability.kind == "interpolation":
        return 4e8 + 100 * pixels
    if ability.kind == "sample":
        cost = ability.cost or _UNKNOWN_COST
        return (6e8 if ability.optimises else 4e8) + cost.memory * worked_on
    window = worked_on if worked_on <= UNTILED else (TILE + 160) ** 2
    return 4e8 + 40 * pixels + 40 * worked_on + 700 * window


def _duration(seconds: float) -> str:
    """Return a rough time for a reader."""
    return f"about {max(seconds, 1):.0f} s" if seconds < 90 else f"about {seconds / 60:.0f} min"
