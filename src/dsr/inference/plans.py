"""Plan how a depth map is upsampled to a photo's size, and estimate the memory and time that it takes.

Facets and filters take any ratio of the sizes. Other networks are trained for fixed factors. A low-resolution depth map
is not resized: the photo is resized to a multiple of its size, and the network's result to the photo's size
(:mod:`dsr.geometry.resampling`). The factor is the smallest that reaches the photo's size; larger ratios than 8 take
two steps, x8 and then x4 on the result averaged to a quarter of the photo's size. docs/facets.md has the figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from dsr.inference.defaults import DEFAULT, USUAL_SCALE
from dsr.methods.networks.weight_files import SLACK, nearest_scale
from dsr.methods.recipe import Recipe
from dsr.utils.progress import duration

LARGEST_OPTIMISED = 2**20
"""Pixels; optimising a network for a larger picture takes hours."""
OWN_SIZE = 1.25
"""A depth map whose sides differ from the photo's by no more than this factor is treated as having the photo's size."""
_ASPECT = 0.02


@dataclass(frozen=True)
class Plan:
    """How a depth map is upsampled.

    Args:
        method: the method.
        scale: the approximate upsampling factor.
        steps: the networks' factors, one after the other; empty for interpolation.
        coarsened: the factor by which depth of the photo's own size is downsampled first; 1 for low-resolution depth.
        way: the sizes and the method in one line.
        text: the same, and the memory and time that it takes.
        seconds: the time on two CPU cores; None where it is not known.

    """

    method: str
    scale: int
    steps: tuple[int, ...]
    coarsened: int
    way: str
    text: str
    seconds: float | None


def steps_of(recipe: Recipe) -> Mapping[int, tuple[int, ...]]:
    """Return, for each factor, those of the calls that give it; nothing for a method of any ratio.

    Raises:
        ValueError: a method of fixed factors has no weights for any.

    """
    if recipe.abilities.at_ratio:
        return {}
    steps: dict[int, tuple[int, ...]] = {factor: (factor,) for factor in recipe.factors}
    return _with_second_step(steps) if recipe.abilities.repeats else steps


def _with_second_step(steps: dict[int, tuple[int, ...]]) -> dict[int, tuple[int, ...]]:
    """Return a network's steps with those of the factors that it reaches by a second step of 4."""
    if 4 not in steps:
        return steps
    second = {16: (8, 4), 32: (8, 4)} if 8 in steps else {16: (4, 4)}
    return second | steps if 16 not in steps else steps


def plan_for(
    recipe: Recipe, photo_size: tuple[int, int], depth_size: tuple[int, int], scale: int | None = None
) -> Plan:
    """Plan what :class:`dsr.inference.AnyRatio` does.

    This plan does not apply to a depth map of the photo's size that was enlarged by repeating pixels: it is upsampled
    from the low-resolution map that it was before.

    Args:
        photo_size: height and width.
        depth_size: height and width.
        scale: the factor; None to choose it by the sizes, 4 if they are equal.

    Raises:
        ValueError: a scale that the method has no weights for, or sizes that do not fit together.

    Example:
        >>> from dsr.inference import plan_for
        >>> from dsr.methods.recipe import read_recipe
        >>> plan_for(read_recipe("facets"), (1440, 1920), (192, 256)).scale  # of a phone's depth
        8

    """
    method, abilities, factors = recipe.name, recipe.abilities, steps_of(recipe)
    ratio = _ratio(photo_size, depth_size)
    as_it_is = ratio <= OWN_SIZE and abilities.own_size and scale in (None, 1)
    own = ratio <= OWN_SIZE and not as_it_is
    chosen = 1 if as_it_is else _scale(scale, USUAL_SCALE if own else ratio, method, factors)
    steps = factors.get(chosen, ())
    pixels = math.prod(photo_size)
    if abilities.optimises and pixels > LARGEST_OPTIMISED:
        raise ValueError(
            f"method={method}: expected a photo of up to {LARGEST_OPTIMISED} pixels, as it is optimised for each "
            f"picture, got {photo_size[0]} x {photo_size[1]}; method={DEFAULT} takes any"
        )
    coarsened = chosen if own else 1
    before = f"averaged over {chosen} x {chosen} pixels, " if own else ""
    what = f"{method} x{chosen}" + (
        f" in two steps ({', '.join(f'x{step}' for step in steps)})" if len(steps) > 1 else ""
    )
    computed = _computed(photo_size, depth_size, steps, coarsened)
    if recipe.computed_at and not as_it_is:
        computed = round(math.prod(depth_size) * nearest_scale(recipe.computed_at, chosen) ** 2)
    way = f"{depth_size[0]} x {depth_size[1]} depth {before}to {photo_size[0]} x {photo_size[1]} by {what}"
    text = f"{way}, in about {abilities.cost.bytes_for(pixels, computed) / 2**30:.1f} GB of memory"
    seconds = None if abilities.cost.seconds is None else abilities.cost.seconds * computed / 1e6
    if seconds is not None:
        text += f" and about {duration(max(seconds, 1))} on two CPU cores"
    return Plan(method, chosen, steps, coarsened, way, text, seconds)


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


def _scale(requested: int | None, ratio: float, method: str, factors: Mapping[int, tuple[int, ...]]) -> int:
    """Return the requested factor, or the smallest that reaches the photo's size."""
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


def _computed(photo_size: tuple[int, int], depth_size: tuple[int, int], steps: tuple[int, ...], coarsened: int) -> int:
    """Return the number of pixels of the largest picture that a network computes."""
    if not steps or coarsened > 1:
        return math.prod(photo_size)
    first = math.prod(depth_size) * steps[0] ** 2
    return max(first, math.prod(photo_size)) if len(steps) > 1 else first
