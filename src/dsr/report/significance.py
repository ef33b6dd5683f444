"""How sure a mean over scenes is, and whether one method's is really better than another's.

Both by the bootstrap (Efron, Tibshirani, *An Introduction to the Bootstrap*, 1993, chapters 13 and 16): the scenes are
drawn with replacement, the same ones for two methods that are compared. Of few scenes an interval is too narrow; fewer
than :data:`LEAST` have none.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

LEAST = 5
"""Smallest number of scenes."""
_DRAWS = 10_000
LEVEL = 0.05


def interval_of_mean(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % percentile interval of the mean over scenes; None for fewer than :data:`LEAST`.

    Args:
        values: one of each scene.

    """
    if len(values) < LEAST:
        return None
    low, high = np.quantile(_draws(len(values)) @ np.asarray(values), [LEVEL / 2, 1 - LEVEL / 2])
    return float(low), float(high)


def p_of_difference(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the two-sided p-value of a mean difference of 0 between two methods on the same scenes.

    Args:
        first, second: a value of each scene, in the same order.

    Returns:
        Twice the share of draws whose mean difference is 0 or of the other sign; 1 for fewer than :data:`LEAST` scenes.

    """
    difference = np.asarray(first) - np.asarray(second)
    if len(difference) < LEAST or not difference.any():
        return 1.0
    means = _draws(len(difference)) @ difference
    return min(1.0, 2 * float(min((means <= 0).mean(), (means >= 0).mean())))


@functools.lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """Return the weights of scenes in each draw, (draws, count)."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS) / count
