"""Alignment to the truth, against its authors' codes, numpy's least squares and scipy's linear programming."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from dsr.geometry.camera import Camera
from dsr.metrics import depth
from dsr.metrics.alignment import ALIGNMENTS, align, align_pair
from dsr.metrics.classes import compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair

V, U = np.mgrid[:20, :24].astype(float)
TRUTH = 2 + np.sin(0.7 * U + 0.3 * V) + 0.2 * np.cos(1.3 * V)
PREDICTION = 3 * (TRUTH * (1 + 0.08 * np.sin(2.1 * U - 0.9 * V)) + 0.05) - 1
RAYS = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5).rays()[None]
WAYS = [how for how in ALIGNMENTS if how != "none"]


def _batch(*maps):
    return torch.stack([torch.as_tensor(each, dtype=torch.float64)[None] for each in maps])


@pytest.mark.parametrize(
    ("how", "prediction", "mean", "error"),
    [  # of the map aligned by evalmde/utils/depth.py of princeton-vl/EvalMDE (ea9e21c), and of its error
        ("affine", PREDICTION, 2.0019000190787164, 0.10029338796695617),
        ("affine_disparity", PREDICTION + 3, 2.0267468267470394, 0.1369982371288428),
    ],
)
def test_least_squares_are_those_of_evalmde(how, prediction, mean, error):
    aligned = align(_batch(prediction), _batch(TRUTH), None, how)
    assert aligned.mean().item() == pytest.approx(mean, rel=1e-12)
    assert (aligned - _batch(TRUTH)).abs().mean().item() == pytest.approx(error, rel=1e-12)


def _with_outliers():
    prediction = PREDICTION.copy()
    prediction[::5, ::3] *= 3
    return prediction


def test_robust_alignment_has_the_least_relative_deviations():
    prediction = _with_outliers()
    aligned = align(_batch(prediction), _batch(TRUTH), None, "robust")
    found = (aligned - _batch(TRUTH)).abs().div(_batch(TRUTH)).mean().item()
    # the least possible: moge/utils/alignment.py of microsoft/MoGe (0744441), and a linear program
    assert found == pytest.approx(0.1490033789452269, rel=5e-6)
    x, y = prediction.ravel()[::2], TRUTH.ravel()[::2]
    both = np.hstack((np.stack((x, np.ones_like(x)), 1), -np.eye(len(x))))
    rows = np.vstack((both, both * np.r_[-1, -1, np.ones(len(x))]))
    cost = np.r_[0, 0, 1 / y] / len(x)
    solved = linprog(cost, rows, np.r_[y, -y], bounds=[(None, None)] * 2 + [(0, None)] * len(x))
    aligned = align(_batch(x[None]), _batch(y[None]), None, "robust")
    assert (aligned.flatten().numpy() - y).__abs__() @ cost[2:] == pytest.approx(solved.fun, rel=1e-4)


def test_median_scaling_is_numpys():
    aligned = align(_batch(PREDICTION + 2), _batch(TRUTH), None, "scale")
    expected = (PREDICTION + 2) * np.median(TRUTH) / np.median(PREDICTION + 2)
    np.testing.assert_allclose(aligned[0, 0], expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("how", "prediction"),
    [
        ("scale", TRUTH / 1.1),
        ("affine", 5 * TRUTH + 2),
        ("affine_disparity", 1 / (3 / TRUTH + 0.2)),
        ("robust", 0.3 * TRUTH + 0.7),
    ],
)
def test_what_an_alignment_leaves_open_is_undone_exactly(how, prediction):
    np.testing.assert_allclose(align(_batch(prediction), _batch(TRUTH), None, how)[0, 0], TRUTH, rtol=1e-9)


@pytest.mark.parametrize("how", WAYS)
def test_holes_and_masked_pixels_are_not_fitted_and_images_do_not_mix(how):
    prediction, truth = _batch(_with_outliers() + 3, PREDICTION + 2), _batch(TRUTH, TRUTH)
    mask = torch.ones_like(truth, dtype=torch.bool)
    prediction[0, 0, 3:5], truth[0, 0, 8, :7] = torch.nan, torch.nan
    prediction[0, 0, 6, 2] = 0
    mask[0, 0, 12:] = False
    together = align(prediction, truth, mask, how)
    kept = mask & truth.isfinite() & (prediction > 0)
    for image in range(2):
        flat = (each[image][kept[image]][None, None, None] for each in (prediction, truth))
        alone = align(*flat, None, how)
        torch.testing.assert_close(together[image][kept[image]], alone.flatten(), rtol=1e-9, atol=0)
    assert together[0, 0, 3:5].isnan().all()
    assert together[0, 0, 6, 2] == 0
    assert together[0, 0, 8].isfinite().all()  # a hole of the truth is none of the prediction
    single = align(prediction.float(), truth.float(), mask, how)
    assert single.dtype == torch.float32


@pytest.mark.parametrize("how", ["affine", "affine_disparity", "robust"])
def test_constant_prediction_becomes_a_constant(how):
    aligned = align(torch.full((1, 1, 20, 24), 0.3), _batch(TRUTH), None, how)
    assert aligned.amax() - aligned.amin() < 1e-6
    assert 1 < aligned.mean() < 3


@pytest.mark.parametrize("how", WAYS)
def test_image_without_a_pixel_to_fit_has_no_score(how):
    pair = SurfacePair(_batch(PREDICTION + 2), torch.full((1, 1, 20, 24), torch.nan, dtype=torch.float64), RAYS)
    assert depth.depth_errors(align_pair(pair, how))["AbsRel"].isnan().all()


def test_collection_aligns_each_pair_and_gradients_of_none_are_kept():
    metrics = visual_metrics(protocols=("depth",), alignment="affine")
    metrics.update(_batch(5 * TRUTH + 2, 0.1 * TRUTH + 3), _batch(TRUTH, TRUTH), RAYS)
    assert compute_means(metrics)["Depth_AbsRel"].item() == pytest.approx(0, abs=1e-9)
    pair = SurfacePair(_batch(TRUTH).requires_grad_(), _batch(TRUTH), RAYS)
    assert align_pair(pair, "none") is pair


def test_unknown_alignment_is_refused():
    with pytest.raises(ValueError, match=r"^alignment: expected one of none, scale, affine.*got 'median'$"):
        align(_batch(TRUTH), _batch(TRUTH), None, "median")
