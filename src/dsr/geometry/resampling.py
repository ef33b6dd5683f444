"""Resize and pad inverse depth without blurring depth steps.

Along each axis, a line is fitted to the old pixels around each new one, with triangular weights wide enough for
antialiasing; the new pixel is the value of the line at its centre. Planes, whose inverse depth is linear in the pixel,
stay planes to rounding, up to the border. A second difference above ``JUMP`` times the value at one of these old pixels
is a depth step: the new pixel then takes, of the four old ones around its centre, the value nearest to the fitted one.
Compared with antialiased bicubic resizing this lowers RMSE_v on Lucy from 0.137 to 0.061 for a photo twice as large as
the depth map, and from 0.176 to 0.141 for one 7.5 times as large; on Plant, whose ground truth has many mixed pixels,
it raises RMSE_v from 0.129 to 0.144 and from 0.176 to 0.185.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

JUMP = 0.02  # relative second difference of inverse depth; between 0.01 and 0.04 scores hardly change
# radius in old pixels beyond the outermost centre, for new pixels outside it: a line needs two pixels
_BORDER_RADIUS = 1.25
_STRIP = 256  # rows that are resized at a time


def resize_inverse_depth(inverse: Tensor, size: tuple[int, int], jump: float = JUMP) -> Tensor:
    """Resize inverse depth, (1, H, W) in 1/m without holes, as the module describes; its outer edges stay.

    ``jump`` is ``JUMP``, or infinity to average across depth steps, too.
    """
    if tuple(inverse.shape[-2:]) == size:
        return inverse
    rows, columns = _find_axis(inverse.shape[-2], size[0], inverse), _find_axis(inverse.shape[-1], size[1], inverse)
    parts = []
    for start in range(0, size[0], _STRIP):
        index, weight = rows.index[start : start + _STRIP], rows.weight[start : start + _STRIP]
        first, end = max(int(index.min()) - 1, 0), int(index.max()) + 2  # a row more for second differences
        parts.append(_resize_strip(inverse[:, first:end], _Axis(index - first, weight, rows.around), columns, jump))
    return torch.cat(parts, dim=-2)


def pad_inverse_depth(inverse: Tensor, factor: int) -> Tensor:
    """Pad inverse depth, (..., H, W), at the right and the bottom to a multiple of a factor; planes are continued."""
    for dim in (-2, -1):
        more, size = -inverse.shape[dim] % factor, inverse.shape[dim]
        if not more:
            continue
        last = inverse.narrow(dim, size - 1, 1)
        slope = (last - inverse.narrow(dim, max(size - 1 - factor, 0), 1)) / min(factor, max(size - 1, 1))
        slope = torch.where(slope.abs() * factor <= 0.1 * last, slope, 0)  # a depth step or a hole, not a plane
        steps = torch.arange(1, more + 1, dtype=inverse.dtype, device=inverse.device)
        further = last + slope * (steps[:, None] if dim == -2 else steps)
        inverse = torch.cat((inverse, further), dim)
    return inverse


@dataclass(frozen=True)
class _Axis:
    """New pixels along an axis, and the old ones around each, the taps."""

    index: Tensor  # (new, taps)
    weight: Tensor
    around: tuple[int, int]  # numbers of the two taps on either side of the new pixel's centre


def _find_axis(old: int, new: int, like: Tensor) -> _Axis:
    """Return the taps that resize an axis of ``old`` pixels to ``new`` ones."""
    centre = (torch.arange(new, dtype=torch.float64) + 0.5) * (old / new) - 0.5
    outside = (centre - centre.clamp(0, old - 1)).abs()
    radius = torch.where(outside > 0, outside + _BORDER_RADIUS, 1.0).clamp(min=old / new)
    most = math.ceil(float(radius.max()))
    index = centre.floor().long()[:, None] + torch.arange(1 - most, most + 1)
    offset = index - centre[:, None]
    weight = (1 - offset.abs() / radius[:, None]).clamp(min=0)
    weight = torch.where((index >= 0) & (index < old), weight, 0)
    total = weight.sum(dim=1, keepdim=True)  # of the weighted least-squares line, the value at offset 0
    mean = (weight * offset).sum(dim=1, keepdim=True) / total
    variance = (weight * (offset - mean).square()).sum(dim=1, keepdim=True) / total
    slope = torch.where(variance > 1e-9, -mean / variance.clamp(min=1e-9), 0)
    weight = (weight / total * (1 + slope * (offset - mean))).to(like)
    return _Axis(index.clamp(0, old - 1).to(like.device), weight, (most - 1, most))


def _resize_strip(x: Tensor, rows: _Axis, columns: _Axis, jump: float) -> Tensor:
    """Resize (1, H, W) to (1, new rows, new columns)."""
    bend = torch.zeros_like(x)  # the larger of the second differences along the rows and the columns
    for dim in (-2, -1):
        if x.shape[dim] > 2:
            inner = bend.narrow(dim, 1, x.shape[dim] - 2)
            torch.maximum(inner, x.diff(n=2, dim=dim).abs_(), out=inner)
    mean, bend = _along(*_along(x, bend, columns, -1), rows, -2)
    best = torch.full_like(mean, torch.inf)
    nearest = mean.clone()
    for i in rows.around:
        for j in columns.around:
            value = x[:, rows.index[:, i]][:, :, columns.index[:, j]]
            distance = (value - mean).abs()
            nearest = torch.where(distance < best, value, nearest)
            best = torch.minimum(best, distance)
    return torch.where(bend > jump * mean.abs(), nearest, mean)


def _along(x: Tensor, bend: Tensor, axis: _Axis, dim: int) -> tuple[Tensor, Tensor]:
    """Return the weighted mean of the old pixels around each new one along ``dim``, and the largest bend."""
    shape = (-1, 1) if dim == -2 else (-1,)
    sizes = [len(axis.index) if n == x.dim() + dim else size for n, size in enumerate(x.shape)]
    mean, largest = x.new_zeros(sizes), x.new_zeros(sizes)
    for tap in range(axis.index.shape[1]):
        index, weight = axis.index[:, tap], axis.weight[:, tap].view(shape)
        mean.addcmul_(x.index_select(dim, index), weight)
        torch.maximum(largest, bend.index_select(dim, index) * (weight != 0), out=largest)
    return mean, largest
