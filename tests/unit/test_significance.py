"""Intervals of means over scenes, and the paired test between two methods."""

import numpy as np
import pytest
from scipy.stats import binomtest, bootstrap, permutation_test

from dsr.report.significance import agreement, bootstrap_of_average, interval_of_mean, p_of_difference, wilson


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


@pytest.mark.parametrize(("count", "n"), [(0, 1), (1, 1), (0, 136), (3, 136), (5, 10), (136, 136)])
def test_wilson_interval_equals_scipy(count, n):
    theirs = binomtest(count, n).proportion_ci(0.95, method="wilson")
    assert wilson(count, n) == pytest.approx((theirs.low, theirs.high), abs=1e-12)


def test_interval_of_an_average_is_wilsons_with_one_answer_a_person_where_all_agree():
    ones = np.ones((12, 5), int)
    assert bootstrap_of_average(ones, ones) == pytest.approx(wilson(12, 12))
    assert bootstrap_of_average(0 * ones, ones) == pytest.approx(wilson(0, 12))
    low, high = bootstrap_of_average(np.tile([1, 0], (5, 1)), np.ones((5, 2), int))  # one scene of two
    assert low + high == pytest.approx(1)


def test_agreement_equals_fleiss_own_example():
    """Ten subjects, fourteen raters, five categories: 0.378 and kappa 0.210."""
    counts = [
        [0, 0, 0, 0, 14], [0, 2, 6, 4, 2], [0, 0, 3, 5, 6], [0, 3, 9, 2, 0], [2, 2, 8, 1, 1],
        [7, 7, 0, 0, 0], [3, 2, 6, 3, 0], [2, 5, 3, 2, 2], [6, 5, 2, 1, 0], [0, 2, 2, 3, 7],
    ]  # fmt: skip
    assert agreement(np.array(counts)) == pytest.approx((0.378, 0.210), abs=5e-4)
