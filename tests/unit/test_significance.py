"""Intervals of means over scenes, and the paired test between two methods."""

import numpy as np
import pytest
from scipy.stats import bootstrap, permutation_test

from dsr.report.significance import interval_of_mean, p_of_difference


def test_interval_of_many_scenes_is_that_of_another_bootstrap() -> None:
    values = np.random.default_rng(1).gamma(2, size=200)
    theirs = bootstrap((values,), np.mean, n_resamples=10_000, method="percentile", rng=0).confidence_interval
    assert interval_of_mean(values.tolist()) == pytest.approx(theirs, rel=0.02)


def test_interval_of_few_scenes_holds_the_mean_about_as_often_as_it_says() -> None:
    random = np.random.default_rng(4)
    bounds = np.array([interval_of_mean(random.normal(0, 1, 6).tolist()) for _ in range(400)])
    assert ((bounds[:, 0] <= 0) & (bounds[:, 1] >= 0)).mean() > 0.92


def test_few_scenes_have_no_interval_and_no_significant_difference() -> None:
    assert interval_of_mean([1, 2, 3, 4]) is None
    assert p_of_difference([1, 2, 3, 4, 5], [5, 6, 7, 8, 9]) == 2 / 32


def test_exact_test_is_that_of_another_library() -> None:
    first, second = np.random.default_rng(5).normal([[0.8], [0]], 1, (2, 9))
    theirs = permutation_test((first, second), lambda a, b: np.mean(a - b), permutation_type="samples").pvalue
    assert p_of_difference(first.tolist(), second.tolist()) == pytest.approx(theirs)


def test_scenes_are_paired() -> None:
    random = np.random.default_rng(2)
    scenes = random.normal(0, 10, 12)
    better, worse = scenes, scenes + 1 + random.normal(0, 0.1, 12)
    assert p_of_difference(better, worse) < 0.001
    assert p_of_difference(better, random.permutation(worse)) > 0.05
    assert p_of_difference(better, worse) == p_of_difference(worse, better)
    assert p_of_difference(better, better) == 1
