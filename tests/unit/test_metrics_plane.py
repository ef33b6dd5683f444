"""Scores of a sensor before something flat: closed forms and a board seen by a camera."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from dsr.data.frame_files import read_millimetres
from dsr.geometry.camera import Camera
from dsr.metrics.functional import SurfacePair
from dsr.metrics.plane import angle, covered, deviation, fit_plane

CAMERA = Camera(width=64, height=48, fx=60.0, fy=62.0, cx=31.0, cy=24.5)
V, U = np.mgrid[:48, :64].astype(float)
X, Y = (U - 31) / 60, (V - 24.5) / 62


def _plane(x: float, y: float, distance: float) -> np.ndarray:
    """Return the depth of the plane whose normal is along (x, y, 1)."""
    return distance * math.sqrt(x * x + y * y + 1) / (x * X + y * Y + 1)


def _pair(prediction: Any, truth: Any, mask: Any = None) -> SurfacePair:
    maps = (torch.as_tensor(each, dtype=torch.float64)[None, None] for each in (prediction, truth))
    return SurfacePair(*maps, CAMERA.rays()[None], None if mask is None else torch.from_numpy(mask)[None, None])


def test_steep_planes_are_fitted_along_the_axis_that_they_face() -> None:
    random = np.random.default_rng(0)
    for normal in np.array([[1, 0.1, 0.02], [0.05, -1, 0.1], [0.2, 0.1, 1]]):
        unit = normal / np.linalg.norm(normal)
        spread = random.normal(size=(50, 3)) + 3 * unit
        points = spread - (spread @ unit - 3)[:, None] * unit
        found, distance = fit_plane(torch.from_numpy(points))
        np.testing.assert_allclose(found.numpy(), unit, atol=1e-12)
        assert float(distance) == pytest.approx(3)


def test_points_that_span_no_plane_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^points: expected at least three that are not in a line, got 2$"):
        fit_plane(torch.eye(3)[:2])
    with pytest.raises(ValueError, match=r"^points: expected at least three .* got 5$"):
        fit_plane(torch.arange(5.0)[:, None] * torch.ones(3))


def test_waves_about_a_plane_have_the_deviation_of_their_amplitude_whatever_the_offset() -> None:
    truth = _plane(0.2, 0.1, 1.5)
    waves = 0.01 * np.sin(2 * np.pi * U / 8 + 0.3)
    pair = _pair(truth + 0.05 + waves, truth)
    assert deviation(pair).item() == pytest.approx(0.01 / math.sqrt(2), rel=1e-3)
    assert covered(pair).item() == 1


@pytest.mark.parametrize("tilt", [0.05, 0.3])
def test_angle_is_that_between_two_planes(tilt: float) -> None:
    truth, prediction = np.full_like(X, 1.2), _plane(math.tan(tilt), 0, 1.2 * math.cos(tilt))
    assert angle(_pair(np.where(np.abs(prediction - 1.2) < 0.05, prediction, np.nan), truth)).item() == pytest.approx(
        math.degrees(tilt), rel=1e-6
    )


def test_other_surfaces_and_holes_do_not_count_and_lower_the_coverage() -> None:
    truth = np.where((V > 5) & (V < 40) & (U > 5) & (U < 50), _plane(0.2, 0.1, 1.5), np.nan)
    noise = 0.002 * np.random.default_rng(1).standard_normal(truth.shape)
    prediction = truth + noise
    prediction[10:14, 10:20], prediction[20:24, 10:20] = np.nan, prediction[20:24, 10:20] + 0.2
    pair = _pair(prediction, truth)
    kept = np.isfinite(truth)
    kept[10:14, 10:20] = kept[20:24, 10:20] = False
    assert covered(pair).item() == pytest.approx(kept.sum() / np.isfinite(truth).sum())
    assert deviation(pair).item() == pytest.approx(noise[kept].std(), rel=1e-9)
    nothing = _pair(np.full_like(truth, np.nan), truth)
    assert covered(nothing).item() == 0
    assert math.isnan(deviation(nothing).item())
    assert math.isnan(angle(nothing).item())


def test_frames_before_a_board_have_their_known_scores(shared: Path) -> None:
    folder = shared / "real" / "stereo_board"
    facts = json.loads((folder / "board.json").read_text())
    rays, found = Camera(**facts["camera"]).rays()[None], []
    for name, frame in facts["frames"].items():
        plane = torch.from_numpy(cv2.imread(str(folder / "plane" / f"{name}.png"), cv2.IMREAD_UNCHANGED) / 1e4)
        outline = np.zeros(tuple(plane.shape), np.uint8)
        cv2.fillPoly(outline, [np.round(frame["polygon"]).astype(np.int32)], 1)
        inside = torch.from_numpy(cv2.distanceTransform(outline, cv2.DIST_L2, 5))
        depth = read_millimetres(folder / "depth" / f"{name}.png")[None].double()
        truth = plane.masked_fill(plane == 0, torch.nan)[None, None]
        masks = (inside[None, None] > 12, (inside[None, None] > 12) & (inside[None, None] <= 36))
        board, border = (SurfacePair(depth, truth, rays, mask) for mask in masks)
        found.append([1e3 * deviation(board).item(), 1e3 * deviation(border).item(), angle(board).item()])
    # published as 9.7, 10.1 and 35.6; these are of a script in numpy with the plane's normal of board.json
    np.testing.assert_allclose(np.mean(found, axis=0), (9.786, 10.15, 36.82), rtol=1e-3)
