"""Expected errors of results whose method does not say any: by agreement with the input, and by distance from it.

The result, averaged over low-resolution pixels, is compared with the input averaged over 3 x 3 pixels: they differ by
the noise that the method has copied, by what it has smoothed, and at depth steps, where results are worst. In holes the
expected error grows with the angular distance from the nearest measured pixel. This is a rough estimate, which sorts
the pixels better than it states their errors.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import degrees_per_pixel, distance_to_known
from dsr.geometry.surface import angle_between, depth_to_normals

_WINDOW = 5
"""Low-resolution pixels over which differences are averaged."""
_NEAR, _PER_DEGREE = 0.02, 0.03
"""Relative error of depth in holes: beside measured pixels, and added per degree from them. With ``facets`` on
Middlebury 2014 and ICL-NUIM, errors are 1.7 % at 0.3, 4.8 % at 0.85, 7.3 % at 2.5 and 11 % at 5 degrees."""
_GUESSED = 45.0
"""Degrees between the normals, in holes."""


def expect_errors(inverse: Tensor, given: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the expected relative error of the depth and the expected error of the normal in degrees.

    Args:
        inverse: (1, H, W) the result: inverse depth in 1/m.
        given: (1, h, w) inverse depth of the input, NaN in holes.
        camera: the photo's, of H x W pixels.

    Returns:
        Two maps (1, H, W).

    """
    size, size_lr = (inverse.shape[-2], inverse.shape[-1]), (given.shape[-2], given.shape[-1])
    camera_lr = camera.rescale(size_lr[1], size_lr[0])
    known = given.isfinite()
    weight = known[None].to(inverse)
    smooth = _mean(given.nan_to_num(0)[None].to(inverse), weight, 3)
    result = functional.adaptive_avg_pool2d(inverse[None], size_lr)
    both = known[None] & (smooth > 0) & (result > 0)
    off = torch.where(both, (result / smooth).log().abs(), 0)
    rays = camera_lr.rays()[None].to(inverse.device)
    depths = (torch.where(both, each, torch.nan).reciprocal().double() for each in (result, smooth))
    angle = angle_between(*(depth_to_normals(depth, rays) for depth in depths)).to(inverse)
    tilted = angle.isfinite().to(inverse)
    angle = _mean(angle.nan_to_num(0), tilted, _WINDOW)
    away = distance_to_known(known).to(inverse) * degrees_per_pixel(camera_lr.fx)
    hole = ~known[None]
    spread = _mean(off, weight, _WINDOW) + torch.where(hole, _NEAR + _PER_DEGREE * away, 0).clamp(max=1)
    angle = torch.where(hole, angle.clamp(min=_GUESSED), angle)
    return _enlarge(spread, size), _enlarge(angle, size)


def _mean(values: Tensor, weight: Tensor, window: int) -> Tensor:
    """Return the means of the valid values around each pixel; 0 where there is none."""
    total, count = (
        functional.avg_pool2d(each, window, stride=1, padding=window // 2) for each in (values * weight, weight)
    )
    return torch.where(count > 0, total / torch.where(count > 0, count, 1), 0)


def _enlarge(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (1, *size), bilinear."""
    return functional.interpolate(values, size, mode="bilinear", align_corners=False)[0]
