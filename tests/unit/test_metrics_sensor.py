"""The metrics for real sensors, against numpy, scipy and scikit-image, step by step as the protocol has them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from reference_metrics import LIGHTS, Array, Intrinsics, Reference
from scipy import ndimage
from skimage.metrics import structural_similarity

from dsr.geometry.camera import Camera
from dsr.metrics import sensor
from dsr.metrics.catalogue import Score, catalogue, score_image
from dsr.metrics.functional import SurfacePair

CAMERA = Camera(width=44, height=36, fx=60.0, fy=59.0, cx=21.0, cy=18.5)
METRICS = catalogue(protocols=("sensor",))


def _maps(seed: int = 0) -> tuple[Array, Array]:
    """Return a noisy, shifted prediction with holes and outliers, and a bumpy truth with unknown pixels, (36, 44)."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:36, :44]
    truth = 1.2 + 0.002 * u + 0.01 * np.sin(u / 3) * np.cos(v / 4)
    prediction = truth + 0.004 + 0.001 * random.standard_normal(truth.shape)
    prediction[random.random(truth.shape) < 0.01] += 0.3
    prediction[20:23, 30:34] = np.nan
    truth[random.random(truth.shape) < 0.004] = np.nan
    truth[:, 40:] = np.nan
    return prediction, truth


def _reference(prediction: Array, truth: Array) -> dict[str, float | list[float]]:
    known = np.isfinite(truth)
    inner = ndimage.binary_erosion(known, iterations=3)
    with np.errstate(invalid="ignore"):
        near = np.isfinite(prediction) & known & (np.abs(prediction - truth) < 0.1)
    scored = inner & ndimage.binary_erosion(near)
    offset = np.median((prediction - truth)[scored])
    median = np.median(truth[known])
    maps = [np.where(np.isfinite(z), z, median) for z in (prediction - offset, truth)]
    rays = Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy).rays(*truth.shape)
    first, second = (Reference._normals(z[..., None] * rays) for z in maps)
    renderings = [np.clip(np.einsum("lc,hwc->lhw", LIGHTS, n), 0, 1) for n in (first, second)]
    similar = [structural_similarity(x, y, data_range=2, full=True)[1] for x, y in zip(*renderings, strict=True)]
    angle = np.degrees(np.arccos(np.clip((first * second).sum(axis=-1), -1, 1)))[scored]
    return {
        "Sensor_RMSE_v": np.sqrt(((first - second)[scored] ** 2).mean()),
        "Sensor_DSSIM_v": [(1 - each)[scored].mean() for each in similar],
        "Sensor_angle_mean": angle.mean(),
        "Sensor_angle_median": np.median(angle),
        "Sensor_covered": scored.sum() / inner.sum(),
        "Sensor_offset": abs(offset),
        "Sensor_RMSE_d": np.sqrt(((maps[0] - maps[1])[scored] ** 2).mean()),
    }


def _rows(prediction: Array, truth: Array) -> dict[tuple[str, str], Score]:
    maps = (torch.from_numpy(each)[None] for each in (prediction, truth))
    return {(row.metric, row.variant): row for row in score_image(*maps, CAMERA.rays(), METRICS)}


def _check(prediction: Array, truth: Array) -> None:
    rows, expected = _rows(prediction, truth), _reference(prediction, truth)
    assert {name for name, _ in rows} == expected.keys()
    for name, value in expected.items():
        if isinstance(value, list):
            assert [rows[name, f"e{i}"].value for i in (1, 2, 3, 4)] == pytest.approx(value, rel=1e-5)
            assert rows[name, "max"].value == pytest.approx(max(value), rel=1e-5)
        else:
            assert rows[name, ""].value == pytest.approx(value, rel=1e-5), name


@pytest.mark.parametrize("seed", [0, 1])
def test_scores_are_those_of_the_protocol_step_by_step(seed: int) -> None:
    prediction, truth = _maps(seed)
    assert 0.4 < _reference(prediction, truth)["Sensor_covered"] < 0.95  # type: ignore[operator]
    _check(prediction, truth)


def test_rows_without_a_prediction_count_as_not_covered() -> None:
    prediction, truth = _maps()
    prediction[:9] = np.nan
    _check(prediction, truth)
    before, after = (_rows(*maps)["Sensor_covered", ""].value for maps in (_maps(), (prediction, truth)))
    assert after < 0.85 * before


def test_valid_share_is_that_of_the_scored_pixels() -> None:
    prediction, truth = _maps()
    rows = _rows(prediction, truth)
    inner = ndimage.binary_erosion(np.isfinite(truth), iterations=3).mean()
    assert rows["Sensor_covered", ""].valid_share == pytest.approx(inner)
    share = inner * rows["Sensor_covered", ""].value
    assert {round(row.valid_share, 9) for (name, _), row in rows.items() if name != "Sensor_covered"} == {
        round(share, 9)
    }


def test_prediction_that_is_nowhere_near_covers_nothing() -> None:
    prediction, truth = _maps()
    rows = _rows(prediction + 5, truth)
    assert rows["Sensor_covered", ""].value == 0
    assert all(math.isnan(row.value) for (name, _), row in rows.items() if name != "Sensor_covered")
    assert math.isnan(_rows(prediction, np.full_like(truth, np.nan))["Sensor_covered", ""].value)


def test_scores_of_a_batch_are_those_of_its_images() -> None:
    maps = [tuple(torch.from_numpy(each)[None, None] for each in _maps(seed)) for seed in (0, 1)]
    rays = CAMERA.rays()[None]
    batch = SurfacePair(*(torch.cat(each) for each in zip(*maps, strict=True)), rays)
    for metric in METRICS:
        singles = [metric.function(SurfacePair(*each, rays)) for each in maps]
        torch.testing.assert_close(metric.function(batch), torch.cat(singles))


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_erosion_is_scipys(steps: int) -> None:
    mask = np.random.default_rng(0).random((2, 1, 17, 23)) < 0.9
    expected = np.stack([ndimage.binary_erosion(each[0], iterations=steps) if steps else each[0] for each in mask])
    np.testing.assert_array_equal(sensor.erode(torch.from_numpy(mask), steps)[:, 0].numpy(), expected)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8])
def test_masked_median_is_numpys(count: int) -> None:
    values = torch.randn(1, 1, 2, 4, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
    mask = torch.zeros(8, dtype=torch.bool)
    mask[:count] = True
    mask = mask.flip(0).view(1, 1, 2, 4)
    found = sensor.masked_median(values, mask)
    expected = np.median(values[mask].numpy()) if count else np.nan
    assert found.shape == (1, 1, 1, 1)
    assert found.item() == pytest.approx(expected, nan_ok=True)
