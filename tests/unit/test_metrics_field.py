"""The metrics that the field prints, against plain numpy; each benchmark has those of its unit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.metrics import field
from dsr.metrics.catalogue import PROTOCOLS, Score, catalogue, score_image
from dsr.metrics.classes import compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import CENTIMETRES, Unit

CAMERA = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5, baseline=0.5, doffs=40.0)
LEVELS = Unit("levels", inverse=True, factor=0.5 * 30.0, offset=40.0, limits=(0, 255))


def _maps(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return a prediction with errors around 5 cm and some of factor two, and the truth, both (1, 20, 24)."""
    random = np.random.default_rng(seed)
    truth = 1 + random.random((1, 20, 24))
    off = np.where(random.random(truth.shape) < 0.1, random.choice([0.5, 2.0], truth.shape) * truth - truth, 0)
    return torch.from_numpy(truth + off + 0.05 * random.standard_normal(truth.shape)), torch.from_numpy(truth)


def _levels(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return depth maps whose 8-bit levels are 0..255, the prediction's from below 0 to above 255."""
    random = np.random.default_rng(seed)
    truth = random.integers(0, 256, (1, 20, 24)).astype(float)
    levels = np.stack((truth + 20 * random.standard_normal(truth.shape), truth)).clip(-30, 290)
    prediction, target = torch.from_numpy(15 / (levels + 40))
    return prediction, target


def _rows(prediction: Tensor, target: Tensor, unit: Unit) -> dict[str, Score]:
    metrics = catalogue(protocols=("field",))
    return {row.metric: row for row in score_image(prediction, target, CAMERA.rays(), metrics, unit)}


def test_errors_of_depth_are_in_centimetres_over_all_valid_pixels() -> None:
    prediction, target = _maps()
    prediction[0, 3, :5], target[0, 8:10, 2] = torch.nan, torch.nan
    p, t = prediction.numpy(), target.numpy()
    valid = np.isfinite(p) & np.isfinite(t)
    error, ratio = np.abs(p - t)[valid], np.maximum(p / t, t / p)[valid]
    rows = _rows(prediction, target, CENTIMETRES)
    assert {name: row.value for name, row in rows.items()} == pytest.approx(
        {
            "RMSE_cm": 100 * np.sqrt((error**2).mean()),
            "MAE_cm": 100 * error.mean(),
            "Beyond_5cm": (error > 0.05).mean(),
            "Beyond_delta1": (ratio > 1.25).mean(),
        },
        rel=1e-12,
    )
    assert [row.valid_share for row in rows.values()] == pytest.approx(4 * [valid.mean()])
    assert 0.02 < rows["Beyond_delta1"].value < 0.2 < rows["Beyond_5cm"].value < 0.8


def test_errors_of_disparity_are_in_levels_and_predictions_are_clamped_to_them() -> None:
    prediction, target = _levels()
    levels, truth = (15 / maps.numpy() - 40 for maps in (prediction, target))
    error = np.abs(levels.clip(0, 255) - truth)
    assert (levels < -1).any()
    assert (levels > 256).any()
    rows = _rows(prediction, target, LEVELS)
    assert {name: row.value for name, row in rows.items()} == pytest.approx(
        {"RMSE_levels": np.sqrt((error**2).mean()), "MAE_levels": error.mean()}, rel=1e-9
    )
    unclamped = _rows(prediction, target, replace(LEVELS, limits=None))
    assert unclamped["MAE_levels"].value == pytest.approx(np.abs(levels - truth).mean(), rel=1e-9)
    assert unclamped["MAE_levels"].value > 1.01 * rows["MAE_levels"].value


def test_thresholds_are_exceeded_only_beyond_them() -> None:
    target = torch.full((1, 1, 2, 4), 2.0, dtype=torch.float64)
    prediction = target * torch.tensor([1.25, 1.2501, 0.8, 0.7999], dtype=torch.float64)
    pair = SurfacePair(prediction, target, CAMERA.crop(0, 0, 2, 4).rays()[None])
    assert field.beyond_ratio(pair, 1.25).item() == 0.5
    pair = SurfacePair(target + torch.tensor([0.03125, -0.03125, 0.0313, -0.0313]), target, pair.rays)
    assert field.beyond(pair, 0.03125).item() == 0.5


def test_errors_of_a_batch_are_those_of_its_images() -> None:
    maps = [_levels(seed) for seed in (0, 1)]
    rays = CAMERA.rays()[None]
    batch = SurfacePair(*(torch.stack(each) for each in zip(*maps, strict=True)), rays, unit=LEVELS)
    for function in (field.rmse, field.mae):
        singles = [function(SurfacePair(p[None], t[None], rays, unit=LEVELS)) for p, t in maps]
        torch.testing.assert_close(function(batch), torch.cat(singles))


def test_errors_of_a_pair_are_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(Unit, "convert", lambda unit, depth: calls.append(unit) or 100 * depth)
    _rows(*_maps(), CENTIMETRES)
    assert len(calls) == 2  # the two maps


def test_image_without_a_prediction_has_no_score() -> None:
    prediction, target = _maps()
    rows = _rows(torch.full_like(prediction, torch.nan), target, CENTIMETRES)
    assert all(math.isnan(row.value) and row.valid_share == 0 for row in rows.values())


def test_collection_has_the_metrics_of_the_benchmarks_that_it_saw() -> None:
    metrics = visual_metrics(protocols=("field", "paper"))
    prediction, target = _levels()
    metrics.update(SurfacePair(prediction[None], target[None], CAMERA.rays()[None], unit=LEVELS))
    means = compute_means(metrics)
    assert {"RMSE_levels", "MAE_levels", "RMSE_v"} < means.keys()
    assert not {"RMSE_cm", "MAE_cm", "Beyond_5cm", "Beyond_delta1"} & means.keys()
    assert means["RMSE_levels"].item() == pytest.approx(_rows(prediction, target, LEVELS)["RMSE_levels"].value)


@pytest.mark.parametrize("protocols", [(), ("papers",), ("field", "none")])
def test_unknown_protocol_is_refused(protocols: tuple[str, ...]) -> None:
    came = ", ".join(protocols) or "none"
    with pytest.raises(ValueError, match=rf"^protocols: expected some of {', '.join(PROTOCOLS)}, got {came}$"):
        catalogue(protocols=protocols)
