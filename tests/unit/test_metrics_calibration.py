"""Expected errors against measured ones: closed forms of known distributions, numpy, and planes of known normals."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu

from dsr.geometry.camera import Camera
from dsr.metrics.alignment import align_pair
from dsr.metrics.calibration import (
    ause,
    ence,
    error_ratios,
    measured_errors,
    off_auc,
    squared_error_share,
    stated_ratio,
)
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.functional import SurfacePair
from dsr.sample import Unit

CAMERA = Camera(width=24, height=20, fx=30.0, fy=29.0, cx=11.0, cy=10.5)


def _plane(normal, distance):
    """Return the depth of the plane n . P = d, (1, 1, H, W)."""
    direction = torch.tensor(normal, dtype=torch.float64)
    return distance / torch.einsum("c,chw->hw", direction, CAMERA.rays())[None, None]


@pytest.mark.parametrize("lowest", [0.0, -0.5])
def test_values_of_half_precision_are_ordered_as_others_and_equal_ones_as_they_come(lowest):
    random = np.random.default_rng(2)
    expected = torch.from_numpy(random.uniform(lowest, 2, 20_000).astype(np.float16).astype(float))
    expected[:50], expected[50:70] = 0.0, -0.0
    measured = torch.from_numpy(random.uniform(0, 1, 20_000))
    assert len(expected.unique()) < 10_000
    order = np.argsort(expected.numpy(), kind="stable")
    parts = zip(*(np.array_split(each.numpy()[order], 10) for each in (expected, measured)), strict=True)
    ratios = [theirs.mean() / own.mean() for own, theirs in parts]
    np.testing.assert_allclose(error_ratios(expected, measured).numpy(), ratios, rtol=1e-12)


def test_ratios_and_share_are_those_of_numpy_over_pixels_that_have_both_errors():
    random = np.random.default_rng(1)
    expected, measured = random.uniform(0, 2, (2, 3, 1, 17, 23)).astype(np.float32)
    expected[random.random(expected.shape) < 0.1] = np.nan
    measured[random.random(measured.shape) < 0.1] = np.nan
    both = np.isfinite(expected) & np.isfinite(measured)
    first, second = expected[both].astype(float), measured[both].astype(float)
    order = np.argsort(first)
    ratios = [second[part].mean() / first[part].mean() for part in np.array_split(order, 7)]
    given = torch.from_numpy(expected), torch.from_numpy(measured)
    np.testing.assert_allclose(error_ratios(*given, parts=7).numpy(), ratios)
    kept = (second[order[: round(0.6 * len(order))]] ** 2).sum() / (second**2).sum()
    assert float(squared_error_share(*given, kept=0.6)) == pytest.approx(kept)


def test_parts_without_pixels_and_errors_of_zero_have_no_value():
    found = error_ratios(torch.tensor([1.0, 2.0, math.nan]), torch.tensor([3.0, 4.0, 5.0]), parts=3)
    np.testing.assert_allclose(found.numpy(), [3, 2, math.nan])
    assert error_ratios(torch.zeros(4), torch.ones(4), parts=1).tolist() == [math.inf]
    assert math.isnan(squared_error_share(torch.ones(4), torch.zeros(4)))
    assert math.isnan(squared_error_share(torch.empty(0), torch.empty(0)))


def test_measured_errors_of_planes_are_their_distance_and_the_angle_between_them():
    tilt = math.radians(25)
    first, second = _plane((0, 0, 1), 2.0), _plane((math.sin(tilt), 0, math.cos(tilt)), 2.1)
    depth, angle = measured_errors(first, second, CAMERA.rays()[None])
    np.testing.assert_allclose(depth.numpy(), np.abs(first.numpy() - second.numpy()))
    np.testing.assert_allclose(angle.numpy(), 25, rtol=1e-9)
    np.testing.assert_allclose(measured_errors(second, second, CAMERA.rays()[None])[1].numpy(), 0, atol=1e-9)


def test_measured_errors_are_unknown_in_holes_of_either_map_and_those_of_normals_beside_them():
    first, second = _plane((0, 0, 1), 2.0), _plane((0, 0, 1), 2.1)
    first[..., 5, 6] = torch.nan
    second[..., 9, 3] = torch.nan
    depth, angle = measured_errors(first, second, CAMERA.rays()[None])
    holes = {(5, 6), (9, 3)}
    beside = {(v + dv, u + du) for v, u in holes for dv, du in ((0, 0), (-1, 0), (0, -1))}
    assert {tuple(place) for place in np.argwhere(depth[0, 0].isnan().numpy())} == holes
    assert {tuple(place) for place in np.argwhere(angle[0, 0].isnan().numpy())} == beside


V, U = np.mgrid[:40, :60].astype(float)
ERRORS = np.abs(0.02 * (1.2 + np.sin(0.9 * U + 0.31 * V)) * (1 + np.cos(1.7 * V - 0.23 * U)))
STATED = 0.8 * ERRORS + 0.01 * (1.5 + np.sin(0.37 * U * U - 0.53 * V))
GIVEN = torch.from_numpy(STATED), torch.from_numpy(ERRORS)


@pytest.mark.parametrize(
    ("steps", "expected"), [(20, 0.0012544785979542988), (50, 0.0012496075809134838), (100, 0.0012538239836805947)]
)
def test_sparsification_error_is_that_of_mono_uncertainty(steps, expected):
    # abs_rel of compute_aucs in evaluate.py of mattpoggi/mono-uncertainty (543772b), a truth of 1, `intervals` as here
    assert float(ause(*GIVEN, steps)) * ERRORS.mean() == pytest.approx(expected, rel=1e-12)


def test_normalised_calibration_error_of_gaussian_and_laplace_errors_is_known():
    random = np.random.default_rng(6)
    scales = random.uniform(0.5, 2, 400_000)
    expected, gaussian, laplace = (
        torch.from_numpy(each)
        for each in (scales, np.sqrt(np.pi / 2) * random.normal(0, scales), random.laplace(0, scales))
    )
    assert float(ence(expected, gaussian)) < 0.01
    assert float(ence(expected, 1.5 * gaussian)) == pytest.approx(0.5, abs=0.01)
    assert float(ence(expected, laplace)) == pytest.approx(2 / np.sqrt(np.pi) - 1, abs=0.015)


@pytest.mark.parametrize("decimals", [8, 2])
def test_area_under_the_roc_curve_is_that_of_the_rank_test(decimals):
    stated = np.round(STATED, decimals)  # with two decimals most are equal to others
    off = ERRORS > 0.02
    pairs = off.sum() * (~off).sum()
    expected = mannwhitneyu(stated[off], stated[~off]).statistic / pairs
    assert float(off_auc(torch.from_numpy(stated), GIVEN[1])) == pytest.approx(expected, rel=1e-12)
    assert float(off_auc(torch.ones_like(GIVEN[1]), GIVEN[1])) == 0.5
    assert float(off_auc(GIVEN[1], GIVEN[1], threshold=0.03)) == 1
    assert math.isnan(off_auc(*GIVEN, threshold=1.0))


@pytest.mark.parametrize("function", [ence, ause, off_auc, stated_ratio])
def test_pixels_without_either_error_are_left_out(function):
    stated, errors = STATED.copy(), ERRORS.copy()
    stated[3:9, :20], errors[6:12, 10:30] = np.nan, np.nan
    both = np.isfinite(stated) & np.isfinite(errors)
    found = function(torch.from_numpy(stated), torch.from_numpy(errors))
    assert float(found) == pytest.approx(
        float(function(torch.from_numpy(stated[both]), torch.from_numpy(errors[both])))
    )
    assert math.isnan(function(torch.full_like(GIVEN[0], torch.nan), GIVEN[1]))


LENS = Camera(width=60, height=40, fx=70.0, fy=70.0, cx=29.5, cy=19.5)
TRUTH = torch.from_numpy(2 + 0.05 * np.sin(0.2 * U + 0.1 * V))[None]
PREDICTION = TRUTH + torch.from_numpy(ERRORS * np.sign(np.sin(1 + 2.3 * U * V)))
ANGLES = torch.from_numpy(20 + 10 * np.sin(0.4 * U * V))
METRICS = catalogue(protocols=("calibration",))


def _scores(prediction=PREDICTION, **more):
    more = {"errors": (GIVEN[0][None], ANGLES[None]), **more}
    return {row.metric: row.value for row in score_image(prediction, TRUTH, LENS.rays(), METRICS, **more)}


def test_scores_compare_what_is_stated_with_depth_and_normals():
    depth, angle = measured_errors(PREDICTION[None], TRUTH[None], LENS.rays()[None])
    ratio = np.median(STATED) / np.median(ERRORS)
    assert float(stated_ratio(*GIVEN)) == pytest.approx(ratio, rel=1e-12)
    assert _scores() == pytest.approx(
        {
            "Calibration_ENCE": float(ence(GIVEN[0], depth[0, 0])),
            "Calibration_AUSE_d": float(ause(GIVEN[0], depth[0, 0])),
            "Calibration_AUSE_v": float(ause(ANGLES, angle[0, 0])),
            "Calibration_AUC_20mm": float(off_auc(GIVEN[0], depth[0, 0])),
            "Calibration_stated": ratio,
            "Calibration_factor": max(ratio, 1 / ratio),
            "Calibration_covered": 1,
        },
        rel=1e-4,
    )


def test_scores_count_what_has_no_stated_error_and_need_metres_for_millimetres():
    prediction, stated = PREDICTION.clone(), GIVEN[0].clone()[None]
    prediction[0, 10:20, 10:20], stated[0, 15:25, 15:25] = torch.nan, torch.nan
    found = _scores(prediction, errors=(stated, ANGLES[None]))
    assert found["Calibration_covered"] == pytest.approx(1 - (2 * 100 - 25) / 2400)
    known = (prediction - TRUTH).abs()
    assert found["Calibration_AUSE_d"] == pytest.approx(float(ause(stated, known)))
    assert "Calibration_AUC_20mm" not in _scores(unit=Unit("levels", inverse=True, factor=30.0, offset=0.0))


def test_alignment_by_a_scale_scales_what_is_stated_and_by_a_shift_drops_it():
    errors = {"depth_error": GIVEN[0][None, None] / 3, "angle_error": ANGLES[None, None]}
    pair = SurfacePair(PREDICTION[None] / 3, TRUTH[None], LENS.rays()[None], **errors)
    aligned = align_pair(pair, "scale")
    factor = TRUTH.median() / PREDICTION.median()
    torch.testing.assert_close(aligned.depth_error, factor * GIVEN[0][None, None], rtol=1e-3, atol=0)
    assert torch.equal(aligned.angle_error, pair.angle_error)
    assert align_pair(pair, "affine").depth_error is align_pair(pair, "robust").angle_error is None
