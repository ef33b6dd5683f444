"""Dequantization of maps of whole levels, which replaces the steps of the rounding by slopes.

A value with the level L lies between L - 1/2 and L + 1/2. Between pixels of the levels L and L + 1 it is L + 1/2, so
the lines between levels are contours of known value. Between them the result is harmonic: it solves Laplace's equation
given the contours, with free boundaries at holes and at edges of surfaces, where levels jump.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

_CONTOUR = 2.0
"""Weight of the value at a contour, which lies half a pixel from the pixels on its sides."""
_ANCHOR = 1e-6
"""Weight of the level itself, for plateaus without a contour."""
_TOLERANCE = 1e-5


def smooth_levels(levels: np.ndarray, largest_step: int = 2) -> np.ndarray:
    """Return a map whose values vary smoothly between the levels.

    Args:
        levels: (H, W) whole numbers, NaN where missing.
        largest_step: largest difference of neighbours' levels within a surface.

    Returns:
        (H, W) float64, within half a level of ``levels``, NaN where they are NaN.

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
    result[known] = np.clip(_solve(weight, first[level], second[level], right, own), own - 0.5, own + 0.5)
    return result


def _solve(
    weight: np.ndarray, first: np.ndarray, second: np.ndarray, right: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Solve weight x - (sum of x over the neighbours) = right by conjugate gradients."""
    rows, columns = np.concatenate((first, second)), np.concatenate((second, first))
    coupling = sparse.csr_matrix((np.ones(rows.size), (rows, columns)), (start.size, start.size))
    matrix = sparse.diags(weight) - coupling
    solution, _ = linalg.cg(matrix, right, start, rtol=_TOLERANCE, maxiter=2000, M=sparse.diags(1 / weight))
    return np.asarray(solution)
