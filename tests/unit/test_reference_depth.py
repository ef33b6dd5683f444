"""Undoing the rounding to levels: against the surfaces that were rounded."""

import numpy as np
import pytest

from dsr.data.reference_depth import smooth_levels

Y, X = np.mgrid[:120, :160].astype(float)


@pytest.mark.parametrize(("a", "b", "share"), [(0.03, 0.0, 0.2), (0.05, -0.03, 0.2), (0.4, 0.3, 0.3), (0.9, -0.8, 0.8)])
def test_slope_is_restored_and_the_more_accurately_the_wider_its_terraces(a, b, share):
    truth = 100 + a * X + b * Y
    error = np.abs(smooth_levels(np.round(truth)) - truth)[8:-8, 8:-8]
    rounded = np.abs(np.round(truth) - truth)[8:-8, 8:-8]
    assert error.mean() < share * rounded.mean()


def test_slopes_of_a_curved_surface_are_nearer_to_the_truth_than_terraces():
    truth = 100 + 12 * np.sin(X / 40) * np.cos(Y / 35)
    slopes = [np.gradient(values)[1] for values in (truth, np.round(truth), smooth_levels(np.round(truth)))]
    assert np.abs(slopes[2] - slopes[0]).mean() < 0.25 * np.abs(slopes[1] - slopes[0]).mean()


def test_result_rounds_to_the_stored_levels():
    truth = 100 + 12 * np.sin(X / 40) * np.cos(Y / 35)
    assert np.abs(smooth_levels(np.round(truth)) - np.round(truth)).max() <= 0.5


def test_edges_and_holes_are_borders_of_the_smoothing():
    levels = np.full((40, 60), 50.0)
    levels[:, 30:] = 90.0
    levels[10:20, 10:20] = np.nan
    smooth = smooth_levels(levels)
    assert np.array_equal(np.isnan(smooth), np.isnan(levels))
    np.testing.assert_allclose(smooth[~np.isnan(levels)], levels[~np.isnan(levels)], atol=1e-6)


def test_isolated_plateau_is_unchanged():
    levels = np.full((9, 9), np.nan)
    levels[3:6, 3:6] = 7.0
    np.testing.assert_allclose(smooth_levels(levels)[3:6, 3:6], 7.0, atol=1e-9)
