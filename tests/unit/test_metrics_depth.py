"""The errors of depth and normals that papers print, against their authors' codes, numpy and closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.metrics import depth, field, normals
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.classes import AbsRel, DeltaAccuracy, NormalAngle, NormalsWithin, SIlog, compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import Unit

CAMERA = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5)
V, U = np.mgrid[:20, :24].astype(float)
TRUTH = 2 + np.sin(0.7 * U + 0.3 * V) + 0.2 * np.cos(1.3 * V)
PREDICTION = TRUTH * (1 + 0.08 * np.sin(2.1 * U - 0.9 * V)) + 0.05
METRICS = catalogue(protocols=("depth", "normals"))


def _scores(prediction: Any, truth: Any, **more: Any) -> dict[str, float]:
    maps = (torch.as_tensor(each, dtype=torch.float64)[None] for each in (prediction, truth))
    return {row.metric: row.value for row in score_image(*maps, CAMERA.rays(), METRICS, **more)}


def _pair(prediction: Any, truth: Any) -> SurfacePair:
    maps = (torch.as_tensor(each, dtype=torch.float64)[None, None] for each in (prediction, truth))
    return SurfacePair(*maps, CAMERA.rays()[None])


def test_errors_are_those_of_monodepth2_marigold_and_kittis_development_kit() -> None:
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


def test_accuracies_are_fractions_below_a_ratio() -> None:
    found = _scores(PREDICTION * 1.1, TRUTH)
    ratio = np.maximum(PREDICTION * 1.1 / TRUTH, TRUTH / PREDICTION / 1.1)
    expected = {"105": 1.05, "110": 1.1, "125": 1.25, "125_2": 1.25**2, "125_3": 1.25**3}
    for name, limit in expected.items():
        assert found[f"Depth_delta_{name}"] == pytest.approx((ratio < limit).mean())
    assert 0 < found["Depth_delta_105"] < found["Depth_delta_110"] < found["Depth_delta_125"] < 1
    exactly = np.where(U < 12, 1.25, np.where(U < 18, 1.2, 0.8))
    assert depth.within_ratio(_pair(exactly, np.ones_like(U)), 1.25).item() == 0.25


def test_a_factor_of_all_depths_has_errors_in_closed_form() -> None:
    found = _scores(1.2 * TRUTH, TRUTH)
    assert found["Depth_AbsRel"] == pytest.approx(0.2)
    assert found["Depth_SIlog"] == pytest.approx(0, abs=1e-12)
    assert found["Depth_RMSE_log"] == pytest.approx(math.log(1.2))
    assert found["Depth_log10"] == pytest.approx(math.log10(1.2))
    assert found["Depth_iMAE"] == pytest.approx((1 / TRUTH).mean() / 6)
    assert found["Depth_delta_110"] == 0
    assert found["Depth_delta_125"] == 1
    assert found["Normal_mean"] == pytest.approx(0, abs=1e-3)


def test_errors_in_metres_are_the_fields_in_its_unit() -> None:
    pair = _pair(PREDICTION, TRUTH)
    assert 100 * depth.rmse(pair).item() == pytest.approx(field.rmse(pair).item())
    assert 100 * depth.mae(pair).item() == pytest.approx(field.mae(pair).item())


def test_benchmark_in_levels_has_no_errors_in_metres() -> None:
    levels = Unit("levels", inverse=True, factor=30.0, offset=0.0)
    assert all(name.startswith("Normal_") for name in _scores(PREDICTION, TRUTH, unit=levels))


def test_angles_are_those_of_dsine() -> None:
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


@pytest.mark.parametrize("tilt", [5.0, 20.0])
def test_tilted_plane_is_off_by_its_tilt(tilt: float) -> None:
    x = (U - 11.5) / 30
    found = _scores(2 / (1 - x * math.tan(math.radians(tilt))), np.full_like(x, 2.0))
    assert found["Normal_mean"] == pytest.approx(tilt, rel=1e-4)
    assert found["Normal_median"] == pytest.approx(tilt, rel=1e-4)
    assert found["Normal_within_7_5"] == float(tilt < 7.5)
    assert found["Normal_within_22_5"] == 1


def test_holes_are_left_out_and_counted() -> None:
    prediction, truth = PREDICTION.copy(), TRUTH.copy()
    prediction[4:7, 5:9], prediction[-1], truth[10, 3:6] = np.nan, np.nan, np.nan
    found, valid = _scores(prediction, truth), np.isfinite(prediction) & np.isfinite(truth)
    assert found["Depth_AbsRel"] == pytest.approx((np.abs(prediction - truth) / truth)[valid].mean())
    assert found["Depth_SIlog"] == pytest.approx((np.log(prediction) - np.log(truth))[valid].std())
    assert found["Depth_covered"] == pytest.approx(valid.sum() / np.isfinite(truth).sum())
    assert found["Normal_covered"] < found["Depth_covered"] < 1
    nothing = _scores(np.full_like(TRUTH, np.nan), TRUTH)
    assert nothing.pop("Depth_covered") == nothing.pop("Normal_covered") == 0
    assert all(math.isnan(value) for value in nothing.values())


def test_batch_has_the_values_of_its_images() -> None:
    holed = np.where(U * V == 12, np.nan, PREDICTION)
    pairs = [_pair(PREDICTION, TRUTH), _pair(holed, TRUTH + 0.1)]
    maps = (torch.cat(each) for each in zip(*(pair.given for pair in pairs), strict=True))
    batch = SurfacePair(*maps, CAMERA.rays()[None])
    for metric in (*depth.METRICS, *normals.METRICS):
        singles = [metric.function(pair) for pair in pairs]
        torch.testing.assert_close(metric.function(batch), torch.cat(singles), rtol=1e-12, atol=1e-14)


def test_classes_are_the_metrics_of_their_protocols() -> None:
    pair = _pair(PREDICTION, TRUTH)
    metrics = visual_metrics(protocols=("depth", "normals"))
    metrics.update(pair)
    means = compute_means(metrics)
    for made, name in (
        (AbsRel(), "Depth_AbsRel"),
        (DeltaAccuracy(1.05), "Depth_delta_105"),
        (DeltaAccuracy(1.25**3), "Depth_delta_125_3"),
        (SIlog(), "Depth_SIlog"),
        (NormalAngle(median=True), "Normal_median"),
        (NormalsWithin(7.5), "Normal_within_7_5"),
    ):
        assert made(pair) == means[name]
    with pytest.raises(ValueError, match=r"^threshold: .*Normal_within_11_25.*got 12$"):
        NormalsWithin(12)
