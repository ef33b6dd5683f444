"""The base class of guided filters: pixels matched through the cameras, holes, and slopes.

A guided filter is a weighted mean of low-resolution values, u_p = sum of W_pq d_q, with weights that add up to 1. Such
means flatten slopes at borders, and where the guide makes the weights uneven they copy its texture into the surface.
With ``slopes``, each low-resolution pixel stands for a plane instead, u_p = sum of W_pq (d_q + s_q . (p - q)), with the
local slope s_q of the low-resolution disparity and the same weights. A plane in space has a disparity that is linear in
the pixel, so planes are reproduced exactly under any guide. The filter commutes with an affine map of the disparity,
with slopes as without. None of the filters' papers does this: ``slopes=False`` is the filter as published.

Everything is computed in float64, without randomness, on the sample's device.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.images import inpaint, lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

_WIDEST = 1024  # largest radius or width of a filter, in low-resolution pixels
# factor by which a result may be farther than the farthest valid low-resolution pixel, or nearer than the nearest
_BEYOND = 4.0


@dataclass(frozen=True)
class Guided:
    """Low-resolution maps and the image that guides their upsampling, all float64."""

    rgb: Tensor  # (3, H, W) in [0, 1]
    maps: Tensor  # (N, h, w), to be upsampled with the same weights; holes are inpainted
    valid: Tensor  # (h, w), 1 where the maps are valid and 0 in holes
    rows: Tensor  # (H,) position of each high-resolution pixel in low-resolution pixels
    columns: Tensor  # (W,)

    @property
    def scale(self) -> float:
        """High-resolution pixels per low-resolution one."""
        return self.rgb.shape[-1] / self.maps.shape[-1]

    def nearest(self) -> tuple[Tensor, Tensor]:
        """Return the row (H,) and the column (W,) of the low-resolution pixel nearest to each high-resolution pixel."""
        height, width = self.valid.shape
        rows, columns = (self.rows + 0.5).floor().long(), (self.columns + 0.5).floor().long()
        return rows.clamp(0, height - 1), columns.clamp(0, width - 1)

    def interpolate(self) -> tuple[Tensor, Tensor]:
        """Return the maps, (N, H, W), and their confidence, (H, W), at the high-resolution pixels.

        A value is the bilinear mean of the valid ones among the four low-resolution pixels around it, and its
        confidence their bilinear weight: 1 away from holes, 0 within them, where the value is inpainted.
        """
        height, width = self.valid.shape
        down, across = _linear_weights(self.rows, height), _linear_weights(self.columns, width)
        if bool(self.valid.all()):
            return down @ self.maps @ across.T, torch.ones_like(self.rgb[0])
        confidence = (down @ self.valid @ across.T).clamp(0, 1)
        mean = down @ (self.maps * self.valid) @ across.T / torch.where(confidence > 0, confidence, 1)
        return torch.where(confidence > 0, mean, down @ self.maps @ across.T), confidence


class GuidedMethod(Method):
    """A guided filter of the low-resolution disparity: everything but :meth:`filter_maps`.

    Args:
        fill_holes: whether holes of the low-resolution map are inpainted; otherwise a high-resolution pixel whose
            nearest low-resolution pixel is a hole is a hole.
        slopes: whether each low-resolution pixel stands for a plane, see the module.

    """

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(600, 2))

    def __init__(self, *, fill_holes: bool = False, slopes: bool = True) -> None:
        self._fill_holes = fill_holes
        self._slopes = slopes

    @abstractmethod
    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the high-resolution maps, (N, H, W) float64, without holes, all with the same weights."""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        device = sample.depth_lr.device
        rows, columns = lr_coordinates(sample.camera, sample.camera_lr, device)
        disparity_lr = sample.disparity_lr(torch.float64)[0]
        valid = disparity_lr.isfinite()
        maps = _fit_planes(disparity_lr) if self._slopes else disparity_lr[None]
        guided = Guided(sample.rgb.to(device).double(), inpaint(maps[:, None])[:, 0], valid.double(), rows, columns)
        answers = self.filter_maps(guided)
        disparity = answers[0]
        if self._slopes:
            disparity = disparity + answers[1] * rows[:, None] + answers[2] * columns
        doffs = sample.camera.doffs  # disparity + doffs is inverse depth
        lowest, highest = (float(bound) + doffs for bound in disparity_lr[valid].aminmax())
        disparity = disparity.clamp(lowest / _BEYOND - doffs, highest * _BEYOND - doffs)
        if not (self._fill_holes or bool(valid.all())):
            i, j = guided.nearest()
            disparity = disparity.masked_fill(~valid[i[:, None], j], torch.nan)
        return from_range(disparity[None], sample.camera, "disparity").to(sample.depth_lr)


def estimate_slopes(values: Tensor, axis: int) -> Tensor:
    """Return the local slope of a map along an axis, in its shape; missing values (NaN) have slope 0.

    The slope is the backward or the forward difference, whichever is closer to 0, or 0 if their signs differ; at a
    border or a hole it is the one that exists. The median over three pixels then removes the pixel of a depth step that
    mixes both sides.
    """
    values = values.movedim(axis, 0)
    difference = torch.full_like(values[:1], torch.nan)
    difference = torch.cat((difference, values[1:] - values[:-1], difference))
    before, after = difference[:-1], difference[1:]
    nearer = torch.where(before.abs() <= after.abs(), before, after)
    slope = torch.where(before * after < 0, 0, nearer)
    slope = torch.where(before.isnan(), after, torch.where(after.isnan(), before, slope)).nan_to_num(nan=0.0)
    padded = torch.cat((slope[:1], slope, slope[-1:]))
    return torch.stack((padded[:-2], slope, padded[2:])).median(dim=0).values.movedim(0, axis)


def expect_positive(method: str, **values: float) -> None:
    """Raise a ValueError for the first of a method's parameters that is not a positive finite number."""
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise ValueError(f"{name}: expected a positive number for {method}, got {value}")


def expect_window(method: str, **values: float) -> None:
    """Raise a ValueError for the first of a method's windows that is not positive, or wider than any map needs."""
    expect_positive(method, **values)
    for name, value in values.items():
        if value > _WIDEST:
            raise ValueError(f"{name}: expected at most {_WIDEST} low-resolution pixels for {method}, got {value}")


def _fit_planes(disparity_lr: Tensor) -> Tensor:
    """Return each low-resolution pixel's plane, (3, h, w): value at row and column 0, slope per row and per column."""
    height, width = disparity_lr.shape
    down, across = estimate_slopes(disparity_lr, 0), estimate_slopes(disparity_lr, 1)
    constant = (
        disparity_lr
        - down * torch.arange(height).to(disparity_lr)[:, None]
        - across * torch.arange(width).to(disparity_lr)
    )
    return torch.stack((constant, down, across)).masked_fill(disparity_lr.isnan(), torch.nan)


def _linear_weights(where: Tensor, size: int) -> Tensor:
    """Return the weights of linear interpolation, (len(where), size); edge pixels are repeated beyond the border."""
    places = torch.arange(size).to(where)
    return (1 - (where.clamp(0, size - 1)[:, None] - places).abs()).clamp(min=0)
