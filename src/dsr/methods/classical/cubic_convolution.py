"""Interpolation by cubic convolution, the "bicubic" of the field's benchmarks.

Keys, *Cubic Convolution Interpolation for Digital Image Processing*, IEEE TASSP 1981, with a = -0.5, as Pillow enlarges
floating-point images. Unlike the spline of :mod:`dsr.methods.classical.interpolation`, it needs four pixels a side and
does not overshoot beyond them.
"""

from __future__ import annotations

from typing import get_args

import torch
from torch import Tensor

from dsr.degradation.downsampling import cubic_kernel
from dsr.geometry.camera import RANGE_TYPES, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Method
from dsr.methods.networks.maps import lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.progress import Steps


class CubicConvolution(Method):
    """Interpolation of low-resolution depth or disparity, without a guide.

    Pixels are matched through the cameras. At the border and beside holes, the kernel is truncated and normalised; a
    high-resolution pixel whose nearest low-resolution pixel is a hole is a hole.

    Args:
        range_type: range type that is interpolated.

    Raises:
        ValueError: an unknown range type.

    """

    abilities = Abilities(ratios="any")

    def __init__(self, range_type: RangeType = "disparity") -> None:
        if range_type not in get_args(RangeType):
            raise ValueError(f"range_type: expected one of {', '.join(RANGE_TYPES)}, got {range_type!r}")
        self.range_type = range_type

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres."""
        values = to_range(sample.depth_lr, sample.camera_lr, self.range_type)
        if self.range_type == "disparity":  # in the high-resolution camera's pixels
            values = values * (sample.camera.fx / sample.camera_lr.fx)
        coordinates = lr_coordinates(sample.camera, sample.camera_lr, values.device)
        rows, columns = (_weights(x, size) for x, size in zip(coordinates, values.shape[-2:], strict=True))
        valid = values.isfinite()
        weight = rows @ valid.double() @ columns.T
        mean = rows @ torch.where(valid, values, 0).double() @ columns.T / weight
        nearest = (x.round().long().clamp(0, size - 1) for x, size in zip(coordinates, values.shape[-2:], strict=True))
        row, column = nearest
        mean = torch.where(valid[:, row][:, :, column], mean, torch.nan)
        depth = from_range(mean.to(values.dtype), sample.camera, self.range_type)
        return torch.where(depth > 0, depth, torch.nan)  # it may undershoot beside a depth step


def _weights(coordinates: Tensor, size: int) -> Tensor:
    """Return the weights of the pixels 0 .. size - 1 at some coordinates, (coordinates, size); every row sums to 1."""
    pixels = torch.arange(size, dtype=coordinates.dtype, device=coordinates.device)
    weights = cubic_kernel((coordinates[:, None] - pixels).abs())
    return weights / weights.sum(dim=1, keepdim=True)
