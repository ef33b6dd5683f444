"""RealSense's own filters: what the SDK of these stereo cameras does to their depth maps, with its defaults.

IntelRealSense/librealsense 2.59, without its decimation: depth becomes disparity in 1/32 pixel, d = 32 f B / z;

- spatial: Gastal, Oliveira, *Domain Transform for Edge-Aware Image and Video Processing*, SIGGRAPH 2011, in its
  recursive form, s_i = alpha d_i + (1 - alpha) s_(i-1) along each line, both ways, rows before columns, twice. It
  begins anew beside a hole and where neighbours differ by ``delta`` or more;
- temporal: the same over frames; a hole keeps the mean if the pixel had depth in two of the last four;
- holes: of the upper, lower and left neighbours of a hole, row by row, the farthest one.

What differs: results are not rounded to whole millimetres.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.classical.bilateral import MapFilter
from dsr.sample import DepthSample
from dsr.utils.guards import expect_positive

_STEPS = 32  # disparity steps in a pixel
_LEAST = 1e-9  # weight below which a pixel has no influence
_CREDIBLE, _RECENT = 2, 4  # frames with depth, of how many, after which a hole keeps the mean


@dataclass(eq=False)
class RealSense(MapFilter):
    """RealSense's filters of the low-resolution depth, and its interpolation where the scale is above 1."""

    alpha: float = 0.5
    delta: float = 20.0
    iterations: int = 2
    baseline: float = 0.05
    fill_holes: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        expect_positive(delta=self.delta, iterations=self.iterations, baseline=self.baseline)
        if not 0 < self.alpha <= 1:
            raise ValueError(f"alpha: expected a number above 0 and at most 1, got {self.alpha}")

    def filter_map(self, sample: DepthSample) -> Tensor:
        """Return the filtered depth, (1, h, w); of a single frame, so that the temporal filter changes nothing."""
        constant = _STEPS * (sample.camera_lr.baseline or self.baseline) * sample.camera_lr.fx
        depth = constant / filter_lines(constant / sample.depth_lr, self.alpha, self.delta, self.iterations)
        return fill_from_farthest(depth) if self.fill_holes else depth


def filter_lines(values: Tensor, alpha: float = 0.5, delta: float = 20.0, iterations: int = 2) -> Tensor:
    """Filter maps, (..., h, w) with NaN in holes, along rows and columns; see the module."""
    for _ in range(iterations):
        for axis in (-1, -2):
            lines = values.movedim(axis, -1)
            for _ in range(2):  # forth and back
                lines = _recur(lines, alpha, delta).flip(-1)
            values = lines.movedim(-1, axis)
    return values


def _recur(values: Tensor, alpha: float, delta: float) -> Tensor:
    """Return s_i = alpha d_i + (1 - alpha) s_(i-1) along the last axis, by sums of 2, 4, 8, ... pixels."""
    apart = (values.diff(dim=-1, prepend=torch.full_like(values[..., :1], torch.nan))).abs()
    rest = (1 - alpha) * (apart < delta).to(values)  # weight of the mean of the pixels before; 0 beside a hole
    mean, reach = (1 - rest) * torch.where(values.isfinite(), values, 0), 1
    while reach < values.shape[-1] and (1 - alpha) ** reach > _LEAST:
        earlier_mean, earlier_rest = (functional.pad(each, (reach, 0))[..., :-reach] for each in (mean, rest))
        mean, rest, reach = mean + rest * earlier_mean, rest * earlier_rest, 2 * reach
    return torch.where(values.isfinite(), mean, torch.nan)


def follow(values: Tensor, mean: Tensor, agree: Tensor, alpha: float) -> Tensor:
    """Return the mean after new values: alpha values + (1 - alpha) mean where they agree, else the values."""
    return torch.where(agree, mean.lerp(values, alpha), values)


def filter_frames(frames: Tensor, alpha: float = 0.4, delta: float = 20.0) -> Tensor:
    """Filter successive maps of a still camera, (T, ..., h, w) with NaN in holes, over time; see the module."""
    mean, found = torch.full_like(frames[0], torch.nan), []
    recent = torch.zeros((_RECENT, *mean.shape), dtype=torch.bool, device=mean.device)  # frames with depth, last first
    for values in frames:
        known = values.isfinite()
        agree = (values - mean).abs() < delta
        mean = torch.where(known, follow(values, mean, agree, alpha), mean)
        found.append(mean.masked_fill(~known & (recent.sum(0) < _CREDIBLE), torch.nan))
        recent = torch.cat((known[None], recent[:-1] & (agree | ~known)))
    return torch.stack(found)


def fill_from_farthest(depth: Tensor) -> Tensor:
    """Fill the holes, NaN, of maps, (..., h, w); first and last row and the first column stay."""
    rows, beyond = [depth[..., 0, :]], depth.nan_to_num(0).amax() + 1
    for values, below in zip(depth.unbind(-2)[1:-1], depth.unbind(-2)[2:], strict=True):
        near = torch.fmax(rows[-1], below)
        near = torch.fmax(near, functional.pad(near, (1, 0), value=torch.nan)[..., :-1])  # and those to their left
        known = values.isfinite()
        known[..., 0] = True
        start = torch.where(known, values, near).nan_to_num(0)
        place = (start.double() + beyond * known.cumsum(-1)).cummax(-1).indices
        row = start.gather(-1, place)  # in a hole the largest value since the last known pixel
        rows.append(torch.where(row > 0, row, torch.nan))
    return torch.stack([*rows, *depth.unbind(-2)[len(rows) :]], dim=-2)
