"""The fast global smoother, against dense linear systems solved by numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from depth_steps import step_beside_a_photo_edge
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, Kernel, make_sample
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.classical.fast_global_smoother import FastGlobalSmoother, smooth, solve_lines
from dsr.methods.classical.interpolation import Interpolation
from dsr.sample import DepthSample, Scene


def _noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=shape))


def _line(colours: np.ndarray, values: np.ndarray, strength: float, sigma: float) -> np.ndarray:
    """Solve one line, colours (3, L), as a dense system."""
    system = np.eye(len(values))
    for k in range(len(values) - 1):
        w = strength * np.exp(-np.linalg.norm(colours[:, k] - colours[:, k + 1]) / sigma)
        system[k : k + 2, k : k + 2] += w * np.array([[1, -1], [-1, 1]])
    return np.linalg.solve(system, values)


def _by_dense_systems(guide: Tensor, values: Tensor, strength: float, sigma: float) -> np.ndarray:
    colours, u = guide.numpy(), values.numpy().copy()
    for share in (24 / 63, 6 / 63, 1.5 / 63):  # 3/2 * 4^(3 - t) / (4^3 - 1)
        for i in range(u.shape[0]):
            u[i] = _line(colours[:, i], u[i], share * strength, sigma)
        for j in range(u.shape[1]):
            u[:, j] = _line(colours[:, :, j], u[:, j], share * strength, sigma)
    return u


def _sample(disparity: Tensor, rgb: Tensor, kernel: Kernel = "box") -> DepthSample:
    height, width = disparity.shape
    camera = Camera(width, height, 60.0, 60.0, width / 2, height / 2)
    scene = Scene("set", "hall", rgb, camera, from_range(disparity[None], camera, "disparity"))
    return make_sample(scene, 4, Downsampling(kernel), "disparity")


def test_smoother_solves_rows_then_columns_three_times_with_the_papers_lambdas() -> None:
    guide, values = _noise(3, 16, 13), _noise(16, 13, seed=1)
    result = smooth(guide, values[None], 30.0, 0.3)[0]
    np.testing.assert_allclose(result, _by_dense_systems(guide, values, 30.0, 0.3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("length", [1, 2, 9])
def test_smoother_solves_lines_of_any_length(length: int) -> None:
    weights, right = _noise(length - 1, 4), _noise(length, 2, 4, seed=1)
    result = solve_lines(weights, right)
    for m in range(4):
        system = np.eye(length)
        for k in range(length - 1):
            system[k : k + 2, k : k + 2] += float(weights[k, m]) * np.array([[1, -1], [-1, 1]])
        np.testing.assert_allclose(result[:, :, m], np.linalg.solve(system, right[:, :, m].numpy()), atol=1e-13)


@pytest.mark.parametrize("slopes", [True, False])
def test_step_along_a_photo_edge_stays_sharp_within_a_low_resolution_pixel(slopes: bool) -> None:
    rgb, truth = step_beside_a_photo_edge()
    sample = _sample(truth, rgb)
    results = (FastGlobalSmoother(slopes=slopes), Interpolation("bilinear"))
    ours, bilinear = (to_range(method(sample), sample.camera, "disparity")[0] for method in results)
    assert float((ours - truth).abs().max()) < 1e-6
    assert float((bilinear - truth).abs().max()) > 1


@pytest.mark.parametrize("kernel", ["box", "nearest"])
def test_result_is_the_smoothed_data_divided_by_the_smoothed_index_map(kernel: Kernel) -> None:
    disparity = 5 + 4 * _noise(16, 16, seed=3)
    disparity[4:8, 8:12] = torch.nan
    rgb = _noise(3, 16, 16)
    sample = _sample(disparity, rgb, kernel)
    coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity")[0].numpy() * 4
    data, index = np.zeros((16, 16)), np.zeros((16, 16))
    for i, j in np.argwhere(np.isfinite(coarse)):
        first, last = (1, 3) if kernel == "box" else (2, 3)  # the centre lies between four pixels, or on one
        block = (slice(4 * i + first, 4 * i + last), slice(4 * j + first, 4 * j + last))
        data[block], index[block] = coarse[i, j], 1
    total, weight = (_by_dense_systems(rgb, torch.from_numpy(each), 0.7 * 16, 0.3) for each in (data, index))
    fine = FastGlobalSmoother(0.7, 0.3, fill_holes=True, slopes=False)(sample)
    np.testing.assert_allclose(to_range(fine, sample.camera, "disparity")[0], total / weight, rtol=1e-9)


@pytest.mark.parametrize("name", ["smoothness", "sigma_colour", "iterations"])
def test_parameter_that_is_not_positive_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: expected a positive number for the fast global smoother"):
        FastGlobalSmoother(**{name: 0})
