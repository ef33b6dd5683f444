"""Run methods on inverse depth of sizes that they do not support, by resizing the photo and the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.resampling import resize_inverse_depth
from dsr.methods.base import InverseSample, InverseSurface, Method, NoiseLaw
from dsr.utils.progress import Steps, part_of

Size = tuple[int, int]  # height and width


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
    """Run methods in turn, each at its factor and on the result of the one before, and resize the last one's result.

    The photo is (3, H, W), and the camera is its; the map is (1, h, w).
    """
    size = size_of(rgb)
    sizes = [size_of(inverse)]  # of the low-resolution map of each stage
    sizes += [(-(-size[0] // factor), -(-size[1] // factor)) for factor, _ in stages[1:]]
    parts = [each.count_steps(factor * s[0], factor * s[1]) for (factor, each), s in zip(stages, sizes, strict=True)]
    surface = InverseSurface(inverse)
    for i, ((factor, method), (height, width)) in enumerate(zip(stages, sizes, strict=True)):
        enlarged = camera.rescale(factor * width, factor * height)
        surface = method.upsample_inverse(
            InverseSample(
                resize_rgb(rgb, (enlarged.height, enlarged.width)),
                resize_inverse_depth(surface.inverse, (height, width), math.inf),
                enlarged,
                camera.rescale(width, height),
                factor,
            ),
            progress if len(stages) == 1 else part_of(progress, sum(parts[:i]), sum(parts)),
        )
    spread, angle = (None if each is None else _resize(each, size) for each in (surface.spread, surface.angle))
    return surface._replace(inverse=resize_inverse_depth(surface.inverse, size), spread=spread, angle=angle)


def padded(
    run: Callable[[Tensor, Camera], InverseSurface], ratio: float, rgb: Tensor, inverse: Tensor, camera: Camera
) -> InverseSurface:
    """Apply ``run`` to the photo padded to ``ratio`` times the size of the map, and crop the result."""
    height, width = (max(round(ratio * n), m) for n, m in zip(size_of(inverse), size_of(rgb), strict=True))
    padding = (0, width - rgb.shape[-1], 0, height - rgb.shape[-2])  # at the right and the bottom
    photo = functional.pad(rgb[None], padding, mode="replicate")[0] if any(padding) else rgb
    found = run(photo, Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy))
    return found.map(lambda values: values[..., : camera.height, : camera.width])


def resize_rgb(rgb: Tensor, size: Size) -> Tensor:
    """Resize a photo, (3, H, W), with antialiasing."""
    if size_of(rgb) == size:
        return rgb
    return functional.interpolate(rgb[None], size, mode="bicubic", antialias=True)[0].clamp_(0, 1)


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


def _resize(values: Tensor, size: Size) -> Tensor:
    """Return (1, *size), bilinear."""
    return functional.interpolate(values[None], size, mode="bilinear", align_corners=False, antialias=True)[0]
