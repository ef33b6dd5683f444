"""Interpolation of low-resolution depth without a guide: nearest neighbour, bilinear, cubic spline ("Bicubic")."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Cost, InverseSample, InverseSurface, Method
from dsr.methods.networks.maps import lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

Order = Literal["nearest", "bilinear", "bicubic", "clough_tocher"]


class Interpolation(Method):
    """Spline interpolation of low-resolution perspective depth, without a guide.

    ``bicubic`` is the interpolating cubic spline; ``clough_tocher`` is the smooth piecewise cubic surface over
    triangles, which gives the scores of the "Bicubic" of Voynov et al. 2019. Both repeat the outermost
    pixels beyond the border. Pixels are matched through the cameras, so that the pixel centres of each downsampling
    model are respected.

    Args:
        order: ``nearest``, ``bilinear``, ``bicubic`` or ``clough_tocher``.
        fill_holes: whether holes of the low-resolution map take the value of the nearest valid pixel; otherwise a
            high-resolution pixel whose nearest low-resolution pixel is a hole is a hole.

    Raises:
        ValueError: an unknown order.

    """

    abilities = Abilities(ratios="any", at_ratio=True, cost=Cost(100))
    range_type: RangeType = "perspective"

    def __init__(self, order: Order = "bicubic", *, fill_holes: bool = False) -> None:
        if order not in get_args(Order):
            raise ValueError(f"order: expected one of {', '.join(get_args(Order))}, got {order!r}")
        self._degree = {"nearest": 0, "bilinear": 1, "bicubic": 3, "clough_tocher": None}[order]
        self._fill_holes = fill_holes

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres."""
        return self.interpolate(sample.depth_lr, sample.camera_lr, sample.camera)

    def upsample_inverse(self, problem: InverseSample, progress: Steps | None = None) -> InverseSurface:
        """Return the interpolated depth as inverse depth, with its holes."""
        depth = self.interpolate(problem.inverse.reciprocal(), problem.camera_lr, problem.camera)
        return InverseSurface(depth.reciprocal())

    def interpolate(self, depth: Tensor, camera: Camera, camera_hr: Camera) -> Tensor:
        """Return depth, (1, h, w) in metres, at the pixels of another camera, whatever the ratio of their sizes."""
        range_lr = to_range(depth, camera, "perspective")[0]
        valid = depth.isfinite()[0].cpu().numpy()
        values = range_lr.cpu().numpy()
        if not valid.all():
            nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
            values = values[tuple(nearest)]
        coordinates = lr_coordinates(camera_hr, camera)
        grid = torch.stack(torch.meshgrid(*coordinates, indexing="ij")).numpy()
        if self._degree is None:
            range_hr = _clough_tocher(values, grid)
        else:
            range_hr = ndimage.map_coordinates(values, grid, order=self._degree, mode="nearest")
        if not (valid.all() or self._fill_holes):
            range_hr[ndimage.map_coordinates(valid.astype(np.uint8), grid, order=0, mode="nearest") == 0] = np.nan
        range_hr[range_hr <= 0] = np.nan  # a spline may overshoot beside a depth step
        return from_range(torch.from_numpy(range_hr).to(range_lr)[None], camera_hr, "perspective")


def _clough_tocher(values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Interpolate (h, w) at rows and columns (2, H, W) over a triangulation of the pixels, the border repeated once."""
    from scipy.interpolate import CloughTocher2DInterpolator  # noqa: PLC0415 - only this order needs it

    padded = np.pad(values, 1, mode="edge")
    pixels = np.indices(padded.shape).reshape(2, -1).T - 1
    rows, columns = (np.clip(each, -1, size) for each, size in zip(grid, values.shape, strict=True))
    return CloughTocher2DInterpolator(pixels, padded.ravel())(rows, columns)
