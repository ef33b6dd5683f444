"""The bilateral filter of a sensor's map, against its definition, one pixel at a time."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.methods.classical.bilateral import Bilateral, filter_bilateral
from dsr.sample import DepthSample

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)


def _map(height: int, width: int) -> np.ndarray:
    """Return noisy depth with a step, (height, width)."""
    values = np.random.default_rng(0).normal(1.0, 0.01, (height, width))
    values[:, width // 2 :] += 0.5
    return values.astype(np.float32)


def _sample(depth_lr: np.ndarray, scale: float = 1) -> DepthSample:
    camera_lr = CAMERA.rescale(depth_lr.shape[1], depth_lr.shape[0])
    photo = torch.rand(3, CAMERA.height, CAMERA.width)
    return DepthSample("set", "hall", photo, torch.from_numpy(depth_lr)[None], CAMERA, camera_lr, scale)


def _mean_around(values: np.ndarray, row: int, column: int, radius: int, sigmas: tuple[float, float]) -> float:
    """Return the bilateral mean at a pixel that is no hole and ``radius`` from the border."""
    total = weights = 0.0
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            other = values[row + i, column + j]
            if np.isfinite(other) and math.hypot(i, j) <= radius:
                difference = (other - values[row, column]) / sigmas[0]
                weight = math.exp(-(difference**2) / 2 - (i * i + j * j) / (2 * sigmas[1] ** 2))
                total, weights = total + weight * other, weights + weight
    return total / weights


def test_filter_averages_pixels_of_similar_depth_and_leaves_out_holes() -> None:
    values = _map(12, 16)
    values[4:7, 5:7] = np.nan
    result = filter_bilateral(torch.from_numpy(values)[None], 7, 0.02, 1.5)[0].numpy()
    np.testing.assert_array_equal(np.isnan(result), np.isnan(values))
    for row, column in ((3, 3), (5, 4), (5, 8), (7, 7), (8, 12)):
        assert result[row, column] == pytest.approx(_mean_around(values, row, column, 3, (0.02, 1.5)), rel=1e-5)


def test_holes_have_no_weight_however_near_the_surface_is() -> None:
    values = np.full((12, 16), 0.05, np.float32)
    values[5, 5] = np.nan
    result = filter_bilateral(torch.from_numpy(values)[None], 7, 0.05, 2.0)
    np.testing.assert_allclose(result[result.isfinite()].numpy(), 0.05, rtol=1e-6)


def test_map_of_the_photo_s_size_is_filtered_and_keeps_its_holes() -> None:
    values = _map(12, 16)
    values[2, 3] = np.nan
    depth = Bilateral(7, 0.02, 1.5)(_sample(values))
    assert torch.equal(depth.nan_to_num(), filter_bilateral(torch.from_numpy(values)[None], 7, 0.02, 1.5).nan_to_num())
    filled = Bilateral(7, 0.02, 1.5, fill_holes=True)(_sample(values))
    assert bool(filled.isfinite().all())
    assert torch.equal(filled[depth.isfinite()], depth[depth.isfinite()])


@pytest.mark.parametrize("size", [(12, 16), (5, 6), (3, 4)])
def test_plane_is_reproduced_at_every_ratio(size: tuple[int, int]) -> None:
    camera_lr = CAMERA.rescale(size[1], size[0])
    direction = torch.tensor([0.1, -0.05, 1.0], dtype=torch.float64)[:, None, None]
    plane_lr, plane = (2 / (each.rays() * direction).sum(dim=0, keepdim=True) for each in (camera_lr, CAMERA))
    photo, scale = torch.rand(3, 12, 16), 16 / size[1]
    sample = DepthSample("set", "hall", photo, plane_lr, CAMERA, camera_lr, scale)
    depth = Bilateral(sigma_depth=1e-6)(sample)  # so narrow that the filter changes nothing
    torch.testing.assert_close(depth, plane, rtol=1e-5, atol=0)


def test_hole_of_a_smaller_map_stays_a_hole() -> None:
    values = _map(3, 4)
    values[1, 2] = np.nan
    depth = Bilateral()(_sample(values, 4))
    expected = torch.zeros(1, 12, 16, dtype=torch.bool)
    expected[:, 4:8, 8:12] = True
    assert torch.equal(depth.isnan(), expected)


@pytest.mark.shared
def test_frame_of_a_structured_light_camera_is_filtered_as_opencv_does(shared: Path) -> None:
    camera = Camera(**json.loads((shared / "expected" / "real_sensor.json").read_text())["camera"])
    raw = cv2.imread(str(shared / "real/ddrnet/depth_map/frame_000001.png"), -1).astype(np.float32) / 1000
    expected = cv2.bilateralFilter(raw, d=19, sigmaColor=0.03, sigmaSpace=3)
    depth_lr = torch.from_numpy(np.where(raw > 0, raw, np.nan))[None]
    photo = torch.zeros(3, camera.height, camera.width)
    depth = Bilateral()(DepthSample("ddrnet", "frame_000001", photo, depth_lr, camera, camera, 1))[0].numpy()
    np.testing.assert_array_equal(depth, np.where(raw > 0, expected, np.nan))
