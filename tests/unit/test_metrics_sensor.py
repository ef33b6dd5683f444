"""The metrics of real sensors, against numpy, scipy and scikit-image, and of a board, against closed forms."""

import math

import numpy as np
import pytest
import torch
from depth_steps import pair_of
from reference_metrics import LIGHTS, Intrinsics, normals_of
from scipy import ndimage
from skimage.metrics import structural_similarity

from dsr.geometry.camera import Camera
from dsr.metrics import sensor
from dsr.metrics.catalogue import catalogue, score_image

CAMERA = Camera(width=44, height=36, fx=60.0, fy=59.0, cx=21.0, cy=18.5)
METRICS = catalogue(protocols=("sensor",))


def _maps(seed=0):
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


def _reference(prediction, truth):
    known = np.isfinite(truth)
    inner = ndimage.binary_erosion(known, iterations=3)
    with np.errstate(invalid="ignore"):
        near = np.isfinite(prediction) & known & (np.abs(prediction - truth) < 0.1)
    scored = inner & ndimage.binary_erosion(near)
    offset = np.median((prediction - truth)[scored])
    median = np.median(truth[known])
    maps = [np.where(np.isfinite(z), z, median) for z in (prediction - offset, truth)]
    rays = Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy).rays(*truth.shape)
    first, second = (normals_of(z[..., None] * rays) for z in maps)
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


def _rows(prediction, truth):
    maps = (torch.from_numpy(each)[None] for each in (prediction, truth))
    return {(row.metric, row.variant): row for row in score_image(*maps, CAMERA.rays(), METRICS)}


@pytest.mark.parametrize("seed", [0, 1])
def test_scores_are_those_of_the_protocol_step_by_step(seed):
    prediction, truth = _maps(seed)
    if seed:
        prediction[:9] = np.nan  # rows without a prediction are not covered
    rows, expected = _rows(prediction, truth), _reference(prediction, truth)
    assert 0.4 < expected["Sensor_covered"] < 0.95
    assert {name for name, _ in rows} == expected.keys()
    for name, value in expected.items():
        if isinstance(value, list):
            assert [rows[name, f"e{i}"].value for i in (1, 2, 3, 4)] == pytest.approx(value, rel=1e-5)
            assert rows[name, "max"].value == pytest.approx(max(value), rel=1e-5)
        else:
            assert rows[name, ""].value == pytest.approx(value, rel=1e-5), name


def test_valid_share_is_that_of_the_scored_pixels():
    prediction, truth = _maps()
    rows = _rows(prediction, truth)
    inner = ndimage.binary_erosion(np.isfinite(truth), iterations=3).mean()
    assert rows["Sensor_covered", ""].valid_share == pytest.approx(inner)
    share = inner * rows["Sensor_covered", ""].value
    assert {round(row.valid_share, 9) for (name, _), row in rows.items() if name != "Sensor_covered"} == {
        round(share, 9)
    }


BOARD_CAMERA = Camera(width=64, height=48, fx=60.0, fy=62.0, cx=31.0, cy=24.5)
V, U = np.mgrid[:48, :64].astype(float)
X, Y = (U - 31) / 60, (V - 24.5) / 62


def _plane(x, y, distance):
    """Return the depth of the plane whose normal is along (x, y, 1)."""
    return distance * math.sqrt(x * x + y * y + 1) / (x * X + y * Y + 1)


def _board(prediction, truth):
    return pair_of(prediction, truth, BOARD_CAMERA)


def test_steep_planes_are_fitted_along_the_axis_that_they_face():
    random = np.random.default_rng(0)
    for normal in np.array([[1, 0.1, 0.02], [0.05, -1, 0.1], [0.2, 0.1, 1]]):
        unit = normal / np.linalg.norm(normal)
        spread = random.normal(size=(50, 3)) + 3 * unit
        points = spread - (spread @ unit - 3)[:, None] * unit
        found = sensor.plane_normal(torch.from_numpy(points)).numpy()
        np.testing.assert_allclose(found * np.sign(found @ unit), unit, atol=1e-12)
    assert sensor.plane_normal(torch.eye(3)[:2]).isnan().all()
    assert sensor.plane_normal(torch.arange(5.0)[:, None] * torch.ones(3)).isnan().all()


def test_waves_about_a_plane_have_the_deviation_of_their_amplitude_whatever_the_offset():
    truth = _plane(0.2, 0.1, 1.5)
    waves = 0.01 * np.sin(2 * np.pi * U / 8 + 0.3)
    found = sensor.board_errors(_board(truth + 0.05 + waves, truth))
    assert found["std"].item() == pytest.approx(0.01 / math.sqrt(2), rel=1e-3)
    assert found["covered"].item() == 1


@pytest.mark.parametrize("tilt", [0.05, 0.3])
def test_angle_is_that_between_two_planes(tilt):
    truth, prediction = np.full_like(X, 1.2), _plane(math.tan(tilt), 0, 1.2 * math.cos(tilt))
    pair = _board(np.where(np.abs(prediction - 1.2) < 0.05, prediction, np.nan), truth)
    assert sensor.board_errors(pair)["angle"].item() == pytest.approx(math.degrees(tilt), rel=1e-6)


def test_other_surfaces_and_holes_do_not_count_and_lower_the_coverage():
    truth = np.where((V > 5) & (V < 40) & (U > 5) & (U < 50), _plane(0.2, 0.1, 1.5), np.nan)
    noise = 0.002 * np.random.default_rng(1).standard_normal(truth.shape)
    prediction = truth + noise
    prediction[10:14, 10:20], prediction[20:24, 10:20] = np.nan, prediction[20:24, 10:20] + 0.2
    found = sensor.board_errors(_board(prediction, truth))
    kept = np.isfinite(truth)
    kept[10:14, 10:20] = kept[20:24, 10:20] = False
    assert found["covered"].item() == pytest.approx(kept.sum() / np.isfinite(truth).sum())
    assert found["std"].item() == pytest.approx(noise[kept].std(), rel=1e-9)
