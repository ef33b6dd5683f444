"""The displacement of a depth map against its photo: a shift and a change of scale, found from edges, and undone.

At each jump of depth between two neighbouring pixels, the photo's gradient in the same direction is read. The mean
gradient has a distinct maximum at one shift. A search over whole pixels and steps of scale, by Fourier transforms, is
refined to fractions of a pixel. A displacement counts only if the gain is significant, which is estimated from tiles of
the image; a change of scale only if it gains beyond the best shift.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.notes import LIMITS

Array = NDArray[np.float64]
Gradients = tuple[Array, Array]  # of a photo to the right, (H, W - 1), and down, (H - 1, W)

JUMP = 0.03  # relative difference of neighbouring depths from which on it is an edge
WORKING_SIZE = 800  # longer side in pixels at which edges are compared
SHIFT = LIMITS["edges-beside"]  # pixels of the photo, at most WORKING_SIZE on its longer side
_APART = 4  # minimum distance in pixels of another shift from the best one
_TILE, _MOST_EDGES = 32, 20_000
_LEAST_EDGES, _LEAST_TILES = 300, 12  # fewer edges, or parts with edges, are not compared with a photo's
_MAX_SHIFT = 0.08  # largest shift as a fraction of the longer side: of a Kinect that was never registered
_LEAST_RADIUS = 4  # smallest radius of the search in pixels of the depth map
_SCALES = tuple(1 + step / 200 for step in range(-10, 11))
_WEAK = 2.0  # standard errors below which a shift along one axis is left out: its edges may all run along that axis
_ABOVE_SHIFT = 2.5  # standard errors by which a displacement with a scale must exceed the best shift
_MUCH = 1.1  # ratio of the gradients with a scale to those without, above which one standard error is enough
_COARSE = 2  # step of the search for the best shift in working pixels
_SMALLEST = 0.3  # smallest displacement of a corner that is undone, in low-resolution pixels
_SHADOW = 0.02  # width of the widest shadow beside an edge as a fraction of the longer side
_SAME_SURFACE = 0.02  # relative difference of inverse depth up to which neighbours are averaged
# a displacement is certain if its gradients are so many times those of a typical shift, and larger by so many standard
# errors than those of a typical shift, of the best other shift, and of none; 5 of 383 right pairs have one
_CONTRAST, _BY_CHANCE, _BY_OTHERS, _BY_NONE = 1.2, 2.8, 2.0, 3.0


@dataclass(frozen=True)
class Displacement:
    """Where the photo shows a point of the depth map, in pixels of the map: p -> c + scale (p - c) + (right, down)."""

    right: float  # shift from depth edges to the photo's edges, in pixels of the depth map
    down: float
    scale: float = 1.0  # about the middle c of the map
    certain: bool = False  # agreement is significantly better there than elsewhere, and than with no displacement
    visible: bool = False  # certain, at least a pixel of the depth map, and large enough to see in the photo
    moved: float = 0.0  # of a corner, in pixels of the photo, at most ``WORKING_SIZE`` on its longer side

    def __str__(self) -> str:
        across = f"{abs(self.right):.1f} px to the {'right' if self.right > 0 else 'left'}"
        down = f"{abs(self.down):.1f} px {'down' if self.down > 0 else 'up'}"
        return f"{across}, {down}" + (f", scale {self.scale:.4f}" if self.scale != 1 else "")


class Edges(NamedTuple):
    """Edges of a depth map in pixels of a photo: rows and columns, (2, N), of pixels where its gradients are read."""

    right: Array  # the pixels whose right neighbour has another depth
    below: Array  # likewise the lower one


@dataclass(frozen=True)
class _Comparison:
    """Depth edges, the tile of each, and a photo's gradients at one working size, (height, width)."""

    edges: Edges
    tiles: np.ndarray
    gradients: Gradients
    size: tuple[int, int]
    pixel: int  # width of a pixel of the depth map in working pixels
    radius: int  # largest shift

    def scaled(self, scale: float) -> Edges:
        """Return the edges scaled about the middle."""
        middle = (np.array(self.size)[:, None] - 1) / 2
        half = np.array([[0.0], [0.5]])
        right = middle + scale * (self.edges.right + half - middle) - half
        below = middle + scale * (self.edges.below + half[::-1] - middle) - half[::-1]
        return Edges(right, below)

    def sums(self, down: float, right: float, scale: float, gradients: Gradients | None = None) -> Array:
        """Return the gradients at the displaced edges, summed by tile; 0 outside the photo."""
        edges, shift = self.scaled(scale), np.array((down, right))[:, None]
        found = [
            ndimage.map_coordinates(gradient, places + shift, order=1, mode="constant")
            for places, gradient in zip(edges, gradients or self.gradients, strict=True)
        ]
        return np.asarray(np.bincount(self.tiles, np.concatenate(found)), dtype=np.float64)


def find_displacement(depth_lr: Tensor, rgb: Tensor) -> Displacement | None:
    """Find where the photo, (3, H, W) in [0, 1], shows the edges of a depth map, (1, h, w) in metres, NaN in holes.

    Both have the same field of view. Returns the best displacement up to 8 % of the longer side and 5 % of scale; None
    if there are not enough depth edges to compare.
    """
    every = math.ceil(max(depth_lr.shape[-2:]) / WORKING_SIZE)
    depth = depth_lr[0, every // 2 :: every, every // 2 :: every].double().cpu().numpy()
    height, width = depth.shape
    ratio = min(rgb.shape[-2] / (height * every), rgb.shape[-1] / (width * every))
    factor = max(min(WORKING_SIZE // max(height, width), math.floor(ratio)), 1)
    size = (factor * height, factor * width)
    radius = max(round(max(size) * _MAX_SHIFT), _LEAST_RADIUS * factor)
    found = find_edges(depth, math.ceil(radius / factor), max(round(_SHADOW * max(depth.shape)), 1))
    middle = (factor - 1) / 2
    right = np.stack((factor * found.right[0] + middle, factor * (found.right[1] + 1) - 1))
    below = np.stack((factor * (found.below[0] + 1) - 1, factor * found.below[1] + middle))
    places = (np.concatenate((right, below), axis=1) // _TILE).astype(np.intp)
    tiles = np.unique(places, axis=1, return_inverse=True)[1].ravel()
    if len(tiles) < _LEAST_EDGES or int(tiles.max()) + 1 < _LEAST_TILES:
        return None
    photo = functional.interpolate(rgb[None].float().cpu(), size, mode="bilinear", antialias=True)[0]
    blurred = ndimage.gaussian_filter(photo.double().numpy(), (0, 0.7, 0.7))
    largest = np.abs(np.diff(blurred, axis=2)).max(axis=0), np.abs(np.diff(blurred, axis=1)).max(axis=0)  # of channels
    local = [np.minimum(each / (ndimage.uniform_filter(each, 31) + 0.01), 4) for each in largest]
    comparison = _Comparison(Edges(right, below), tiles, (local[0], local[1]), size, factor, radius)
    down, across, scale = best = _search(comparison)
    sums = comparison.sums(*best)
    for simpler in ((0.0, 0.0, 1.0), (0.0, across, scale), (down, 0.0, scale)):
        if simpler != best and _standard_errors(sums - comparison.sums(*simpler)) < _WEAK:
            best = simpler
            break
    certain, corner = _judge(comparison, best)
    back = every / factor
    moved = corner * min(max(rgb.shape[-2:]), WORKING_SIZE) / max(size)
    visible = certain and corner >= max(SHIFT, factor)  # the working size has no more pixels than the photo
    return Displacement(best[1] * back, best[0] * back, best[2], certain, visible, moved)


def undo(depth_lr: Tensor, displacement: Displacement) -> Tensor:
    """Move a depth map, (1, h, w) with NaN in holes, to where the photo shows it, without mixing surfaces.

    Inverse depth is interpolated linearly between pixels of one surface. At a step the nearer or the farther surface is
    taken, whichever covers more of the new pixel. A pixel most of which is a hole, or outside the map, becomes a hole.
    """
    height, width = depth_lr.shape[-2:]
    middle_v, middle_u = (height - 1) / 2, (width - 1) / 2
    v = torch.arange(height, dtype=torch.float64) - middle_v - displacement.down
    u = torch.arange(width, dtype=torch.float64) - middle_u - displacement.right
    v, u = v / displacement.scale + middle_v, u / displacement.scale + middle_u
    inverse = functional.pad(depth_lr.double().cpu().reciprocal(), (1, 1, 1, 1), value=torch.nan)[0]
    rows, columns = v.floor().clamp(-1, height - 1), u.floor().clamp(-1, width - 1)
    down, right = (v - rows).clamp(0, 1), (u - columns).clamp(0, 1)
    found, shares = [], []
    for i in (0, 1):
        for j in (0, 1):
            found.append(inverse[(rows.long() + 1 + i)[:, None], (columns.long() + 1 + j)[None]])
            shares.append((down if i else 1 - down)[:, None] * (right if j else 1 - right))
    values, weights = torch.stack(found), torch.stack(shares)
    valid = values.isfinite()  # of the four pixels, the mean of that surface which has most weight
    low = torch.where(valid, values, torch.inf).amin(0)
    high = torch.where(valid, values, -torch.inf).amax(0)
    step = high - low > _SAME_SURFACE * high
    near = valid & (~step | (values > (low + high) / 2))
    far = valid & step & ~near
    near_share, far_share = (weights * near).sum(0), (weights * far).sum(0)
    near_mean = (weights * torch.where(near, values, 0)).sum(0) / near_share.clamp(min=1e-12)
    far_mean = (weights * torch.where(far, values, 0)).sum(0) / far_share.clamp(min=1e-12)
    chosen = torch.where(near_share >= far_share, near_mean, far_mean)
    moved = torch.where(near_share + far_share >= 0.5, chosen, torch.nan).reciprocal()
    outside = (v < -0.5) | (v > height - 0.5), (u < -0.5) | (u > width - 0.5)
    return moved.masked_fill(outside[0][:, None] | outside[1], torch.nan)[None].to(depth_lr)


def find_edges(depth: Array, margin: int, gap: int) -> Edges:
    """Return the jumps of depth, (H, W) with NaN in holes, away from the border; a subset if there are very many.

    ``margin`` is the smallest distance from the border in pixels, ``gap`` the widest hole in pixels across which a jump
    counts, as a sensor's shadow beside an edge: the edge is then where the nearer surface ends.
    """
    safe = np.ones(depth.shape, bool)
    safe[:margin] = safe[-margin:] = safe[:, :margin] = safe[:, -margin:] = False
    right = _jumps(depth, safe, gap)
    below = _jumps(depth.T, safe.T, gap)[::-1]
    every = math.ceil((right.shape[1] + below.shape[1]) / _MOST_EDGES) or 1
    return Edges(right[:, ::every], below[:, ::every])


def _jumps(depth: Array, safe: NDArray[np.bool_], gap: int) -> Array:
    """Return rows and columns (2, N) of the pixels after which depth jumps along a row."""
    columns = np.arange(depth.shape[1])
    last = np.maximum.accumulate(np.where(np.isnan(depth), -1, columns), axis=1)[:, :-1]  # valid pixel up to each
    here, there = np.take_along_axis(depth, last.clip(0), axis=1), depth[:, 1:]
    with np.errstate(invalid="ignore"):
        jump = np.abs(there - here) > JUMP * np.fmin(here, there)
    rows, after = np.nonzero(jump & (last >= 0) & (columns[:-1] - last <= gap))
    before = last[rows, after]
    place = np.where(depth[rows, before] < depth[rows, after + 1], before, after)
    kept = safe[rows, before] & safe[rows, after + 1]
    return np.stack((rows[kept], place[kept])).astype(np.float64)


def _mean_gradients(each: Iterable[Edges], gradients: Gradients, radius: int) -> Iterator[Array]:
    """Yield the mean gradient at some edges for every shift down and right up to a radius, (2 r + 1, 2 r + 1)."""
    largest = np.max([gradient.shape for gradient in gradients], axis=0)
    height, width = (cv2.getOptimalDFTSize(int(n) + radius + 1) for n in largest)  # no shift wraps around
    spectra = [np.fft.rfft2(gradient, (height, width)) for gradient in gradients]
    shifts = np.arange(-radius, radius + 1)
    for edges in each:
        total = np.zeros((height, width // 2 + 1), complex)
        for (rows, columns), spectrum in zip(edges, spectra, strict=True):
            row = np.clip(np.rint(rows).astype(np.intp), 0, height - 1)
            column = np.clip(np.rint(columns).astype(np.intp), 0, width - 1)
            there = np.bincount(row * width + column, minlength=height * width).reshape(height, width)
            total += spectrum * np.conj(np.fft.rfft2(there))
        near = np.fft.ifft(total, axis=0)[shifts]
        count = edges.right.shape[1] + edges.below.shape[1]
        yield np.fft.irfft(near, width, axis=1)[:, shifts] / max(count, 1)


def _standard_errors(gains: Array) -> float:
    return float(gains.sum() / max(np.sqrt(np.square(gains).sum()), 1e-12))


def _search(comparison: _Comparison) -> tuple[float, float, float]:
    """Return the best shift down and right with its scale, which is 1 unless another one clearly gains."""
    blur = 0.5 * comparison.pixel + 0.3  # about the uncertainty of an edge in the depth map
    right, below = (ndimage.gaussian_filter(gradient, blur) for gradient in comparison.gradients)
    scaled = (comparison.scaled(scale) for scale in _SCALES)
    coarse = (Edges(edges.right / _COARSE, edges.below / _COARSE) for edges in scaled)
    reach = comparison.radius // _COARSE
    every = slice(None, None, _COARSE), slice(None, None, _COARSE)
    starts = []
    for scale, mean in zip(_SCALES, _mean_gradients(coarse, (right[every], below[every]), reach), strict=True):
        row, column = np.unravel_index(mean.argmax(), mean.shape)
        starts.append((float(mean.max()), float(_COARSE * (row - reach)), float(_COARSE * (column - reach)), scale))
    shift = _refine(comparison, (right, below), starts[_SCALES.index(1.0)][1:], scaling=False)
    similar = max(
        (_refine(comparison, (right, below), start, scaling=True) for start in {max(starts)[1:], shift}),
        key=lambda each: float(comparison.sums(*each).sum()),
    )
    with_scale, without = comparison.sums(*similar), comparison.sums(*shift)
    errors = _standard_errors(with_scale - without)
    better = errors > _ABOVE_SHIFT or (errors > 1 and with_scale.sum() > _MUCH * without.sum())
    return similar if better else shift


def _refine(
    comparison: _Comparison, gradients: Gradients, start: tuple[float, float, float], *, scaling: bool
) -> tuple[float, float, float]:
    """Return down, right and scale with the largest gradients near a start, to fractions of a pixel."""
    from scipy import optimize  # noqa: PLC0415 - a quarter of a second where no edges are compared

    reach = max(comparison.size) / 2  # pixels by which the border moves for twice the scale

    def loss(x: Array) -> float:
        scale = x[2] / reach if scaling else start[2]
        return -float(comparison.sums(x[0], x[1], scale, gradients).sum()) / len(comparison.tiles)

    first = np.array((start[0], start[1], start[2] * reach)[: 3 if scaling else 2])
    simplex = np.stack((first, *(first + 1.5 * comparison.pixel**0.5 * axis for axis in np.eye(len(first)))))
    options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-6, "maxfev": 150}
    best = optimize.minimize(loss, first, method="Nelder-Mead", options=options).x
    return float(best[0]), float(best[1]), float(best[2] / reach) if scaling else start[2]


def _judge(comparison: _Comparison, found: tuple[float, float, float]) -> tuple[bool, float]:
    """Return whether a displacement is significant, and by how many working pixels it moves a corner."""
    (down, right, scale), radius = found, comparison.radius
    sums = comparison.sums(*found)
    [mean] = _mean_gradients([comparison.scaled(scale)], comparison.gradients, radius)
    median = float(np.median(mean))
    shifts = np.arange(-radius, radius + 1)
    apart = max(_APART, 2 * comparison.pixel)
    near = (np.abs(shifts - down) <= apart)[:, None] & (np.abs(shifts - right) <= apart)
    other = np.unravel_index(np.where(near, -1, mean).argmax(), mean.shape)
    elsewhere = comparison.sums(float(other[0] - radius), float(other[1] - radius), scale)
    counts = np.bincount(comparison.tiles)
    middle = (np.array(comparison.size) - 1) / 2
    corner = float(max(abs(down) + abs(scale - 1) * middle[0], abs(right) + abs(scale - 1) * middle[1]))
    certain = (
        sums.sum() > _CONTRAST * median * counts.sum()
        and _standard_errors(sums - median * counts) > _BY_CHANCE
        and _standard_errors(sums - elsewhere) > _BY_OTHERS
        and _standard_errors(sums - comparison.sums(0, 0, 1)) > _BY_NONE
        and max(abs(down), abs(right)) < radius
        and corner >= _SMALLEST * comparison.pixel
    )
    return bool(certain), corner
