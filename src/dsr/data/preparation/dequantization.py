"""Undoing the rounding of maps that hold whole levels, so that slopes are slopes and not terraces.

A level L says that the value lay between L - 1/2 and L + 1/2. Between pixels of levels L and L + 1 it passed L + 1/2,
so the lines between levels are known as the contour lines of a map are. Between them the result is harmonic: it solves
Laplace's equation given the contours, with holes and the edges of surfaces, where levels jump, as free boundaries.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

_CONTOUR = 2.0
"""Weight of a contour's value: it lies half a pixel from the pixels on its sides."""
_ANCHOR = 1e-6
"""Weight of the level itself, for plateaus that no contour touches."""
_TOLERANCE = 1e-5


def smoothed_levels(levels: np.ndarray, largest_step: int = 2) -> np.ndarray:
    """Return values between levels.

    Args:
        levels: (H, W) whole numbers, NaN where unknown.
        largest_step: neighbours whose levels differ by more are of different surfaces.

    Returns:
        (H, W) float64, within half a level of ``levels``; NaN where they are.

    """
    known = np.isfinite(levels)
    own = levels[known].astype(np.float64)
    number = np.full(levels.shape, -1)
    number[known] = np.arange(own.size)
    first = np.concatenate((number[1:].ravel(), number[:, 1:].ravel()))
    second = np.concatenate((number[:-1].ravel(), number[:, :-1].ravel()))
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    step = np.abs(own[first] - own[second])
    level, contour = step == 0, (step > 0) & (step <= largest_step)
    ends = np.concatenate((first[contour], second[contour]))
    values = np.tile((own[first[contour]] + own[second[contour]]) / 2, 2)
    weight = _ANCHOR + np.bincount(np.concatenate((first[level], second[level])), minlength=own.size)
    weight += _CONTOUR * np.bincount(ends, minlength=own.size)
    right = _ANCHOR * own + _CONTOUR * np.bincount(ends, values, minlength=own.size)
    result = np.full(levels.shape, np.nan)
    result[known] = np.clip(_solved(weight, first[level], second[level], right, own), own - 0.5, own + 0.5)
    return result


def _solved(
    weight: np.ndarray, first: np.ndarray, second: np.ndarray, right: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Solve weight x - (sum of x over the neighbours) = right by conjugate gradients."""
    rows, columns = np.concatenate((first, second)), np.concatenate((second, first))
    coupling = sparse.csr_matrix((np.ones(rows.size), (rows, columns)), (start.size, start.size))
    matrix = sparse.diags(weight) - coupling
    solution, _ = linalg.cg(matrix, right, start, rtol=_TOLERANCE, maxiter=2000, M=sparse.diags(1 / weight))
    return np.asarray(solution)
