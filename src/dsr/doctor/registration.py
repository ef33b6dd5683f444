"""Whether photo and depth fit each other: edges of the depth have to lie on edges of the photo.

Where depth jumps between two neighbouring pixels, the photo's gradient in the same direction is looked up, for every
shift of the photo within a window. A photo that belongs to the depth has one shift that stands out; how much it has to
is measured by tiles of the image, as the pixels of one contour are no independent witnesses.
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
"""Relative difference of neighbouring depths that makes an edge."""
_WORKING_SIZE = 800
_REACH = 16 / 512
"""Of the window of shifts, as a share of the size."""
_SHIFT = 3
"""Working pixels that photo and depth may be apart."""
_TILE = 32
_LEAST_EDGES, _LEAST_TILES, _MOST_EDGES = 300, 12, 20_000
_ABOVE_CHANCE, _ABOVE_OTHERS, _ABOVE_ZERO = 2.8, 2.0, 2.5
"""Standard errors by which the best shift has to exceed the median of all, the best one elsewhere, and no shift."""
_EXPECTED = 0.7
"""Of the second, for a best shift where one expects it."""
_STRICTER = 1.5
"""Times as many for a photo that is turned, as three turns are tried."""
_CONTRAST = 1.3
"""Ratio of the gradients at the best shift and at the median one."""
_APART = 4
"""Pixels from the best shift to one elsewhere."""
_TURNS: dict[str, Callable[[Array], Array]] = {
    "mirrored left to right": lambda photo: photo[:, :, ::-1],
    "mirrored top to bottom": lambda photo: photo[:, ::-1],
    "turned by 180 degrees": lambda photo: photo[:, ::-1, ::-1],
}


@dataclass(frozen=True)
class Edges:
    """The edges of a depth map, half a pixel right of and half a pixel below some pixels.

    Args:
        right: (2, N) rows and columns of pixels whose neighbour to the right is at another depth.
        below: (2, N) of those whose neighbour below is.

    """

    right: NDArray[np.intp]
    below: NDArray[np.intp]

    def tiles(self) -> NDArray[np.intp]:
        """Return the tile of each edge, those right first; counted from 0."""
        rows, columns = np.concatenate((self.right, self.below), axis=1) // _TILE
        return np.unique(np.stack((rows, columns)), axis=1, return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class Match:
    """Where the photo's edges lie.

    Args:
        right, down: pixels from the depth's edges to the photo's.
        found: whether this shift stands out.
        needed: whether it fits clearly better than no shift.

    """

    right: int
    down: int
    found: bool
    needed: bool


def check_registration(scene: Scene) -> list[Finding]:
    """Return whether the photo's edges lie on the depth's.

    Args:
        scene: with high-resolution depth.

    """
    every = math.ceil(max(scene.camera.height, scene.camera.width) / _WORKING_SIZE)
    depth, photo = _reduced(scene, every)
    reach = max(round(max(depth.shape) * _REACH), _APART)
    edges = _edges(depth, reach)
    tiles = edges.tiles()
    if tiles.size < _LEAST_EDGES or tiles.max() + 1 < _LEAST_TILES:
        return [Finding("registration", "note", f"not enough depth edges to tell ({tiles.size} pixels)")]
    match = best_match(edges, photo, reach)
    if match.found:
        return [_placed(match, every)]
    for name, turn in _TURNS.items():
        if best_match(edges, turn(photo), reach, _STRICTER).found:
            advice = "turn the photo, or the depth, so that both show the same"
            return [Finding("registration", "problem", f"the photo is {name} against the depth", advice)]
    message = f"at no shift within {reach * every} px do the photo's edges lie on the depth's"
    return [Finding("registration", "note", message, "see whether they belong together; noisy depth hides it, too")]


def best_match(edges: Edges, photo: Array, reach: int, strictness: float = 1.0) -> Match:
    """Return the shift of the photo, up to ``reach`` pixels, whose gradients are largest at the depth's edges.

    Args:
        edges: at least ``reach`` pixels from the border.
        photo: (3, H, W).
        reach: in pixels.
        strictness: factor of how clearly a shift has to stand out.

    """
    sums, counts = _sums(edges, photo, reach)
    mean = sums.sum(axis=0) / counts.sum()
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    elsewhere = mean.copy()
    elsewhere[max(row - _APART, 0) : row + _APART + 1, max(column - _APART, 0) : column + _APART + 1] = -1
    best, median = sums[:, row, column], float(np.median(mean))
    other = sums[(slice(None), *np.unravel_index(elsewhere.argmax(), mean.shape))]
    down, right = int(row) - reach, int(column) - reach
    expected = _EXPECTED if max(abs(down), abs(right)) < _SHIFT else 1.0
    found = (
        mean[row, column] > _CONTRAST * median
        and _errors(best - median * counts) > strictness * _ABOVE_CHANCE
        and _errors(best - other) > strictness * expected * _ABOVE_OTHERS
        and max(abs(down), abs(right)) < reach
    )
    return Match(right, down, bool(found), bool(_errors(best - sums[:, reach, reach]) > _ABOVE_ZERO))


def _sums(edges: Edges, photo: Array, reach: int) -> tuple[Array, Array]:
    """Return the gradients at the edges, summed by tile and shift down and right, and the number of edges by tile."""
    tiles = edges.tiles()
    count, shifts = int(tiles.max()) + 1, range(-reach, reach + 1)
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
    """Return the sum over the tiles in standard errors."""
    return float(gains.sum() / max(np.sqrt(np.square(gains).sum()), 1e-12))


def _reduced(scene: Scene, every: int) -> tuple[Array, Array]:
    """Return depth and photo, reduced by a factor; the depth by its pixels, so that its edges stay sharp."""
    photo = scene.rgb.double().numpy()
    height, width = (size // every for size in photo.shape[1:])
    blocks = photo[:, : height * every, : width * every].reshape(3, height, every, width, every)
    depth = metres(scene)[every // 2 :: every, every // 2 :: every][:height, :width]
    return depth, blocks.mean(axis=(2, 4))


def _edges(depth: Array, margin: int) -> Edges:
    """Return where depth jumps, away from holes and the border; of very many edges every n-th."""
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
    """Return the largest gradient of the channels to the right and below, as a multiple of its local mean, up to 4."""
    smooth = ndimage.gaussian_filter(photo, (0, 0.7, 0.7))
    right, below = (np.abs(np.diff(smooth, axis=axis)).max(axis=0) for axis in (2, 1))
    ratios = [np.minimum(gradient / (ndimage.uniform_filter(gradient, 31) + 0.01), 4) for gradient in (right, below)]
    return ratios[0], ratios[1]


def _placed(match: Match, every: int) -> Finding:
    """Return how well photo and depth fit, given the shift between them."""
    across = f"{abs(match.right) * every} px {'left' if match.right < 0 else 'right'}"
    down = f"{abs(match.down) * every} px {'above' if match.down < 0 else 'below'}"
    shifted = bool(match.right or match.down)
    text = (
        f"the photo's edges lie {across}, {down} of the depth's" if shifted else "the photo's edges lie on the depth's"
    )
    if max(abs(match.right), abs(match.down)) < _SHIFT or not match.needed:
        return Finding("registration", "ok", text)
    advice = "shift one of them; look for a crop, a resize or a lens correction that only one of them had"
    return Finding("registration", "warning", text, advice)
