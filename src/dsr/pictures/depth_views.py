"""Views of a depth map for pictures: normals, renderings, colour range, reduction, the window of largest values."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.lights import FIGURE_LIGHT, direction_of
from dsr.geometry.surface import depth_to_normals, shade


def normals_seen_by(camera: Camera, depth: Tensor) -> Tensor:
    """Compute the normals of a depth map, (1, H, W) in metres, as (1, 3, H, W); NaN where they are undefined."""
    return depth_to_normals(depth.double()[None], camera.rays()[None])


def angles_between(camera: Camera, first: Tensor, second: Tensor) -> Tensor:
    """Compute the angles between the normals of two depth maps in degrees, (1, H, W)."""
    cosine = (normals_seen_by(camera, first) * normals_seen_by(camera, second)).sum(dim=1)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))


def rendering(depth: Tensor, camera: Camera, light: str = FIGURE_LIGHT) -> np.ndarray:
    """Render a depth map, (1, H, W), under one light: (H, W) in [0, 1], NaN where undefined."""
    direction = torch.tensor([direction_of(light)], dtype=torch.float64)
    if min(depth.shape[-2:]) < 2:
        return np.full(tuple(depth.shape[-2:]), np.nan)
    return shade(normals_seen_by(camera, depth), direction)[0, 0].clamp(0, 1).numpy()


def limits_of(depth: Tensor) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the valid depths, so that outliers do not stretch the colour range."""
    valid = depth[depth.isfinite()].numpy()
    low, high = np.percentile(valid, [1, 99]) if valid.size else (0, 1)
    return float(low), float(max(high, low + 1e-6))


class Window(NamedTuple):
    """A window of a picture: ``height x width`` pixels, the first at (``top``, ``left``)."""

    top: int
    left: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the window."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


def strongest_window(values: np.ndarray, height: int, width: int, taken: Sequence[Window] = ()) -> Window | None:
    """Return the window with the largest mean of (H, W) non-negative values that does not overlap the ``taken`` ones.

    It is the first of the best windows in reading order, None if no window fits; NaN counts as 0.
    """
    if height > values.shape[0] or width > values.shape[1]:
        return None
    sums = np.pad(np.nan_to_num(values).astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    totals = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    totals = totals.round(9)  # rounding errors must not decide between equal windows
    for other in taken:
        rows = slice(max(0, other.top - height + 1), other.top + other.height)
        totals[rows, max(0, other.left - width + 1) : other.left + other.width] = -1
    top, left = np.unravel_index(int(totals.argmax()), totals.shape)
    return None if totals[top, left] < 0 else Window(int(top), int(left), height, width)


def reduced(values: Tensor, longest: int) -> Tensor:
    """Reduce (C, H, W) to at most ``longest`` pixels by means of blocks, NaN where less than half of one is valid."""
    factor = math.ceil(max(values.shape[-2:]) / longest)
    if factor == 1:
        return values
    valid = values.isfinite()
    total, weight = (
        functional.avg_pool2d(each.to(values.dtype), factor, ceil_mode=True, count_include_pad=False)
        for each in (torch.where(valid, values, 0), valid)
    )
    return torch.where(weight >= 0.5, total / weight.clamp(min=0.5), torch.nan)
