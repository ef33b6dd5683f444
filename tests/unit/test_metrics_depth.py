"""The errors of depth and normals that papers print, aligned or not, against their authors' codes and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from depth_steps import pair_of
from scipy.optimize import linprog

from dsr.geometry.camera import Camera
from dsr.metrics import depth
from dsr.metrics.alignment import ALIGNMENTS, align, align_pair
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.classes import compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import CENTIMETRES, Unit

CAMERA = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5)
V, U = np.mgrid[:20, :24].astype(float)
TRUTH = 2 + np.sin(0.7 * U + 0.3 * V) + 0.2 * np.cos(1.3 * V)
PREDICTION = TRUTH * (1 + 0.08 * np.sin(2.1 * U - 0.9 * V)) + 0.05
METRICS = catalogue(protocols=("depth", "normals"))


def _scores(prediction, truth, **more):
    maps = (torch.as_tensor(each, dtype=torch.float64)[None] for each in (prediction, truth))
    return {row.metric: row.value for row in score_image(*maps, CAMERA.rays(), METRICS, **more)}


def test_errors_are_those_of_monodepth2_marigold_and_kittis_development_kit():
    found = _scores(PREDICTION, TRUTH)
    assert {name: found[name] for name in found if name.startswith("Depth_") and "delta" not in name} == pytest.approx(
        {
            "Depth_AbsRel": 0.054748016686408364,  # evaluate_depth.py of nianticlabs/monodepth2 (b676244)
            "Depth_SqRel": 0.007866486727644612,
            "Depth_RMSE": 0.13043041649760254,
            "Depth_RMSE_log": 0.06252472038058883,
            "Depth_log10": 0.023156580260221153,  # src/util/metric.py of prs-eth/Marigold (b1dffaa)
            "Depth_SIlog": 0.05632522778963602,
            "Depth_iRMSE": 0.040668465492704704,
            "Depth_MAE": 0.107297629,  # evaluate_depth.cpp of KITTI's kit, with 32 bits
            "Depth_iMAE": 0.0308721121,
            "Depth_covered": 1,
        },
        rel=1e-6,
    )


def test_accuracies_are_fractions_below_a_ratio():
    found = _scores(PREDICTION * 1.1, TRUTH)
    ratio = np.maximum(PREDICTION * 1.1 / TRUTH, TRUTH / PREDICTION / 1.1)
    expected = {"105": 1.05, "110": 1.1, "125": 1.25, "125_2": 1.25**2, "125_3": 1.25**3}
    for name, limit in expected.items():
        assert found[f"Depth_delta_{name}"] == pytest.approx((ratio < limit).mean())
    assert 0 < found["Depth_delta_105"] < found["Depth_delta_110"] < found["Depth_delta_125"] < 1
    exactly = np.where(U < 12, 1.25, np.where(U < 18, 1.2, 0.8))
    assert depth.depth_errors(pair_of(exactly, np.ones_like(U), CAMERA))["delta_125"].item() == 0.25


def test_angles_are_those_of_dsine():
    # compute_normal_metrics in utils/utils.py of baegwangbin/DSINE (ef0c2af), of numpy's normals of both maps
    found = _scores(1 + 0.05 * PREDICTION, 1 + 0.05 * TRUTH)
    assert {name: found[name] for name in found if name.startswith("Normal_")} == pytest.approx(
        {
            "Normal_mean": 12.025996584679877,
            "Normal_median": 10.406822659215585,
            "Normal_within_5": 0.05625,
            "Normal_within_7_5": 0.2375,
            "Normal_within_11_25": 0.55625,
            "Normal_within_22_5": 0.9145833333333333,
            "Normal_within_30": 0.99375,
            "Normal_covered": 1,
        },
        rel=1e-5,
    )


def test_holes_are_left_out_and_counted():
    prediction, truth = PREDICTION.copy(), TRUTH.copy()
    prediction[4:7, 5:9], prediction[-1], truth[10, 3:6] = np.nan, np.nan, np.nan
    found, valid = _scores(prediction, truth), np.isfinite(prediction) & np.isfinite(truth)
    assert found["Depth_AbsRel"] == pytest.approx((np.abs(prediction - truth) / truth)[valid].mean())
    assert found["Depth_SIlog"] == pytest.approx((np.log(prediction) - np.log(truth))[valid].std())
    assert found["Depth_covered"] == pytest.approx(valid.sum() / np.isfinite(truth).sum())
    assert found["Normal_covered"] < found["Depth_covered"] < 1


FIELD_CAMERA = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5, baseline=0.5, doffs=40.0)
LEVELS = Unit("levels", inverse=True, factor=0.5 * 30.0, offset=40.0, limits=(0, 255))


def _field_rows(prediction, target, unit):
    metrics = catalogue(protocols=("field",))
    return {row.metric: row for row in score_image(prediction, target, FIELD_CAMERA.rays(), metrics, unit)}


def test_errors_of_depth_are_in_centimetres_over_all_valid_pixels():
    """Of errors around 5 cm, and some of factor two."""
    random = np.random.default_rng(0)
    t = 1 + random.random((1, 20, 24))
    p = np.where(random.random(t.shape) < 0.1, random.choice([0.5, 2.0], t.shape), 1) * t
    p += 0.05 * random.standard_normal(t.shape)
    p[0, 3, :5], t[0, 8:10, 2] = np.nan, np.nan
    valid = np.isfinite(p) & np.isfinite(t)
    error, ratio = np.abs(p - t)[valid], np.maximum(p / t, t / p)[valid]
    rows = _field_rows(torch.from_numpy(p), torch.from_numpy(t), CENTIMETRES)
    assert {name: row.value for name, row in rows.items()} == pytest.approx(
        {
            "RMSE_cm": 100 * np.sqrt((error**2).mean()),
            "MAE_cm": 100 * error.mean(),
            "Beyond_5cm": (error > 0.05).mean(),
            "Beyond_delta1": (ratio > 1.25).mean(),
            "RMSE_cm_border6": 100 * np.sqrt(np.nanmean((p - t)[0, 6:-6, 6:-6] ** 2)),
        },
        rel=1e-12,
    )
    assert [row.valid_share for row in rows.values()] == pytest.approx(5 * [valid.mean()])
    assert 0.02 < rows["Beyond_delta1"].value < 0.2 < rows["Beyond_5cm"].value < 0.8


def test_errors_of_disparity_are_in_levels_and_predictions_are_clamped_to_them():
    random = np.random.default_rng(0)
    truth = random.integers(0, 256, (1, 20, 24)).astype(float)
    levels = (truth + 20 * random.standard_normal(truth.shape)).clip(-30, 290)
    prediction, target = (torch.from_numpy(15 / (each + 40)) for each in (levels, truth))
    error = np.abs(levels.clip(0, 255) - truth)
    assert (levels < -1).any()
    assert (levels > 256).any()
    rows = _field_rows(prediction, target, LEVELS)
    assert {name: row.value for name, row in rows.items()} == pytest.approx(
        {
            "RMSE_levels": np.sqrt((error**2).mean()),
            "MAE_levels": error.mean(),
            "RMSE_levels_border6": np.sqrt((error[0, 6:-6, 6:-6] ** 2).mean()),
        },
        rel=1e-9,
    )
    unclamped = _field_rows(prediction, target, replace(LEVELS, limits=None))
    assert unclamped["MAE_levels"].value == pytest.approx(np.abs(levels - truth).mean(), rel=1e-9)
    assert unclamped["MAE_levels"].value > 1.01 * rows["MAE_levels"].value


def test_thresholds_are_exceeded_only_beyond_them():
    target = torch.full((1, 1, 2, 4), 2.0, dtype=torch.float64)
    prediction = target * torch.tensor([1.25, 1.2501, 0.8, 0.7999], dtype=torch.float64)
    pair = SurfacePair(prediction, target, FIELD_CAMERA.crop(0, 0, 2, 4).rays()[None])
    assert depth.field_errors(pair)["Beyond_delta1"].item() == 0.5
    pair = SurfacePair(target + torch.tensor([0.0499, -0.0499, 0.0501, -0.0501]), target, pair.rays)
    assert depth.field_errors(pair)["Beyond_5cm"].item() == 0.5


@pytest.mark.parametrize("protocols", [(), ("papers",), ("field", "none")])
def test_unknown_protocol_is_refused(protocols):
    with pytest.raises(ValueError, match=r"^protocols: expected"):
        catalogue(protocols=protocols)


STRETCHED = 3 * (TRUTH * (1 + 0.08 * np.sin(2.1 * U - 0.9 * V)) + 0.05) - 1
RAYS = CAMERA.rays()[None]
WAYS = [how for how in ALIGNMENTS if how != "none"]


def _batch(*maps):
    return torch.stack([torch.as_tensor(each, dtype=torch.float64)[None] for each in maps])


@pytest.mark.parametrize(
    ("how", "prediction", "mean", "error"),
    [  # of the map aligned by evalmde/utils/depth.py of princeton-vl/EvalMDE (ea9e21c), and of its error
        ("affine", STRETCHED, 2.0019000190787164, 0.10029338796695617),
        ("affine_disparity", STRETCHED + 3, 2.0267468267470394, 0.1369982371288428),
    ],
)
def test_least_squares_are_those_of_evalmde(how, prediction, mean, error):
    aligned = align(_batch(prediction), _batch(TRUTH), None, how)
    assert aligned.mean().item() == pytest.approx(mean, rel=1e-12)
    assert (aligned - _batch(TRUTH)).abs().mean().item() == pytest.approx(error, rel=1e-12)


def _with_outliers():
    prediction = STRETCHED.copy()
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
    prediction, truth = _batch(_with_outliers() + 3, STRETCHED + 2), _batch(TRUTH, TRUTH)
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


@pytest.mark.parametrize("how", WAYS)
def test_image_without_a_pixel_to_fit_has_no_score(how):
    pair = SurfacePair(_batch(STRETCHED + 2), torch.full((1, 1, 20, 24), torch.nan, dtype=torch.float64), RAYS)
    assert depth.depth_errors(align_pair(pair, how))["AbsRel"].isnan().all()


def test_collection_aligns_each_pair_and_gradients_of_none_are_kept():
    metrics = visual_metrics(protocols=("depth",), alignment="affine")
    metrics.update(_batch(5 * TRUTH + 2, 0.1 * TRUTH + 3), _batch(TRUTH, TRUTH), RAYS)
    assert compute_means(metrics)["Depth_AbsRel"].item() == pytest.approx(0, abs=1e-9)
    pair = SurfacePair(_batch(TRUTH).requires_grad_(), _batch(TRUTH), RAYS)
    assert align_pair(pair, "none") is pair


def test_unknown_alignment_is_refused_and_a_constant_prediction_becomes_a_constant():
    for how in ("affine", "affine_disparity", "robust"):
        aligned = align(torch.full((1, 1, 20, 24), 0.3), _batch(TRUTH), None, how)
        assert aligned.amax() - aligned.amin() < 1e-6
        assert 1 < aligned.mean() < 3
    with pytest.raises(ValueError, match=r"^alignment: expected"):
        align(_batch(TRUTH), _batch(TRUTH), None, "median")
