"""Bring a depth map to a photo's size: plan it, with the memory and time that it takes, and run methods on other sizes.

Facets and filters take any ratio of the sizes. Other networks are trained for fixed factors. A low-resolution depth map
is not resized: the photo is resized to a multiple of its size, and the network's result to the photo's size
(:mod:`dsr.geometry.resampling`). The factor is the smallest that reaches the photo's size; larger ratios than 8 take
two steps, x8 and then x4 on the result averaged to a quarter of the photo's size. The figures are in
docs/measurements/facets.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.resampling import resize_inverse_depth
from dsr.inference import DEFAULT
from dsr.methods.base import InverseSample, InverseSurface, Method, NoiseLaw
from dsr.methods.networks.weight_files import SLACK, nearest_scale
from dsr.methods.recipe import Recipe
from dsr.utils.progress import Steps, duration, part_of

Size = tuple[int, int]  # height and width
USUAL_SCALE = 4
LARGEST_OPTIMISED = 2**20  # pixels; optimising a network for a larger picture takes hours
OWN_SIZE = 1.25  # a depth map whose sides differ from the photo's by no more than this factor has the photo's size
_ASPECT = 0.02


@dataclass(frozen=True)
class Plan:
    """How a depth map is upsampled."""

    method: str
    scale: int  # the approximate upsampling factor
    steps: tuple[int, ...]  # the networks' factors, one after the other; empty for interpolation
    coarsened: int  # the factor by which depth of the photo's own size is downsampled first; 1 for low-resolution depth
    way: str  # the sizes and the method in one line
    text: str  # the same, and the memory and time that it takes


def steps_of(recipe: Recipe) -> Mapping[int, tuple[int, ...]]:
    """Return, for each factor, those of the calls that give it; nothing for a method of any ratio.

    A network reaches further factors by a second step. A method of fixed factors without weights is a ValueError.
    """
    if recipe.abilities.at_ratio:
        return {}
    steps: dict[int, tuple[int, ...]] = {factor: (factor,) for factor in recipe.factors}
    if recipe.abilities.repeats and 4 in steps and 16 not in steps:
        steps = {16: (8, 4), 32: (8, 4), **steps} if 8 in steps else {16: (4, 4), **steps}
    return steps


def plan_for(recipe: Recipe, photo_size: Size, depth_size: Size, scale: int | None = None) -> Plan:
    """Plan what :class:`dsr.inference.any_ratio.AnyRatio` does for a photo and a depth map of these sizes.

    ``scale`` is the factor; None to choose it by the sizes, 4 if they are equal. A ValueError if the method has no
    weights for it, or the sizes do not fit together. This plan does not apply to a depth map of the photo's size that
    was enlarged by repeating pixels: it is upsampled from the low-resolution map that it was before.
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
    computed = pixels  # of the largest picture that is computed
    if recipe.computed_at and not as_it_is:
        computed = round(math.prod(depth_size) * nearest_scale(recipe.computed_at, chosen) ** 2)
    elif steps and not own:
        first = math.prod(depth_size) * steps[0] ** 2
        computed = first if len(steps) == 1 else max(first, pixels)
    before = f"averaged over {chosen} x {chosen} pixels, " if own else ""
    way = f"{depth_size[0]} x {depth_size[1]} depth {before}to {photo_size[0]} x {photo_size[1]} by {method} x{chosen}"
    if len(steps) > 1:
        way += f" in two steps ({', '.join(f'x{step}' for step in steps)})"
    text = f"{way}, in about {abilities.cost.bytes_for(pixels, computed) / 2**30:.1f} GB of memory"
    if abilities.cost.seconds is not None:
        text += f" and about {duration(max(abilities.cost.seconds * computed / 1e6, 1))} on two CPU cores"
    return Plan(method, chosen, steps, chosen if own else 1, way, text)


def _ratio(photo_size: Size, depth_size: Size) -> float:
    if min(*photo_size, *depth_size) < 1:
        raise ValueError(f"sizes: expected positive ones, got a photo of {photo_size} and depth of {depth_size}")
    down, across = photo_size[0] / depth_size[0], photo_size[1] / depth_size[1]
    sizes = f"{depth_size[0]} x {depth_size[1]} for a photo of {photo_size[0]} x {photo_size[1]} (height x width)"
    if abs(down / across - 1) > max(_ASPECT, 1 / min(depth_size)):
        raise ValueError(f"depth: expected the photo's field of view and aspect within {_ASPECT:.0%}, got {sizes}")
    ratio = max(down, across)
    if ratio < 1 / OWN_SIZE:
        raise ValueError(f"depth: expected no more pixels than the photo, got {sizes}")
    return ratio


def _scale(requested: int | None, ratio: float, method: str, factors: Mapping[int, tuple[int, ...]]) -> int:
    if not factors:
        if requested is not None and requested < 1:
            raise ValueError(f"scale: expected a positive whole number, got {requested}")
        return requested or math.ceil(ratio / SLACK - 1e-9)
    if requested is not None and requested not in factors:
        raise ValueError(f"scale: expected one of {', '.join(map(str, sorted(factors)))} for {method}, got {requested}")
    enough = [scale for scale in sorted(factors) if ratio <= SLACK * scale]
    if requested is None and not enough:
        least = f"1/{max(factors)} of the photo's size for {method}"
        raise ValueError(f"depth: expected at least {least}, got 1/{ratio:.3g}")
    return requested or enough[0]


def at_ratio(
    method: Method,
    rgb: Tensor,
    inverse: Tensor,
    camera: Camera,
    progress: Steps | None,
    noise: NoiseLaw | None = None,
) -> InverseSurface:
    """Run a method of any ratio on a photo, (3, H, W), its camera, and a map, (1, h, w), whose noise may be known."""
    height, width = size_of(inverse)
    down, across = camera.height / height, camera.width / width
    ratio = down if across.is_integer() else across  # whole only if both are
    problem = InverseSample(rgb, inverse, camera, camera.rescale(width, height), ratio, noise)
    return method.upsample_inverse(problem, progress)


def at_factors(
    stages: Sequence[tuple[int, Method]], rgb: Tensor, inverse: Tensor, camera: Camera, progress: Steps | None
) -> InverseSurface:
    """Run methods in turn, each at its factor on the result before; the last result gets the photo's size."""
    size = size_of(rgb)
    sizes = [size_of(inverse)]  # of the low-resolution map of each stage
    sizes += [(-(-size[0] // factor), -(-size[1] // factor)) for factor, _ in stages[1:]]
    parts = [each.count_steps(factor * s[0], factor * s[1]) for (factor, each), s in zip(stages, sizes, strict=True)]
    surface = InverseSurface(inverse)
    for i, ((factor, method), (height, width)) in enumerate(zip(stages, sizes, strict=True)):
        enlarged = camera.rescale(factor * width, factor * height)
        photo, size_hr = rgb, (enlarged.height, enlarged.width)
        if size_hr != size:
            photo = functional.interpolate(rgb[None], size_hr, mode="bicubic", antialias=True)[0].clamp_(0, 1)
        inverse_lr = resize_inverse_depth(surface.inverse, (height, width), math.inf)
        problem = InverseSample(photo, inverse_lr, enlarged, camera.rescale(width, height), factor)
        own = progress if len(stages) == 1 else part_of(progress, sum(parts[:i]), sum(parts))
        surface = method.upsample_inverse(problem, own)
    spread, angle = (
        None if each is None else functional.interpolate(each[None], size, mode="bilinear", antialias=True)[0]
        for each in (surface.spread, surface.angle)
    )
    return surface._replace(inverse=resize_inverse_depth(surface.inverse, size), spread=spread, angle=angle)


def padded(rgb: Tensor, camera: Camera, ratio: float, size_lr: Size) -> tuple[Tensor, Camera]:
    """Return a photo padded at the right and the bottom to ``ratio`` times the size of a map, and its camera."""
    height, width = (max(round(ratio * n), m) for n, m in zip(size_lr, size_of(rgb), strict=True))
    padding = (0, width - rgb.shape[-1], 0, height - rgb.shape[-2])
    photo = functional.pad(rgb[None], padding, mode="replicate")[0] if any(padding) else rgb
    return photo, Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy)


def cropped(found: InverseSurface, camera: Camera) -> InverseSurface:
    """Return a result for a padded photo without the padding."""
    return found.map(lambda values: values[..., : camera.height, : camera.width])


def resize_nearest(values: Tensor, size: Size) -> Tensor:
    """Resize (1, h, w) to another size by nearest neighbour."""
    if size_of(values) == size:
        return values
    for dim in (-2, -1):
        old, new = values.shape[dim], size[dim]
        places = ((torch.arange(new, device=values.device) + 0.5) * (old / new)).long().clamp(max=old - 1)
        values = values.index_select(dim, places)
    return values


def size_of(values: Tensor) -> Size:
    """Return height and width of a map."""
    return values.shape[-2], values.shape[-1]
