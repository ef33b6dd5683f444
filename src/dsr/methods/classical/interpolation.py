"""Interpolation of low-resolution depth without a guide: nearest, bilinear, cubic spline, cubic convolution.

Cubic convolution is the "bicubic" of the field's benchmarks: Keys, *Cubic Convolution Interpolation for Digital Image
Processing*, IEEE TASSP 1981, with a = -0.5, as Pillow enlarges floating-point images. Unlike the spline, it needs four
pixels a side and does not overshoot beyond them.
"""

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dsr.degradation.downsampling import cubic_kernel
from dsr.geometry.camera import RANGE_TYPES, Camera, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Cost, InverseSample, InverseSurface, Method
from dsr.methods.images import lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps

Order = Literal["nearest", "bilinear", "bicubic", "clough_tocher"]


@dataclass(eq=False)
class Interpolation(Method):
    """Spline interpolation of low-resolution perspective depth, without a guide.

    ``bicubic`` is the interpolating cubic spline; ``clough_tocher`` is the smooth piecewise cubic surface over
    triangles, which gives the scores of the "Bicubic" of Voynov et al. 2019. Both repeat the outermost pixels beyond
    the border. Pixels are matched through the cameras. Unless holes are filled, a high-resolution pixel whose nearest
    low-resolution pixel is a hole is one, too.
    """

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(100))
    range_type = "perspective"

    order: Order = "bicubic"
    fill_holes: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        expect_one_of("order", self.order, get_args(Order))

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
        grid = torch.stack(torch.meshgrid(*lr_coordinates(camera_hr, camera), indexing="ij")).numpy()
        if self.order == "clough_tocher":  # over a triangulation of the pixels, the border repeated once
            from scipy.interpolate import CloughTocher2DInterpolator  # noqa: PLC0415 - only this order needs it

            padded = np.pad(values, 1, mode="edge")
            pixels = np.indices(padded.shape).reshape(2, -1).T - 1
            rows, columns = (np.clip(each, -1, size) for each, size in zip(grid, values.shape, strict=True))
            range_hr = CloughTocher2DInterpolator(pixels, padded.ravel())(rows, columns)
        else:
            degree = {"nearest": 0, "bilinear": 1, "bicubic": 3}[self.order]
            range_hr = ndimage.map_coordinates(values, grid, order=degree, mode="nearest")
        if not (valid.all() or self.fill_holes):
            range_hr[ndimage.map_coordinates(valid.astype(np.uint8), grid, order=0, mode="nearest") == 0] = np.nan
        range_hr[range_hr <= 0] = np.nan  # a spline may overshoot beside a depth step
        return from_range(torch.from_numpy(range_hr).to(range_lr)[None], camera_hr, "perspective")


@dataclass(eq=False)
class CubicConvolution(Method):
    """Interpolation of low-resolution depth or disparity, without a guide.

    Pixels are matched through the cameras. At the border and beside holes, the kernel is truncated and normalised; a
    high-resolution pixel whose nearest low-resolution pixel is a hole is a hole.
    """

    abilities = Abilities(ratios="any", own_size=True)

    range_type: RangeType = "disparity"

    def __post_init__(self) -> None:
        expect_one_of("range_type", self.range_type, RANGE_TYPES)

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres."""
        values = to_range(sample.depth_lr, sample.camera_lr, self.range_type)
        if self.range_type == "disparity":  # in the high-resolution camera's pixels
            values = values * (sample.camera.fx / sample.camera_lr.fx)
        coordinates = lr_coordinates(sample.camera, sample.camera_lr, values.device)
        matrices, nearest = [], []
        for where, size in zip(coordinates, values.shape[-2:], strict=True):
            weights = cubic_kernel((where[:, None] - torch.arange(size).to(where)).abs())
            matrices.append(weights / weights.sum(dim=1, keepdim=True))
            nearest.append(where.round().long().clamp(0, size - 1))
        rows, columns = matrices
        valid = values.isfinite()
        mean = rows @ torch.where(valid, values, 0).double() @ columns.T / (rows @ valid.double() @ columns.T)
        mean = mean.masked_fill(~valid[:, nearest[0][:, None], nearest[1]], torch.nan)
        depth = from_range(mean.to(values.dtype), sample.camera, self.range_type)
        return torch.where(depth > 0, depth, torch.nan)  # it may undershoot beside a depth step
