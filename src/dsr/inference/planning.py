"""What is going to be done with a photo and a depth map of given sizes, and what it costs.

Networks are trained for fixed factors. A low-resolution depth map stays as it is: the photo is resized to a multiple of
its size, the network answers at that size, and the answer is resized to the photo (:mod:`dsr.inference.resampling`).
RMSE_v and RMSE_d in mm of Facets on Lucy and Plant, box averages at the ratio given, means of both scenes:

| ratio | so, x4 | so, x8 | depth resized instead, x4 | x8 | cubic spline |
| --- | --- | --- | --- | --- | --- |
| 2 | 0.103, 20 | | 0.155, 80 | 0.185, 79 | 0.218, 35 |
| 3 | 0.119, 25 | | | | 0.245, 45 |
| 5 | 0.148, 45 | 0.140, 30 | | | 0.278, 62 |
| 6 | 0.162, 51 | 0.151, 33 | 0.251, 93 | 0.191, 75 | 0.294, 69 |
| 7.5 | | 0.163, 37 | | | 0.305, 71 |

So the factor is the smallest that reaches the photo. Beyond x8 there are two steps, x8 and then x4 on the answer,
averaged to a quarter of the photo: at ratio 16 RMSE_v is 0.215, against 0.222 of x8 and an answer enlarged twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dsr.degradation.scales import SCALES
from dsr.methods.base import Cost
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.networks.base import TILE, UNTILED
from dsr.methods.networks.trained import build_trained
from dsr.methods.registry import has_weights, read_method
from dsr.utils.builder import load_target, takes, trait

AUTO = "auto"
LARGEST_OPTIMISED = 2**20
"""Pixels; the optimisation of a network for a larger picture takes hours."""
OWN_SIZE = 1.25
"""A depth map whose sides differ from the photo's by no more than this factor counts as one of the photo's size."""
USUAL_SCALE = 4
_ASPECT = 0.02
_SLACK = 1.05
_UNKNOWN_COST = Cost(1000, 0)
"""Of a method that states none."""


@dataclass(frozen=True)
class Ability:
    """What a method can do.

    Args:
        kind: ``interpolation`` gives any size; a ``network`` has factors and may follow itself; any other method
            answers a ``sample``.
        steps: for each factor, those of the calls that lead to it; empty for any factor in one call.
        optimises: whether it optimises a network for each picture.
        cost: rough, where the method states it.

    """

    kind: Literal["interpolation", "network", "sample"]
    steps: Mapping[int, tuple[int, ...]]
    optimises: bool = False
    cost: Cost | None = None


@dataclass(frozen=True)
class Plan:
    """What is going to be done.

    Args:
        method: the method.
        scale: by how much finer depth becomes, about.
        steps: the networks' factors, one after the other; empty for interpolation.
        coarsened: by how much depth of the photo's own size is made coarser first; 1 for low-resolution depth.
        text: this, and the memory that it takes, in one line.

    """

    method: str
    scale: int
    steps: tuple[int, ...]
    coarsened: int
    text: str


def read_ability(method: str, directories: Sequence[Path] = ()) -> Ability:
    """Return what a method of the registry can do.

    Args:
        method: its name.
        directories: the user's configuration directories.

    Raises:
        ValueError: there is no such method, or it has no weights for any factor.

    """
    node = read_method(method, USUAL_SCALE, directories=directories)
    target = load_target("method", node)
    if target is Interpolation:
        return Ability("interpolation", {})
    factors: tuple[int, ...] = SCALES
    if takes("method", node, "weights"):
        factors = tuple(scale for scale in SCALES if has_weights(read_method(method, scale, None, directories), scale))
        if not factors:
            raise ValueError(f"method={method}: expected weights that it names, or that come with dsr; there are none")
    steps: dict[int, tuple[int, ...]] = {factor: (factor,) for factor in factors}
    if target is build_trained:
        return Ability("network", _with_second_step(steps))
    return Ability("sample", steps, bool(trait("method", node, "optimises")), trait("method", node, "cost"))


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
    method: str = "facets",
    directories: Sequence[Path] = (),
) -> Plan:
    """Return what :func:`dsr.inference.upsample_depth` does.

    A depth map of the photo's size that turns out to be enlarged by repeating pixels is taken for the low-resolution
    map that it was, whatever the plan says.

    Args:
        photo_size: height and width.
        depth_size: height and width.
        scale: the factor; None for one that suits the sizes, 4 where they are equal.
        method: the name of one in the registry.
        directories: the user's configuration directories.

    Raises:
        ValueError: no such method, a scale that it has no weights for, or sizes that do not go together.

    """
    ability = read_ability(method, directories)
    ratio = _ratio(photo_size, depth_size)
    own = ratio <= OWN_SIZE
    chosen = _scale(scale, USUAL_SCALE if own else ratio, method, ability)
    steps = ability.steps.get(chosen, ())
    pixels = math.prod(photo_size)
    if ability.optimises and pixels > LARGEST_OPTIMISED:
        raise ValueError(
            f"method={method}: expected a photo of up to {LARGEST_OPTIMISED} pixels, as it is optimised for each "
            f"picture, got {photo_size[0]} x {photo_size[1]}; method=facets takes any"
        )
    coarsened = chosen if own else 1
    before = f"averaged over {chosen} x {chosen} pixels, " if own else ""
    what = f"{method} x{chosen}" + (
        f" in two steps ({', '.join(f'x{step}' for step in steps)})" if len(steps) > 1 else ""
    )
    worked_on = _worked_on(photo_size, depth_size, steps, coarsened)
    text = (
        f"{depth_size[0]} x {depth_size[1]} depth {before}to {photo_size[0]} x {photo_size[1]} by {what}, "
        f"in about {_memory(pixels, worked_on, ability) / 2**30:.1f} GB of memory"
    )
    if ability.cost is not None:
        text += f" and {_duration(ability.cost.seconds * worked_on / 1e6)} on two CPU cores"
    return Plan(method, chosen, steps, coarsened, text)


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


def _scale(wanted: int | None, ratio: float, method: str, ability: Ability) -> int:
    """Return the factor that is wanted, else the smallest that is enough."""
    there = ability.steps
    if not there:
        if wanted is not None and wanted < 1:
            raise ValueError(f"scale: expected a positive whole number, got {wanted}")
        return wanted or math.ceil(ratio - 1e-9)
    if wanted is not None and wanted not in there:
        raise ValueError(f"scale: expected one of {', '.join(map(str, sorted(there)))} for {method}, got {wanted}")
    enough = [scale for scale in sorted(there) if ratio <= _SLACK * scale]
    if wanted is None and not enough:
        raise ValueError(f"depth: expected at least 1/{max(there)} of the photo's size for {method}, got 1/{ratio:.3g}")
    return wanted or enough[0]


def _worked_on(photo_size: tuple[int, int], depth_size: tuple[int, int], steps: tuple[int, ...], coarsened: int) -> int:
    """Return the pixels of the largest picture that a network answers."""
    if not steps or coarsened > 1:
        return math.prod(photo_size)
    first = math.prod(depth_size) * steps[0] ** 2
    return max(first, math.prod(photo_size)) if len(steps) > 1 else first


def _memory(pixels: int, worked_on: int, ability: Ability) -> float:
    """Return bytes, roughly, with the 0.4 GB of the program itself, 0.6 GB where it trains."""
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
