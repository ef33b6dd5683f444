"""Filters of depth maps, with and without a photo: each against its definition."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from small_scenes import disparity_of, sample_of

from dsr.geometry.camera import Camera, to_range
from dsr.methods.classical.bilateral import Bilateral, JointBilateral, filter_bilateral
from dsr.methods.classical.fast_global_smoother import FastGlobalSmoother, smooth
from dsr.methods.classical.guided_filter import GuidedFilter, estimate_slopes, guided_filter
from dsr.methods.classical.interpolation import Interpolation
from dsr.sample import DepthSample

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)


def _mean_around(values, row, column, radius, sigmas):
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


def test_filter_averages_pixels_of_similar_depth_and_leaves_out_holes():
    """With a step, at depths so small that a hole that counted as 0 would weigh."""
    values = np.random.default_rng(0).normal(0.05, 0.005, (12, 16)).astype(np.float32)
    values[:, 8:] += 0.5
    values[4:7, 5:7] = np.nan
    result = filter_bilateral(torch.from_numpy(values)[None], 7, 0.02, 1.5)[0].numpy()
    np.testing.assert_array_equal(np.isnan(result), np.isnan(values))
    for row, column in ((3, 3), (5, 4), (5, 8), (7, 7), (8, 12)):
        assert result[row, column] == pytest.approx(_mean_around(values, row, column, 3, (0.02, 1.5)), rel=1e-5)


@pytest.mark.parametrize("size", [(12, 16), (5, 6), (3, 4)])
def test_plane_is_reproduced_at_every_ratio(size):
    camera_lr = CAMERA.rescale(size[1], size[0])
    direction = torch.tensor([0.1, -0.05, 1.0], dtype=torch.float64)[:, None, None]
    plane_lr, plane = (2 / (each.rays() * direction).sum(dim=0, keepdim=True) for each in (camera_lr, CAMERA))
    photo, scale = torch.rand(3, 12, 16), 16 / size[1]
    sample = DepthSample("set", "hall", photo, plane_lr, CAMERA, camera_lr, scale)
    depth = Bilateral(sigma_depth=1e-6)(sample)  # so narrow that the filter changes nothing
    torch.testing.assert_close(depth, plane, rtol=1e-5, atol=0)


@pytest.mark.shared
def test_frame_of_a_structured_light_camera_is_filtered_as_opencv_does(shared):
    camera = Camera(**json.loads((shared / "expected" / "real_sensor.json").read_text())["camera"])
    raw = cv2.imread(str(shared / "real/ddrnet/depth_map/frame_000001.png"), -1).astype(np.float32) / 1000
    expected = cv2.bilateralFilter(raw, d=19, sigmaColor=0.03, sigmaSpace=3)
    depth_lr = torch.from_numpy(np.where(raw > 0, raw, np.nan))[None]
    photo = torch.zeros(3, camera.height, camera.width)
    depth = Bilateral()(DepthSample("ddrnet", "frame_000001", photo, depth_lr, camera, camera, 1))[0].numpy()
    np.testing.assert_array_equal(depth, np.where(raw > 0, expected, np.nan))


METHODS = (GuidedFilter, JointBilateral, FastGlobalSmoother)
every_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__)


def _noise(*shape, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=shape))


def _sample(disparity, kernel="box", rgb=None):
    """Return the problem of a scene with these disparities, (H, W), at scale 4."""
    return sample_of(disparity, _noise(3, *disparity.shape, seed=1) if rgb is None else rgb, kernel=kernel)


def _result(method, sample):
    """Return the high-resolution disparity, (H, W)."""
    return disparity_of(method(sample), sample)


@every_method
def test_result_without_slopes_lies_between_the_valid_values(method):
    """A hole that counted as 0 would pull its surroundings below 5."""
    flat = torch.full((32, 48), 5.0).double()
    lonely = torch.full_like(flat, torch.nan)
    flat[8:20, 12:32], lonely[8:12, 8:12] = torch.nan, 5.0
    for given, slopes in ((flat, True), (flat, False), (lonely, True)):
        fine = _result(method(fill_holes=True, slopes=slopes), _sample(given))
        torch.testing.assert_close(fine, torch.full_like(fine, 5.0), rtol=0, atol=1e-10)


@every_method
def test_result_is_positive_depth_even_where_far_and_near_meet(method):
    disparity = torch.where(torch.arange(48) % 16 < 8, 0.01, 40.0).double().expand(32, 48)
    sample = _sample(disparity)
    fine = method()(sample)
    assert bool((fine > 0).all())
    assert float(fine.max()) <= 4 * float(sample.depth_lr.max()) + 1e-9


def test_slope_is_the_smaller_difference_without_a_pixel_that_mixes_a_step_or_is_a_hole():
    values = torch.tensor([[0.0, 1.0, 2.0, 6.0, 10.0, 11.0, 12.0, 11.0, 10.0]]).double()
    expected = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0]]).double()
    torch.testing.assert_close(estimate_slopes(values, 1), expected)
    torch.testing.assert_close(estimate_slopes(values.T, 0), expected.T)
    pierced = torch.tensor([0.0, 2.0, 4.0, torch.nan, 9.0, 12.0, 15.0]).double()
    torch.testing.assert_close(estimate_slopes(pierced, 0), torch.tensor([2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0]).double())


def _by_regression(guide, values, radius, epsilon, weight):
    """Fit each window by weighted ridge regression (numpy's lstsq), then average the fits."""
    colours, p, w = guide.numpy(), values.numpy(), weight.numpy()
    height, width = p.shape
    total, counted = np.zeros((height, width)), np.zeros((height, width))
    for i in range(height):
        for j in range(width):
            rows, columns = slice(max(i - radius, 0), i + radius + 1), slice(max(j - radius, 0), j + radius + 1)
            share, target = w[rows, columns].ravel(), p[rows, columns].ravel()
            samples = colours[:, rows, columns].reshape(3, -1).T
            if share.sum() == 0:
                continue
            root = np.sqrt(share)[:, None]
            ridge = np.sqrt(epsilon * share.sum()) * np.eye(3, 4)
            design = np.vstack((root * np.column_stack((samples, np.ones(len(share)))), ridge))
            fit = np.linalg.lstsq(design, np.concatenate((root[:, 0] * target, np.zeros(3))), rcond=None)[0]
            answer = np.tensordot(fit[:3], colours[:, rows, columns], 1) + fit[3]
            total[rows, columns] += share.mean() * answer
            counted[rows, columns] += share.mean()
    return np.where(counted > 0, total / np.where(counted > 0, counted, 1), p)


@pytest.mark.parametrize("radius", [1, 3])
@pytest.mark.parametrize("holes", [False, True])
def test_guided_filter_is_the_mean_of_each_windows_ridge_regression(radius, holes):
    guide, values, weight = _noise(3, 16, 16), _noise(16, 16, seed=1), torch.ones(16, 16).double()
    if holes:
        weight = _noise(16, 16, seed=2)
        weight[3:12, 4:14] = 0
    result = guided_filter(guide, values[None], radius, 1e-3, weight)[0]
    np.testing.assert_allclose(result, _by_regression(guide, values, radius, 1e-3, weight), rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", [JointBilateral, FastGlobalSmoother])
@pytest.mark.parametrize("slopes", [True, False])
def test_step_along_a_photo_edge_stays_sharp_within_a_low_resolution_pixel(method, slopes):
    columns = torch.arange(64).expand(48, 64)
    rgb = torch.where(columns < 32, 0.2, 0.8).double().expand(3, 48, 64).contiguous()
    truth = torch.where(columns < 32, 5.0, 9.0).double()
    sample = _sample(truth, rgb=rgb)
    assert float((_result(method(slopes=slopes), sample) - truth).abs().max()) < 1e-6
    bilinear = _result(Interpolation("bilinear"), sample)
    assert float((bilinear - truth).abs().max()) > 1


def _by_neighbours(sample, radius, sigma_space, sigma_colour):
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
def test_joint_bilateral_is_the_mean_weighted_by_distance_and_colour(radius, sigma_space, sigma_colour, holes):
    disparity = 5 + 4 * _noise(16, 16)
    if holes:
        disparity[4:8, 8:12] = torch.nan
        disparity[:4, :4] = torch.nan
    sample = _sample(disparity)
    method = JointBilateral(radius, sigma_space, sigma_colour, fill_holes=True, slopes=False)
    expected = _by_neighbours(sample, radius, sigma_space, sigma_colour)
    np.testing.assert_allclose(_result(method, sample), expected, rtol=1e-10)


def _line(colours, values, strength, sigma):
    """Solve one line, colours (3, L), as a dense system."""
    system = np.eye(len(values))
    for k in range(len(values) - 1):
        w = strength * np.exp(-np.linalg.norm(colours[:, k] - colours[:, k + 1]) / sigma)
        system[k : k + 2, k : k + 2] += w * np.array([[1, -1], [-1, 1]])
    return np.linalg.solve(system, values)


def _by_dense_systems(guide, values, strength, sigma):
    colours, u = guide.numpy(), values.numpy().copy()
    for share in (24 / 63, 6 / 63, 1.5 / 63):  # 3/2 * 4^(3 - t) / (4^3 - 1)
        for i in range(u.shape[0]):
            u[i] = _line(colours[:, i], u[i], share * strength, sigma)
        for j in range(u.shape[1]):
            u[:, j] = _line(colours[:, :, j], u[:, j], share * strength, sigma)
    return u


@pytest.mark.parametrize("size", [(16, 13), (1, 9), (2, 1)])
def test_smoother_solves_rows_then_columns_three_times_with_the_papers_lambdas(size):
    guide, values = _noise(3, *size), _noise(*size, seed=1)
    result = smooth(guide, values[None], 30.0, 0.3, 3)[0]
    np.testing.assert_allclose(result, _by_dense_systems(guide, values, 30.0, 0.3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kernel", ["box", "nearest"])
def test_result_is_the_smoothed_data_divided_by_the_smoothed_index_map(kernel):
    disparity = 5 + 4 * _noise(16, 16, seed=3)
    disparity[4:8, 8:12] = torch.nan
    rgb = _noise(3, 16, 16)
    sample = _sample(disparity, kernel, rgb=rgb)
    coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity")[0].numpy() * 4
    data, index = np.zeros((16, 16)), np.zeros((16, 16))
    for i, j in np.argwhere(np.isfinite(coarse)):
        first, last = (1, 3) if kernel == "box" else (2, 3)  # the centre lies between four pixels, or on one
        block = (slice(4 * i + first, 4 * i + last), slice(4 * j + first, 4 * j + last))
        data[block], index[block] = coarse[i, j], 1
    total, weight = (_by_dense_systems(rgb, torch.from_numpy(each), 0.7 * 16, 0.3) for each in (data, index))
    method = FastGlobalSmoother(0.7, 0.3, fill_holes=True, slopes=False)
    np.testing.assert_allclose(_result(method, sample), total / weight, rtol=1e-9)
