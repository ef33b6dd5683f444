"""Check of the registration of photo and depth: edges of the depth should coincide with edges of the photo.

At each jump of depth between two neighbouring pixels, the photo's gradient in the same direction is read, for every
shift of the photo within a window. If photo and depth belong together, the mean gradient has a distinct maximum at one
shift. Its significance is estimated from tiles of the image, because the pixels of a contour are correlated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dsr.doctor.finding import Array, Finding, metres
from dsr.sample import Scene

_JUMP = 0.03
"""Relative difference of neighbouring depths that counts as an edge."""
_WORKING_SIZE = 800
_MAX_SHIFT = 16 / 512
"""Largest shift as a fraction of the size."""
_SHIFT = 3
"""Shift between photo and depth that is reported, in working pixels."""
_TILE = 32
_LEAST_EDGES, _LEAST_TILES, _MOST_EDGES = 300, 12, 20_000
_ABOVE_CHANCE, _ABOVE_OTHERS, _ABOVE_ZERO = 2.8, 2.0, 2.5
"""Standard errors by which the best shift must exceed the median of all, the best other one, and no shift."""
_EXPECTED = 0.7
"""Factor of the second threshold for a shift below ``_SHIFT``."""
_STRICTER = 1.5
"""Factor of the thresholds for a flipped photo, because three flips are tried."""
_CONTRAST = 1.3
"""Minimum ratio of the gradients at the best shift and at the median one."""
_APART = 4
"""Minimum distance in pixels of another shift from the best one."""
_TURNS: dict[str, Callable[[Array], Array]] = {
    "mirrored left to right": lambda photo: photo[:, :, ::-1],
    "mirrored top to bottom": lambda photo: photo[:, ::-1],
    "turned by 180 degrees": lambda photo: photo[:, ::-1, ::-1],
}


@dataclass(frozen=True)
class Edges:
    """The edges of a depth map, half a pixel right of and half a pixel below some pixels.

    Args:
        right: (2, N) rows and columns of pixels whose right neighbour has another depth.
        below: (2, N) rows and columns of pixels whose neighbour below has another depth.

    """

    right: NDArray[np.intp]
    below: NDArray[np.intp]

    def tiles(self) -> NDArray[np.intp]:
        """Return the index of the tile of each edge, first of ``right``, then of ``below``."""
        rows, columns = np.concatenate((self.right, self.below), axis=1) // _TILE
        return np.unique(np.stack((rows, columns)), axis=1, return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class Match:
    """The best shift between the edges of depth and photo.

    Args:
        right, down: pixels from the depth edges to the photo's edges.
        found: whether this shift is significantly better than others.
        needed: whether it is significantly better than no shift.

    """

    right: int
    down: int
    found: bool
    needed: bool


def check_registration(scene: Scene) -> list[Finding]:
    """Check whether the photo's edges coincide with the depth edges.

    Args:
        scene: scene with high-resolution depth.

    """
    every = math.ceil(max(scene.camera.height, scene.camera.width) / _WORKING_SIZE)
    depth, photo = _reduce(scene, every)
    radius = max(round(max(depth.shape) * _MAX_SHIFT), _APART)
    edges = _find_edges(depth, radius)
    tiles = edges.tiles()
    if tiles.size < _LEAST_EDGES or tiles.max() + 1 < _LEAST_TILES:
        return [Finding("registration", "note", f"not enough depth edges for this check ({tiles.size} pixels)")]
    match = best_match(edges, photo, radius)
    if match.found:
        return [_report(match, every)]
    for name, turn in _TURNS.items():
        if best_match(edges, turn(photo), radius, _STRICTER).found:
            advice = "flip or rotate the photo or the depth"
            return [Finding("registration", "problem", f"the photo is {name} relative to the depth", advice)]
    message = f"the photo's edges match the depth edges at no shift within {radius * every} px"
    return [
        Finding(
            "registration", "note", message, "check that they belong together; noisy depth can have the same effect"
        )
    ]


def best_match(edges: Edges, photo: Array, radius: int, strictness: float = 1.0) -> Match:
    """Return the shift of the photo, up to ``radius`` pixels, with the largest gradients at the depth edges.

    Args:
        edges: depth edges at least ``radius`` pixels from the border.
        photo: (3, H, W).
        radius: largest shift in pixels.
        strictness: factor of the thresholds.

    """
    sums, counts = _sum_gradients(edges, photo, radius)
    mean = sums.sum(axis=0) / counts.sum()
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    elsewhere = mean.copy()
    elsewhere[max(row - _APART, 0) : row + _APART + 1, max(column - _APART, 0) : column + _APART + 1] = -1
    best, median = sums[:, row, column], float(np.median(mean))
    other = sums[(slice(None), *np.unravel_index(elsewhere.argmax(), mean.shape))]
    down, right = int(row) - radius, int(column) - radius
    expected = _EXPECTED if max(abs(down), abs(right)) < _SHIFT else 1.0
    found = (
        mean[row, column] > _CONTRAST * median
        and _errors(best - median * counts) > strictness * _ABOVE_CHANCE
        and _errors(best - other) > strictness * expected * _ABOVE_OTHERS
        and max(abs(down), abs(right)) < radius
    )
    return Match(right, down, bool(found), bool(_errors(best - sums[:, radius, radius]) > _ABOVE_ZERO))


def _sum_gradients(edges: Edges, photo: Array, radius: int) -> tuple[Array, Array]:
    """Return the gradients at the edges, summed by tile and by shift down and right, and the edges per tile."""
    tiles = edges.tiles()
    count, shifts = int(tiles.max()) + 1, range(-radius, radius + 1)
    sums = np.zeros((count, len(shifts), len(shifts)))
    parts = np.split(tiles, [edges.right.shape[1]])
    for (rows, columns), own, gradient in zip((edges.right, edges.below), parts, _gradients(photo), strict=True):
        if not rows.size:
            continue
        width = gradient.shape[1]
        flat, places = gradient.ravel(), rows * width + columns
        for i, down in enumerate(shifts):
            for j, right in enumerate(shifts):
                sums[:, i, j] += np.bincount(own, flat[places + (down * width + right)], minlength=count)
    return sums, np.bincount(tiles, minlength=count).astype(np.float64)


def _errors(gains: Array) -> float:
    """Return the sum over the tiles, in standard errors."""
    return float(gains.sum() / max(np.sqrt(np.square(gains).sum()), 1e-12))


def _reduce(scene: Scene, every: int) -> tuple[Array, Array]:
    """Return depth and photo reduced by a factor; depth is subsampled, which keeps its edges sharp."""
    photo = scene.rgb.double().numpy()
    height, width = (size // every for size in photo.shape[1:])
    blocks = photo[:, : height * every, : width * every].reshape(3, height, every, width, every)
    depth = metres(scene)[every // 2 :: every, every // 2 :: every][:height, :width]
    return depth, blocks.mean(axis=(2, 4))


def _find_edges(depth: Array, margin: int) -> Edges:
    """Return the jumps of depth away from holes and the border; a regular subset if there are very many."""
    safe = ~ndimage.binary_dilation(np.isnan(depth), iterations=2)
    safe[:margin] = safe[-margin:] = safe[:, :margin] = safe[:, -margin:] = False
    found = []
    for step in ((0, 1), (1, 0)):
        here = tuple(slice(None, -shift or None) for shift in step)
        there = tuple(slice(shift, None) for shift in step)
        near, jump = np.fmin(depth[here], depth[there]), np.abs(depth[there] - depth[here])
        with np.errstate(invalid="ignore"):
            found.append(np.stack(np.nonzero((jump > _JUMP * near) & safe[here] & safe[there])))
    every = math.ceil((found[0].shape[1] + found[1].shape[1]) / _MOST_EDGES) or 1
    return Edges(found[0][:, ::every], found[1][:, ::every])


def _gradients(photo: Array) -> tuple[Array, Array]:
    """Return the largest gradients of the channels to the right and down, relative to their local mean, up to 4."""
    smooth = ndimage.gaussian_filter(photo, (0, 0.7, 0.7))
    right, below = (np.abs(np.diff(smooth, axis=axis)).max(axis=0) for axis in (2, 1))
    ratios = [np.minimum(gradient / (ndimage.uniform_filter(gradient, 31) + 0.01), 4) for gradient in (right, below)]
    return ratios[0], ratios[1]


def _report(match: Match, every: int) -> Finding:
    """Return the finding for a shift between photo and depth."""
    across = f"{abs(match.right) * every} px {'left' if match.right < 0 else 'right'}"
    down = f"{abs(match.down) * every} px {'above' if match.down < 0 else 'below'}"
    shifted = bool(match.right or match.down)
    text = (
        f"the photo's edges are {across}, {down} of the depth edges"
        if shifted
        else "the photo's edges match the depth edges"
    )
    if max(abs(match.right), abs(match.down)) < _SHIFT or not match.needed:
        return Finding("registration", "ok", text)
    advice = "shift one of them; check for a crop, a resize or a lens correction applied to only one of them"
    return Finding("registration", "warning", text, advice)
