"""The estimate of a sensor's noise, where the usual one fails: rounded values and correlated noise."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.methods.images import estimate_noise, estimate_sensor_noise, normal_noise_deg


def _ramp() -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    return (2 + 0.01 * rows + 0.005 * columns).double()[None, None]


def _draws() -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(1, 1, 120, 160, generator=generator, dtype=torch.float64)


def test_white_noise_is_estimated_with_steps_and_holes() -> None:
    values = _ramp() + 0.01 * _draws()
    values[..., 80:] += 3
    values[..., 20:40, 30:60] = torch.nan
    assert estimate_sensor_noise(values) == pytest.approx(0.01, rel=0.1)


def test_noise_of_rounded_values_is_found() -> None:
    values = ((3 + 0.005 * _draws()) / 0.0125).round() * 0.0125  # mostly one of two values
    assert estimate_noise(values.exp()) == 0
    assert estimate_sensor_noise(values) == pytest.approx(0.006, rel=0.7)


def test_noise_that_neighbours_share_is_found_better_than_from_neighbours_alone() -> None:
    smooth = functional.avg_pool2d(functional.pad(_draws(), (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    values = 0.01 * smooth / smooth.std()
    assert estimate_noise(values.exp()) < 0.0025
    assert 0.005 < estimate_sensor_noise(values) < 0.012


def test_clean_and_tiny_maps_have_no_noise() -> None:
    assert estimate_sensor_noise(_ramp()) < 1e-9
    assert estimate_sensor_noise(_ramp()[..., :2, :2]) == 0
    assert estimate_sensor_noise(torch.full((1, 1, 8, 8), torch.nan)) == 0


@pytest.mark.parametrize("std", [0.001, 0.01])
def test_noise_level_is_estimated_from_the_depth_map_alone(std: float) -> None:
    v, u = torch.meshgrid(torch.linspace(0, 1, 90), torch.linspace(0, 1, 120), indexing="ij")
    depth = (2 + u + 0.5 * v + 1.5 * (u > 0.4))[None, None].double()
    noisy = depth * (
        1 + std * torch.randn(depth.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    )
    noisy[..., 20:40, 30:60] = torch.nan
    assert estimate_noise(noisy) == pytest.approx(std, rel=0.1)
    assert estimate_noise(depth) < 1e-5
    assert estimate_noise(depth[..., :2, :2]) == 0


def test_normal_noise_deg_is_the_tilt_of_a_frontal_surface() -> None:
    camera = Camera(width=200, height=150, fx=80.0, fy=80.0, cx=99.5, cy=74.5)
    draws = torch.randn(1, 1, 150, 200, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    normals = depth_to_normals(3 * (1 + 0.001 * draws), camera.rays()[None])
    slopes = (normals[:, 0] / normals[:, 2])[..., 60:90, 80:120]
    assert math.degrees(math.atan(float(slopes.std()))) == pytest.approx(normal_noise_deg(0.001, camera), rel=0.1)
    assert normal_noise_deg(0.0, camera) == 0
