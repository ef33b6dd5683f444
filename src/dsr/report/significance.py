"""Confidence intervals of means over scenes, and significance of the differences between methods.

The interval is the percentile interval of the bootstrap, expanded for few scenes (Efron, Tibshirani, *An Introduction
to the Bootstrap*, 1993, chapter 13; Hesterberg, *What Teachers Should Know About the Bootstrap*, The American
Statistician 2015, section 4.2). The test is the permutation test of paired values, whose signs are as likely under the
hypothesis: exact up to :data:`_EXACT` scenes. With five, no difference is significant.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, t

LEAST = 5
"""Smallest number of scenes of an interval."""
LEVEL = 0.05
_DRAWS = 10_000
_EXACT = 13
_ROUNDING = 1e-9


def interval_of_mean(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean over scenes; None for fewer than :data:`LEAST`.

    Args:
        values: one of each scene.

    """
    count = len(values)
    if count < LEAST:
        return None
    tail = float(norm.cdf(math.sqrt(count / (count - 1)) * t.ppf(LEVEL / 2, count - 1)))
    low, high = np.quantile(_draws(count) @ np.asarray(values), [tail, 1 - tail])
    return float(low), float(high)


def p_of_difference(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the two-sided p-value of a mean difference of 0 between two methods on the same scenes.

    Args:
        first, second: a value of each scene, in the same order.

    Returns:
        The share of all changes of sign with a mean difference at least as large; of random ones for many scenes.

    """
    difference = np.asarray(first, dtype=float) - np.asarray(second)
    sums = np.abs(_signs(len(difference)) @ difference)
    return float((sums >= abs(difference.sum()) * (1 - _ROUNDING)).mean())


@functools.lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """Return the weights of scenes in each draw, (draws, count)."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS) / count


@functools.lru_cache(maxsize=16)
def _signs(count: int) -> np.ndarray:
    """Return changes of sign, (changes, count): all, or for many scenes random ones after the one without a change."""
    if count <= _EXACT:
        return np.array(list(itertools.product((1, -1), repeat=count)))
    random = np.random.default_rng(0).choice((1, -1), (_DRAWS, count))
    random[0] = 1
    return random
