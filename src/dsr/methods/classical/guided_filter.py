"""The base class of guided filters, and the guided filter: in each window, depth is a linear function of the colours.

A guided filter is a weighted mean of low-resolution values, u_p = sum of W_pq d_q, with weights that add up to 1. With
``slopes``, each low-resolution pixel stands for a plane instead, u_p = sum of W_pq (d_q + s_q . (p - q)), with the
local slope s_q, so that planes are reproduced exactly; ``slopes=False`` is the filter as published.

He, Sun, Tang, *Guided Image Filtering*, TPAMI 2013, with its colour guide: in every window w_k of the high-resolution
image, q_i = a_k . I_i + b_k with

    a_k = (S_k + eps U)^-1 (mean(I p) - m_k mean(p)),    b_k = mean(p) - a_k . m_k,

with the mean m_k and the 3 x 3 covariance S_k of the colours I, the input p (the bilinear interpolation of the
low-resolution map) and the identity U. The result is the mean over the windows that contain i. What differs: pixels and
windows are weighted by their confidence, so that holes do not spread.
"""

from abc import abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.images import inpaint, lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Steps

_WIDEST = 1024  # largest radius or width of a filter, in low-resolution pixels
# factor by which a result may be farther than the farthest valid low-resolution pixel, or nearer than the nearest
BEYOND = 4.0
# the entries of a symmetric 3 x 3 matrix, in the order of storage
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ROWS = ([0, 1, 2], [1, 3, 4], [2, 4, 5])  # indices of the matrix's rows among these
_TINY = 1e-30


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
        """Return the maps, (N, H, W), bilinear means of valid pixels, and the bilinear weight of these, (H, W)."""
        height, width = self.valid.shape
        down, across = (  # weights of linear interpolation; edge pixels are repeated beyond the border
            (1 - (where.clamp(0, size - 1)[:, None] - torch.arange(size).to(where)).abs()).clamp(min=0)
            for where, size in ((self.rows, height), (self.columns, width))
        )
        if bool(self.valid.all()):
            return down @ self.maps @ across.T, torch.ones_like(self.rgb[0])
        confidence = (down @ self.valid @ across.T).clamp(0, 1)
        mean = down @ (self.maps * self.valid) @ across.T / torch.where(confidence > 0, confidence, 1)
        return torch.where(confidence > 0, mean, down @ self.maps @ across.T), confidence


@dataclass(eq=False)
class GuidedMethod(Method):
    """A guided filter of the low-resolution disparity: everything but :meth:`filter_maps`.

    Unless holes are filled, a high-resolution pixel whose nearest low-resolution pixel is a hole is one, too.
    """

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(600, 2))

    fill_holes: bool = field(default=False, kw_only=True)
    slopes: bool = field(default=True, kw_only=True)

    @abstractmethod
    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the high-resolution maps, (N, H, W) float64, without holes, all with the same weights."""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        device = sample.depth_lr.device
        rows, columns = lr_coordinates(sample.camera, sample.camera_lr, device)
        disparity_lr = sample.disparity_lr(torch.float64)[0]
        valid = disparity_lr.isfinite()
        maps = disparity_lr[None]
        if self.slopes:  # the plane's value at row and column 0, and its slopes
            down, across = estimate_slopes(disparity_lr, 0), estimate_slopes(disparity_lr, 1)
            i, j = (torch.arange(size).to(disparity_lr) for size in disparity_lr.shape)
            maps = torch.stack((disparity_lr - down * i[:, None] - across * j, down, across))
            maps = maps.masked_fill(~valid, torch.nan)
        guided = Guided(sample.rgb.to(device).double(), inpaint(maps[:, None])[:, 0], valid.double(), rows, columns)
        answers = self.filter_maps(guided)
        disparity = answers[0]
        if self.slopes:
            disparity = disparity + answers[1] * rows[:, None] + answers[2] * columns
        doffs = sample.camera.doffs  # disparity + doffs is inverse depth
        lowest, highest = (float(bound) + doffs for bound in disparity_lr[valid].aminmax())
        disparity = disparity.clamp(lowest / BEYOND - doffs, highest * BEYOND - doffs)
        if not (self.fill_holes or bool(valid.all())):
            row, column = guided.nearest()
            disparity = disparity.masked_fill(~valid[row[:, None], column], torch.nan)
        return from_range(disparity[None], sample.camera, "disparity").to(sample.depth_lr)


@dataclass(eq=False)
class GuidedFilter(GuidedMethod):
    """The guided filter of the interpolated low-resolution disparity."""

    radius: float = 0.5
    epsilon: float = 1e-3

    def __post_init__(self) -> None:
        expect_window(radius=self.radius)
        expect_positive(epsilon=self.epsilon)

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the filtered interpolations, (N, H, W)."""
        maps, confidence = guided.interpolate()
        radius = max(round(self.radius * guided.scale), 1)
        return guided_filter(guided.rgb, maps, radius, self.epsilon, confidence)


def guided_filter(guide: Tensor, maps: Tensor, radius: int, epsilon: float, confidence: Tensor) -> Tensor:
    """Filter maps, (N, H, W) finite, with a colour guide, (3, H, W).

    Windows are truncated at the border, and ``confidence``, (H, W) in [0, 1], weights pixels. A pixel in no window with
    a positive confidence keeps its value.
    """
    mean_weight = _box(confidence, radius)
    divisor = torch.where(mean_weight > 0, mean_weight, 1)
    mean = _box(confidence * guide, radius) / divisor
    products = torch.stack([guide[i] * guide[j] for i, j in _PAIRS])
    variances = _box(confidence * products, radius) / divisor - torch.stack([mean[i] * mean[j] for i, j in _PAIRS])
    del products
    for k in (0, 3, 5):
        variances[k] += epsilon
    inverse = _invert(variances)
    mean_confidence = mean_weight / _box(torch.ones_like(confidence), radius)
    total = _box(mean_confidence, radius)

    filtered = []
    for values in maps:
        mean_value = _box(confidence * values, radius) / divisor
        cross = _box(confidence * guide * values, radius) / divisor - mean * mean_value
        slopes = torch.stack([(inverse[row] * cross).sum(dim=0) for row in _ROWS])
        constant = mean_value - (slopes * mean).sum(dim=0)
        slopes, constant = _box(mean_confidence * slopes, radius), _box(mean_confidence * constant, radius)
        smooth = ((slopes * guide).sum(dim=0) + constant) / total.clamp(min=_TINY)
        filtered.append(torch.where(total > 0, smooth, values))
    return torch.stack(filtered)


def estimate_slopes(values: Tensor, axis: int) -> Tensor:
    """Return the local slope of a map along an axis, in its shape; missing values (NaN) have slope 0.

    It is the backward or the forward difference, whichever is closer to 0, or 0 if their signs differ; at a border or a
    hole the one that exists. The median over three pixels then removes the pixel of a depth step that mixes both sides.
    """
    values = values.movedim(axis, 0)
    none = torch.full_like(values[:1], torch.nan)
    difference = torch.cat((none, values.diff(dim=0), none))
    before, after = difference[:-1], difference[1:]
    nearer = torch.where(before.abs() <= after.abs(), before, after)
    slope = torch.where(before * after < 0, 0, nearer)
    slope = torch.where(before.isnan(), after, torch.where(after.isnan(), before, slope)).nan_to_num(nan=0.0)
    padded = torch.cat((slope[:1], slope, slope[-1:]))
    return torch.stack((padded[:-2], slope, padded[2:])).median(dim=0).values.movedim(0, axis)


def expect_window(**options: float) -> None:
    """Raise a ValueError for the first window that is not positive, or wider than any map needs."""
    expect_positive(or_zero=False, **options)
    for name, value in options.items():
        if value > _WIDEST:
            raise ValueError(f"{name}: expected at most {_WIDEST} low-resolution pixels, got {value}")


def _box(x: Tensor, radius: int) -> Tensor:
    """Return the means over windows of (..., H, W), with 0 beyond the border; exactly 0 where all values are 0."""
    maps, side = x.reshape(-1, 1, *x.shape[-2:]), 2 * radius + 1
    maps = functional.avg_pool2d(functional.pad(maps, (0, 0, radius, radius)), (side, 1), stride=1)
    maps = functional.avg_pool2d(functional.pad(maps, (radius, radius)), (1, side), stride=1)
    return maps.reshape(x.shape)


def _invert(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric 3 x 3 matrices, (6, H, W) both, by cofactors; epsilon bounds determinants."""
    a, b, c, d, e, f = matrix
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    return torch.stack((aa, bb, cc, dd, ee, ff)) / (a * aa + b * bb + c * cc)
