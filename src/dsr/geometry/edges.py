"""Agreement of the edges of a depth map with those of a photo, as a function of a shift between the two.

At each jump of depth between two neighbouring pixels, the photo's gradient in the same direction is read, for every
shift of the photo within a window. If photo and depth belong together, the mean gradient has a distinct maximum at one
shift. Its significance is estimated from tiles of the image, because the pixels of a contour are correlated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dsr.notes import LIMITS

Array = NDArray[np.float64]

JUMP = 0.03
"""Relative difference of neighbouring depths that counts as an edge."""
WORKING_SIZE = 800
"""Longer side in pixels at which edges are compared."""
SHIFT = LIMITS["edges-beside"].threshold
"""Shift between photo and depth that is reported, in pixels of the photo, at most so many on its longer side."""
APART = 4
"""Minimum distance in pixels of another shift from the best one."""
_TILE, _MOST_EDGES = 32, 20_000


@dataclass(frozen=True)
class Edges:
    """The edges of a depth map in pixels of a photo: where its gradients to the right, and down, are read.

    Args:
        right: (2, N) rows and columns in the map of gradients to the right, of pixels whose right neighbour has another
            depth.
        below: (2, N) rows and columns in the map of gradients down, of pixels whose neighbour below has another depth.

    """

    right: Array
    below: Array

    @property
    def count(self) -> int:
        """The number of edges."""
        return int(self.right.shape[1] + self.below.shape[1])

    def tiles(self) -> NDArray[np.intp]:
        """Return the index of the tile of each edge, first of ``right``, then of ``below``."""
        places = (np.concatenate((self.right, self.below), axis=1) // _TILE).astype(np.intp)
        return np.unique(places, axis=1, return_inverse=True)[1].ravel()

    def enough(self) -> bool:
        """Return whether there are enough edges, in enough places, to compare them with a photo's."""
        few = self.count < LIMITS["edges-beside.edges"].threshold
        return not few and int(self.tiles().max()) + 1 >= LIMITS["edges-beside.tiles"].threshold

    def scale_up(self, factor: int) -> Edges:
        """Return the edges in pixels of a photo that is a whole factor larger than the depth map."""
        middle = (factor - 1) / 2
        right = np.stack((factor * self.right[0] + middle, factor * (self.right[1] + 1) - 1))
        below = np.stack((factor * (self.below[0] + 1) - 1, factor * self.below[1] + middle))
        return Edges(right, below)


def find_edges(depth: Array, margin: int, gap: int | None = None) -> Edges:
    """Return the jumps of depth away from the border; a regular subset if there are very many.

    Args:
        depth: (H, W) in metres, NaN in holes.
        margin: smallest distance from the border in pixels.
        gap: widest hole in pixels across which a jump counts, as a sensor's shadow beside an edge: the edge is then
            where the nearer surface ends. None to leave out jumps within two pixels of a hole.

    """
    safe = np.ones(depth.shape, bool) if gap is not None else ~ndimage.binary_dilation(np.isnan(depth), iterations=2)
    safe[:margin] = safe[-margin:] = safe[:, :margin] = safe[:, -margin:] = False
    right = _jumps(depth, safe, gap or 0)
    below = _jumps(depth.T, safe.T, gap or 0)[::-1]
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


def edge_gradients(photo: Array, smooth: float = 0.7) -> tuple[Array, Array]:
    """Return the largest gradients of a photo's channels to the right and down, relative to their local mean, up to 4.

    Args:
        photo: (3, H, W).
        smooth: standard deviation of the blur before differences are taken, in pixels.

    Returns:
        (H, W - 1) and (H - 1, W).

    """
    blurred = ndimage.gaussian_filter(photo, (0, smooth, smooth))
    right, below = (np.abs(np.diff(blurred, axis=axis)).max(axis=0) for axis in (2, 1))
    ratios = [np.minimum(gradient / (ndimage.uniform_filter(gradient, 31) + 0.01), 4) for gradient in (right, below)]
    return ratios[0], ratios[1]


def mean_gradients(each: Iterable[Edges], gradients: tuple[Array, Array], radius: int) -> Iterator[Array]:
    """Yield the mean gradient at some edges for every shift down and right up to a radius, (2 r + 1, 2 r + 1)."""
    largest = np.max([gradient.shape for gradient in gradients], axis=0)
    height, width = (cv2.getOptimalDFTSize(int(n) + radius + 1) for n in largest)  # no shift wraps around
    spectra = [np.fft.rfft2(gradient, (height, width)) for gradient in gradients]
    shifts = np.arange(-radius, radius + 1)
    for edges in each:
        total = np.zeros((height, width // 2 + 1), complex)
        for (rows, columns), spectrum in zip((edges.right, edges.below), spectra, strict=True):
            row, column = (
                np.clip(np.rint(place).astype(np.intp), 0, n - 1) for place, n in ((rows, height), (columns, width))
            )
            there = np.bincount(row * width + column, minlength=height * width).reshape(height, width)
            total += spectrum * np.conj(np.fft.rfft2(there))
        near = np.fft.ifft(total, axis=0)[shifts]
        yield np.fft.irfft(near, width, axis=1)[:, shifts] / max(edges.count, 1)


def sum_by_tile(
    edges: Edges, gradients: tuple[Array, Array], tiles: NDArray[np.intp], shift: tuple[float, float]
) -> Array:
    """Return the gradients at the edges, moved by a shift (down, right), summed by tile; 0 outside the photo."""
    found = [
        ndimage.map_coordinates(gradient, places + np.array(shift)[:, None], order=1, mode="constant")
        for places, gradient in zip((edges.right, edges.below), gradients, strict=True)
    ]
    return np.asarray(np.bincount(tiles, np.concatenate(found)), dtype=np.float64)


def standard_errors(gains: Array) -> float:
    """Return the sum over the tiles, in standard errors."""
    return float(gains.sum() / max(np.sqrt(np.square(gains).sum()), 1e-12))
