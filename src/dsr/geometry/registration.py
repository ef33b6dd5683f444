"""The displacement of a depth map against its photo: a shift and a change of scale, found from edges, and undone.

The photo's gradients at the depth edges, see :mod:`dsr.geometry.edges`, are largest where the two match. A search over
whole pixels and steps of scale, by Fourier transforms, is refined to fractions of a pixel. A displacement counts only
where the gain is significant; a change of scale only where it gains beyond the best shift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.geometry.edges import (
    APART,
    SHIFT,
    WORKING_SIZE,
    Array,
    Edges,
    edge_gradients,
    find_edges,
    mean_gradients,
    standard_errors,
    sum_by_tile,
)
from dsr.notes import LIMITS

_MAX_SHIFT = 0.08
"""Largest shift as a fraction of the longer side: of a Kinect whose colour and depth were never registered."""
_LEAST_RADIUS = 4
"""Smallest radius of the search in pixels of the depth map."""
_SCALES = tuple(1 + step / 200 for step in range(-10, 11))
"""Scales that are searched, in steps of 0.5 %."""
_WEAK = 2.0
"""Standard errors below which a shift along one axis is left out: its edges may all run along that axis."""
_ABOVE_SHIFT = 2.5
"""Standard errors by which a displacement with a scale must exceed the best shift."""
_MUCH = 1.1
"""Factor of the gradients that is a lot for a change of scale to gain."""
_COARSE = 2
"""Step of the search for the best shift in working pixels."""
_SMALLEST = 0.3
"""Smallest displacement of a corner that is undone, in low-resolution pixels."""
_SHADOW = 0.02
"""Width of the widest shadow beside an edge as a fraction of the longer side."""
_SAME_SURFACE = 0.02
"""Relative difference of inverse depth up to which neighbours are averaged."""


@dataclass(frozen=True)
class Displacement:
    """Where the photo shows a point of the depth map, in pixels of the map: p -> c + scale (p - c) + (right, down).

    Args:
        right, down: shift from depth edges to the photo's edges, in pixels of the depth map.
        scale: about the middle c of the map.
        certain: whether photo and depth agree significantly better there than elsewhere, and than with no displacement.
        visible: whether it is at least a pixel of the depth map and one that the eye sees in the photo.
        moved: how far it moves a corner, in pixels of the photo, at most ``WORKING_SIZE`` on its longer side.

    """

    right: float
    down: float
    scale: float = 1.0
    certain: bool = False
    visible: bool = False
    moved: float = 0.0

    def __str__(self) -> str:
        """Return the displacement of depth that is undone, for people."""
        across = f"{abs(self.right):.1f} px to the {'right' if self.right > 0 else 'left'}"
        down = f"{abs(self.down):.1f} px {'down' if self.down > 0 else 'up'}"
        return f"{across}, {down}" + (f", scale {self.scale:.4f}" if self.scale != 1 else "")


@dataclass(frozen=True)
class _Comparison:
    """Depth edges and a photo at one working size.

    Args:
        edges: in pixels of the working photo.
        gradients: of the photo to the right and down.
        tiles: of each edge.
        size: height and width of the working photo.
        whole: longer side of the photo, at most ``WORKING_SIZE``.
        pixel: width of a pixel of the depth map in working pixels.

    """

    edges: Edges
    gradients: tuple[Array, Array]
    tiles: np.ndarray
    size: tuple[int, int]
    whole: int
    pixel: float

    def scaled(self, scale: float) -> Edges:
        """Return the edges scaled about the middle."""
        middle = (np.array(self.size)[:, None] - 1) / 2
        half = np.array([[0.0], [0.5]])
        right, below = (
            middle + scale * (places + offset - middle) - offset
            for places, offset in ((self.edges.right, half), (self.edges.below, half[::-1]))
        )
        return Edges(right, below)

    def sums(self, down: float, right: float, scale: float) -> Array:
        """Return the gradients at the displaced edges, summed by tile."""
        return sum_by_tile(self.scaled(scale), self.gradients, self.tiles, (down, right))


def find_displacement(depth_lr: Tensor, rgb: Tensor) -> Displacement | None:
    """Find where the photo shows the edges of a depth map.

    Args:
        depth_lr: (1, h, w) in metres, NaN in holes, any size up to the photo's.
        rgb: (3, H, W) in [0, 1], of the same field of view.

    Returns:
        The best displacement up to 8 % of the longer side and 5 % of scale; None where there are not enough depth
        edges to compare.

    """
    every = math.ceil(max(depth_lr.shape[-2:]) / WORKING_SIZE)
    comparison = _compare(depth_lr[0, every // 2 :: every, every // 2 :: every].double().cpu().numpy(), rgb, every)
    if comparison is None:
        return None
    blurred = _blurred(comparison)
    radius = _radius(comparison.size, comparison.pixel)
    coarse = _best_shifts(comparison, blurred, radius)
    shift = _refine(comparison, blurred, coarse[_SCALES.index(1.0)][1:], scaling=False)
    starts = {max(coarse)[1:], shift}
    similar = max((_refine(comparison, blurred, start, scaling=True) for start in starts),
                  key=lambda each: float(comparison.sums(*each).sum()))  # fmt: skip
    found = similar if _is_better(comparison.sums(*similar), comparison.sums(*shift)) else shift
    return _judge(comparison, _without_weak_axis(comparison, found), radius, every)


def undo(depth_lr: Tensor, displacement: Displacement) -> Tensor:
    """Move a depth map to where the photo shows it, without mixing surfaces.

    Inverse depth is interpolated linearly between pixels of one surface. At a step the nearer or the farther surface is
    taken, whichever covers more of the new pixel. A pixel most of which is a hole, or outside the map, becomes a hole.

    Args:
        depth_lr: (1, h, w) in metres, NaN in holes.
        displacement: of the photo's edges from those of the map.

    Returns:
        (1, h, w) in metres, NaN in holes.

    """
    height, width = depth_lr.shape[-2:]
    v, u = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2 - shift) / displacement.scale + (n - 1) / 2
        for n, shift in ((height, displacement.down), (width, displacement.right))
    )
    inverse = functional.pad(depth_lr.double().cpu().reciprocal(), (1, 1, 1, 1), value=torch.nan)[0]
    rows, columns = (place.floor().clamp(-1, n - 1) for place, n in ((v, height), (u, width)))
    down, right = (v - rows).clamp(0, 1), (u - columns).clamp(0, 1)
    values, weights = [], []
    for i in (0, 1):
        for j in (0, 1):
            values.append(inverse[(rows.long() + 1 + i)[:, None], (columns.long() + 1 + j)[None]])
            weights.append((down if i else 1 - down)[:, None] * (right if j else 1 - right))
    moved = _majority(torch.stack(values), torch.stack(weights)).reciprocal()
    outside = (v < -0.5) | (v > height - 0.5), (u < -0.5) | (u > width - 0.5)
    return moved.masked_fill(outside[0][:, None] | outside[1], torch.nan)[None].to(depth_lr)


def _majority(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of that surface of four pixels which has most weight; NaN where holes have most."""
    valid = values.isfinite()
    low = torch.where(valid, values, torch.inf).amin(0)
    high = torch.where(valid, values, -torch.inf).amax(0)
    step = high - low > _SAME_SURFACE * high
    near = valid & (~step | (values > (low + high) / 2))
    far = valid & step & ~near
    shares = [(weights * part).sum(0) for part in (near, far)]
    means = [(weights * torch.where(part, values, 0)).sum(0) / share.clamp(min=1e-12)
             for part, share in zip((near, far), shares, strict=True)]  # fmt: skip
    chosen = torch.where(shares[0] >= shares[1], means[0], means[1])
    return torch.where(shares[0] + shares[1] >= 0.5, chosen, torch.nan)


def _compare(depth: Array, rgb: Tensor, every: int) -> _Comparison | None:
    """Return depth edges and photo at the working size; None with too few edges."""
    height, width = depth.shape
    ratio = min(rgb.shape[-2] / (height * every), rgb.shape[-1] / (width * every))
    factor = max(min(WORKING_SIZE // max(height, width), math.floor(ratio)), 1)
    size = (factor * height, factor * width)
    edges = find_edges(depth, math.ceil(_radius(size, factor) / factor), _gap(depth.shape)).scale_up(factor)
    if not edges.enough():
        return None
    photo = functional.interpolate(rgb[None].float().cpu(), size, mode="bilinear", antialias=True)[0]
    whole = min(max(rgb.shape[-2:]), WORKING_SIZE)
    return _Comparison(edges, edge_gradients(photo.double().numpy()), edges.tiles(), size, whole, float(factor))


def _gap(size: tuple[int, ...]) -> int:
    """Return the width in pixels of the widest shadow beside an edge."""
    return max(round(_SHADOW * max(size)), 1)


def _radius(size: tuple[int, int], factor: float) -> int:
    """Return the largest shift in working pixels, ``factor`` of which are a pixel of the depth map."""
    return max(round(max(size) * _MAX_SHIFT), round(_LEAST_RADIUS * factor))


def _blurred(comparison: _Comparison) -> tuple[Array, Array]:
    """Return the gradients blurred by about the uncertainty of an edge in the depth map."""
    right, below = (ndimage.gaussian_filter(each, 0.5 * comparison.pixel + 0.3) for each in comparison.gradients)
    return right, below


def _best_shifts(
    comparison: _Comparison, gradients: tuple[Array, Array], radius: int
) -> list[tuple[float, float, float, float]]:
    """Return for each scale the largest mean gradient of shifts by every second pixel, down, right and the scale."""
    right, below = (each[::_COARSE, ::_COARSE] for each in gradients)
    scaled = (comparison.scaled(scale) for scale in _SCALES)
    coarse = (Edges(edges.right / _COARSE, edges.below / _COARSE) for edges in scaled)
    found = []
    for scale, mean in zip(_SCALES, mean_gradients(coarse, (right, below), radius // _COARSE), strict=True):
        row, column = np.unravel_index(mean.argmax(), mean.shape)
        down, across = (float(_COARSE * (place - radius // _COARSE)) for place in (row, column))
        found.append((float(mean.max()), down, across, scale))
    return found


def _is_better(similar: Array, shift: Array) -> bool:
    """Return whether the gradients of the tiles support a change of scale: significantly, or plausibly and by much."""
    errors = standard_errors(similar - shift)
    return errors > _ABOVE_SHIFT or (errors > 1 and similar.sum() > _MUCH * shift.sum())


def _refine(
    comparison: _Comparison, gradients: tuple[Array, Array], start: tuple[float, float, float], *, scaling: bool
) -> tuple[float, float, float]:
    """Return down, right and scale with the largest gradients near a start, to fractions of a pixel."""
    from scipy import optimize  # noqa: PLC0415 - a quarter of a second where no edges are compared

    reach = max(comparison.size) / 2  # pixels by which the border moves for twice the scale

    def loss(x: Array) -> float:
        edges = comparison.scaled(x[2] / reach if scaling else start[2])
        return -float(sum_by_tile(edges, gradients, comparison.tiles, (x[0], x[1])).sum()) / edges.count

    first = np.array((start[0], start[1], start[2] * reach)[: 3 if scaling else 2])
    simplex = np.stack((first, *(first + 1.5 * comparison.pixel**0.5 * axis for axis in np.eye(len(first)))))
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-6, "maxfev": 150}
    best = optimize.minimize(loss, first, method="Nelder-Mead", options=options).x
    return float(best[0]), float(best[1]), float(best[2] / reach) if scaling else start[2]


def _without_weak_axis(comparison: _Comparison, found: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the displacement without its shift along an axis on which the evidence for it is weak."""
    down, right, scale = found
    sums = comparison.sums(*found)
    for simpler in ((0.0, 0.0, 1.0), (0.0, right, scale), (down, 0.0, scale)):
        if simpler != found and standard_errors(sums - comparison.sums(*simpler)) < _WEAK:
            return simpler
    return found


def _judge(comparison: _Comparison, found: tuple[float, float, float], radius: int, every: int) -> Displacement:
    """Return a displacement in pixels of the map, and whether it is significant."""
    down, right, scale = found
    sums = comparison.sums(*found)
    [mean] = mean_gradients([comparison.scaled(scale)], comparison.gradients, radius)
    median = float(np.median(mean))
    shifts = np.arange(-radius, radius + 1)
    apart = max(APART, round(2 * comparison.pixel))
    near = (np.abs(shifts - down) <= apart)[:, None] & (np.abs(shifts - right) <= apart)
    other = np.unravel_index(np.where(near, -1, mean).argmax(), mean.shape)
    elsewhere = comparison.sums(float(other[0] - radius), float(other[1] - radius), scale)
    counts = np.bincount(comparison.tiles)
    middle = (np.array(comparison.size) - 1) / 2
    corner = max(abs(down) + abs(scale - 1) * middle[0], abs(right) + abs(scale - 1) * middle[1])
    certain = (
        sums.sum() > LIMITS["edges-beside.contrast"].threshold * median * counts.sum()
        and standard_errors(sums - median * counts) > LIMITS["edges-beside.chance"].threshold
        and standard_errors(sums - elsewhere) > LIMITS["edges-beside.others"].threshold
        and standard_errors(sums - comparison.sums(0, 0, 1)) > LIMITS["edges-beside.none"].threshold
        and max(abs(down), abs(right)) < radius
        and corner >= _SMALLEST * comparison.pixel
    )
    back = every / comparison.pixel
    moved = float(corner) * comparison.whole / max(comparison.size)
    visible = corner >= max(SHIFT, comparison.pixel)  # at the working size, which has no more pixels than the photo
    return Displacement(right * back, down * back, scale, bool(certain), bool(certain and visible), moved)
