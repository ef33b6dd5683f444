"""Confidence intervals of percentages, and how far people agree."""

from __future__ import annotations

import math

import numpy as np

CONFIDENCE = 0.95
_Z = 1.959963984540054
"""The 97.5th percentile of the normal distribution."""
_RESAMPLES = 2000


def wilson(count: float, n: int) -> tuple[float, float]:
    """Return the 95 % score interval of a share (Wilson 1927, "Probable inference", JASA 22).

    Args:
        count: how many of the answers, 0 to ``n``.
        n: how many answers.

    Returns:
        The bounds in [0, 1]; (NaN, NaN) without answers.

    """
    if n == 0:
        return math.nan, math.nan
    share = count / n
    centre = share + _Z**2 / (2 * n)
    half = _Z * math.sqrt(share * (1 - share) / n + _Z**2 / (4 * n**2))
    scale = 1 + _Z**2 / n
    return max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0)


def bootstrap_of_average(chosen: np.ndarray, asked: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of a share averaged over scenes, resampling people.

    A person answers for several scenes, so the answers are not independent, and people are what is drawn again
    (percentile bootstrap of clusters: Davison and Hinkley 1997, "Bootstrap Methods and their Application", ch. 2-3).
    Where all resamples agree, as when everybody or nobody chose a method, the bootstrap says nothing; then it is
    Wilson's interval with one answer per person.

    Args:
        chosen: (people, scenes) 1 where somebody chose it, else 0.
        asked: (people, scenes) 1 where somebody was asked, else 0.
        seed: of the resampling.

    Returns:
        The bounds in [0, 1].

    """
    people = len(asked)
    weights = np.random.default_rng(seed).multinomial(people, np.full(people, 1 / people), size=_RESAMPLES)
    shares = average_share(weights @ chosen, weights @ asked)
    shares = shares[np.isfinite(shares)]
    low, high = np.quantile(shares, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    if high - low > 1e-12:
        return float(low), float(high)
    return wilson(float(average_share(chosen.sum(0), asked.sum(0))) * people, people)


def average_share(chosen: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the mean of chosen / asked over the scenes, the last axis, that somebody was asked about."""
    counted = asked > 0
    shares = np.where(counted, chosen / np.maximum(asked, 1), 0.0)
    scenes = counted.sum(-1)
    return np.where(scenes > 0, shares.sum(-1) / np.maximum(scenes, 1), np.nan)


def agreement(counts: np.ndarray) -> tuple[float, float]:
    """Return how often two people choose the same, and Fleiss' kappa of it (Fleiss 1971, Psychological Bulletin 76).

    Args:
        counts: (scenes, methods) how many people chose a method first. Scenes with fewer than two answers are left out.

    Returns:
        The share of pairs of people that agree, averaged over scenes, and kappa, which is 1 for full agreement and 0
        for that of chance, given how often each method is chosen overall. NaN where there are no such pairs, and kappa
        also where everybody always chose the same method.

    """
    counts = counts[counts.sum(1) >= 2]
    if not len(counts):
        return math.nan, math.nan
    people = counts.sum(1)
    observed = float((((counts**2).sum(1) - people) / (people * (people - 1))).mean())
    expected = float(((counts.sum(0) / counts.sum()) ** 2).sum())
    return observed, (observed - expected) / (1 - expected) if expected < 1 else math.nan
