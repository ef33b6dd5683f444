"""Confidence intervals of means over scenes and of the answers of a study, and significance of differences.

The interval of a mean is the percentile interval of the bootstrap, expanded for few scenes (Efron, Tibshirani, *An
Introduction to the Bootstrap*, 1993, chapter 13; Hesterberg, *What Teachers Should Know About the Bootstrap*, The
American Statistician 2015, section 4.2). The test is the permutation test of paired values, whose signs are as likely
under the hypothesis: exact up to :data:`_EXACT` scenes. With five, no difference is significant.
"""

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import norm, t

LEAST = 5  # smallest number of scenes of an interval
LEVEL = 0.05
CONFIDENCE = 0.95
_DRAWS = 10_000
_EXACT = 13
_ROUNDING = 1e-9
_RESAMPLES = 2000


def interval_of_mean(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean over scenes, one value each; None for fewer than :data:`LEAST`."""
    count = len(values)
    if count < LEAST:
        return None
    tail = float(norm.cdf(math.sqrt(count / (count - 1)) * t.ppf(LEVEL / 2, count - 1)))
    low, high = np.quantile(_draws(count) @ np.asarray(values), [tail, 1 - tail])
    return float(low), float(high)


def p_of_difference(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the two-sided p-value of a mean difference of 0 between two methods on the same scenes in one order.

    It is the share of all changes of sign with a mean difference at least as large; of random ones for many scenes.
    SciPy's ``permutation_test`` gives the same in a thousand times the time.
    """
    difference = np.subtract(first, second)
    sums = np.abs(_signs(len(difference)) @ difference)
    return float((sums >= abs(difference.sum()) * (1 - _ROUNDING)).mean())


@functools.lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """Return the weights of scenes in each draw, (draws, count), which all cells of a table share."""
    return np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=_DRAWS) / count


@functools.lru_cache(maxsize=16)
def _signs(count: int) -> np.ndarray:
    """Return changes of sign, (changes, count): all, or for many scenes random ones after the one without a change."""
    if count <= _EXACT:
        return np.array(list(itertools.product((1, -1), repeat=count)))
    random = np.random.default_rng(0).choice((1, -1), (_DRAWS, count))
    random[0] = 1
    return random


def wilson(count: float, n: int) -> tuple[float, float]:
    """Compute the 95 % score interval of ``count`` of ``n`` answers (Wilson 1927, "Probable inference", JASA 22)."""
    z = float(norm.ppf((1 + CONFIDENCE) / 2))
    fraction = count / n  # also of a count that is no whole number, as of an average over scenes
    centre = fraction + z**2 / (2 * n)
    half = z * math.sqrt(fraction * (1 - fraction) / n + z**2 / (4 * n**2))
    scale = 1 + z**2 / n
    return max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0)


def bootstrap_of_average(chosen: np.ndarray, asked: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Compute the 95 % interval of a fraction averaged over scenes by resampling participants.

    ``chosen`` and ``asked``, (people, scenes), are 1 where the participant chose and saw the method. The answers of one
    participant are not independent, so participants are resampled (cluster percentile bootstrap: Davison and Hinkley
    1997, "Bootstrap Methods and their Application", ch. 2-3). If all resamples agree, for example because all or no
    participants chose a method, the Wilson interval with one answer per participant is returned.
    """
    people = len(asked)
    weights = np.random.default_rng(seed).multinomial(people, np.full(people, 1 / people), size=_RESAMPLES)
    fractions = average_fraction(weights @ chosen, weights @ asked)
    low, high = np.nanquantile(fractions, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    if high - low > 1e-12:
        return float(low), float(high)
    return wilson(float(average_fraction(chosen.sum(0), asked.sum(0))) * people, people)


def average_fraction(chosen: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Average chosen / asked over the scenes (last axis) with answers; NaN without any."""
    counted = asked > 0
    fractions = np.where(counted, chosen / np.maximum(asked, 1), 0.0)
    scenes = counted.sum(-1)
    return np.where(scenes > 0, fractions.sum(-1) / np.maximum(scenes, 1), np.nan)


def agreement(counts: np.ndarray) -> tuple[float, float]:
    """Compute the agreement of pairs of participants, and Fleiss' kappa (Fleiss 1971, Psychological Bulletin 76).

    ``counts``, (scenes, methods), are the first choices; scenes with fewer than two are left out. The first value is
    the fraction of pairs that agree, averaged over scenes. Kappa is 1 for full agreement, 0 for agreement by chance
    given the overall frequency of each method, NaN if all always chose the same one; both are NaN without pairs.
    """
    counts = counts[counts.sum(1) >= 2]
    if not len(counts):
        return math.nan, math.nan
    people = counts.sum(1)
    observed = float((((counts**2).sum(1) - people) / (people * (people - 1))).mean())
    expected = float(((counts.sum(0) / counts.sum()) ** 2).sum())
    return observed, (observed - expected) / (1 - expected) if expected < 1 else math.nan
