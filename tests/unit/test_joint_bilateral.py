"""Joint bilateral upsampling, against a plain loop over pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.classical.bilateral import JointBilateral
from dsr.methods.classical.interpolation import Interpolation
from dsr.sample import DepthSample, Scene


def _sample(disparity: Tensor, rgb: Tensor, scale: int = 4) -> DepthSample:
    height, width = disparity.shape
    camera = Camera(width, height, 60.0, 60.0, width / 2, height / 2)
    scene = Scene("set", "hall", rgb, camera, from_range(disparity[None], camera, "disparity"))
    return make_sample(scene, scale, Downsampling("box"), "disparity")


def _disparity(sample: DepthSample, depth: Tensor) -> np.ndarray:
    return to_range(depth, sample.camera, "disparity")[0].numpy()


def _by_loops(sample: DepthSample, radius: int, sigma_space: float, sigma_colour: float) -> np.ndarray:
    """Sum over the neighbours of each HR pixel, LR pixel (i, j) lying at its block's centre."""
    coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity")[0].numpy() * 4
    rgb = sample.rgb.numpy()
    height, width = rgb.shape[1:]
    means = rgb.reshape(3, height // 4, 4, width // 4, 4).mean(axis=(2, 4))
    result = np.full((height, width), np.nan)
    for v in range(height):
        for u in range(width):
            total = weights = 0.0
            for i in range(max(v // 4 - radius, 0), min(v // 4 + radius + 1, height // 4)):
                for j in range(max(u // 4 - radius, 0), min(u // 4 + radius + 1, width // 4)):
                    if math.isnan(coarse[i, j]):
                        continue
                    distance = math.hypot((v - 1.5) / 4 - i, (u - 1.5) / 4 - j)
                    unlike = np.linalg.norm(rgb[:, v, u] - means[:, i, j])
                    weight = math.exp(-0.5 * (distance / sigma_space) ** 2 - 0.5 * (unlike / sigma_colour) ** 2)
                    total, weights = total + weight * coarse[i, j], weights + weight
            result[v, u] = total / weights if weights else np.nan
    return result


@pytest.mark.parametrize(("radius", "sigma_space", "sigma_colour"), [(1, 0.5, 0.1), (2, 1.0, 0.3)])
@pytest.mark.parametrize("holes", [False, True])
def test_joint_bilateral_is_the_mean_weighted_by_distance_and_colour(
    radius: int, sigma_space: float, sigma_colour: float, holes: bool
) -> None:
    random = np.random.default_rng(0)
    disparity = torch.from_numpy(random.uniform(5, 9, (16, 16)))
    if holes:
        disparity[4:8, 8:12] = torch.nan
        disparity[:4, :4] = torch.nan
    sample = _sample(disparity, torch.from_numpy(random.uniform(size=(3, 16, 16))))
    method = JointBilateral(radius, sigma_space, sigma_colour, fill_holes=True, slopes=False)
    expected = _by_loops(sample, radius, sigma_space, sigma_colour)
    np.testing.assert_allclose(_disparity(sample, method(sample)), expected, rtol=1e-10)


@pytest.mark.parametrize("slopes", [True, False])
def test_step_along_a_photo_edge_stays_sharp_within_a_low_resolution_pixel(slopes: bool) -> None:
    columns = torch.arange(64).expand(48, 64)
    rgb = torch.where(columns < 32, 0.2, 0.8).double().expand(3, 48, 64).contiguous()
    truth = torch.where(columns < 32, 5.0, 9.0).double()
    sample = _sample(truth, rgb)
    ours = np.abs(_disparity(sample, JointBilateral(slopes=slopes)(sample)) - truth.numpy())
    bilinear = np.abs(_disparity(sample, Interpolation("bilinear")(sample)) - truth.numpy())
    assert ours.max() < 1e-6
    assert bilinear.max() > 1


@pytest.mark.parametrize("name", ["radius", "sigma_space", "sigma_colour"])
def test_parameter_that_is_not_positive_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: expected a positive number for joint bilateral upsampling"):
        JointBilateral(**{name: -1})
