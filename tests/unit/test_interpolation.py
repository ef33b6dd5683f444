"""Interpolation, against scipy's zoom, repetition and closed forms of perspective depth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, Kernel, make_sample
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.classical.interpolation import Interpolation, Order
from dsr.sample import DepthSample, Scene
from dsr.utils.ratios import SCALES

CAMERA = Camera(width=48, height=32, fx=60.0, fy=55.0, cx=21.3, cy=17.9)
ORDERS: tuple[Order, ...] = ("nearest", "bilinear", "bicubic")


def _sample(perspective: Tensor, kernel: Kernel = "box", scale: int = 4) -> DepthSample:
    """Return the problem of a scene with these perspective depths, (H, W)."""
    camera = CAMERA.crop(0, 0, *perspective.shape)
    depth = from_range(perspective[None], camera, "perspective")
    scene = Scene("set", "hall", torch.zeros(3, *perspective.shape), camera, depth)
    return make_sample(scene, scale, Downsampling(kernel), "perspective")


def _coarse(perspective: np.ndarray, scale: int = 4) -> np.ndarray:
    height, width = perspective.shape
    return perspective.reshape(height // scale, scale, width // scale, scale).mean(axis=(1, 3))


def _random(seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(1.0, 3.0, (32, 48)))


def _ramp() -> Tensor:
    v, u = np.mgrid[:32, :48]
    return torch.from_numpy(2 + 0.03 * u - 0.02 * v)


def _result(sample: DepthSample, order: Order = "bicubic", *, fill_holes: bool = False) -> np.ndarray:
    """Return the fine perspective depth, (H, W)."""
    fine = Interpolation(order, fill_holes=fill_holes)(sample)
    assert fine.shape == (1, sample.camera.height, sample.camera.width)
    return to_range(fine, sample.camera, "perspective")[0].numpy()


@pytest.mark.parametrize("scale", SCALES)
def test_bicubic_equals_scipys_zoom_of_the_box_mean_of_perspective_depth(scale: int) -> None:
    perspective = _random()
    expected = ndimage.zoom(_coarse(perspective.numpy(), scale), scale, order=3, grid_mode=True, mode="nearest")
    np.testing.assert_allclose(_result(_sample(perspective, scale=scale)), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", SCALES)
def test_nearest_repeats_each_low_resolution_pixel(scale: int) -> None:
    perspective = _random()
    expected = np.kron(_coarse(perspective.numpy(), scale), np.ones((scale, scale)))
    np.testing.assert_allclose(_result(_sample(perspective, scale=scale), "nearest"), expected, rtol=1e-12)


def test_bilinear_weights_the_four_neighbours_by_distance() -> None:
    perspective = _random()
    coarse = np.pad(_coarse(perspective.numpy()), 1, mode="edge")
    v, u = (np.arange(size) / 4 - 0.375 + 1 for size in (32, 48))  # in the padded map
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[:, None], (u - j)[None]
    upper = (1 - b) * coarse[np.ix_(i, j)] + b * coarse[np.ix_(i, j + 1)]
    lower = (1 - b) * coarse[np.ix_(i + 1, j)] + b * coarse[np.ix_(i + 1, j + 1)]
    np.testing.assert_allclose(_result(_sample(perspective), "bilinear"), (1 - a) * upper + a * lower, rtol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("kernel", ["box", "nearest", "bicubic"])
def test_sphere_around_the_camera_is_reproduced(order: Order, kernel: Kernel) -> None:
    np.testing.assert_allclose(_result(_sample(torch.full((32, 48), 2.0).double(), kernel), order), 2.0, rtol=1e-12)


@pytest.mark.parametrize("kernel", ["box", "nearest"])
def test_low_and_high_resolution_pixels_are_matched_through_their_cameras(kernel: Kernel) -> None:
    perspective = _ramp()
    fine = _result(_sample(perspective, kernel), "bilinear")
    inside = (slice(2, -2), slice(2, -2))  # between the outermost low-resolution pixel centres
    np.testing.assert_allclose(fine[inside], perspective.numpy()[inside], rtol=1e-12)


def _with_holes() -> Tensor:
    perspective = _random()
    perspective[4:12, 8:16] = torch.nan  # 2 x 2 low-resolution pixels
    perspective[28:, :4] = torch.nan
    perspective[20, 20] = torch.nan  # one high-resolution pixel is no coarse hole
    return perspective


@pytest.mark.parametrize("order", ORDERS)
def test_holes_are_where_the_nearest_low_resolution_pixel_is_missing(order: Order) -> None:
    sample = _sample(_with_holes())
    expected = np.kron(~sample.mask_lr[0].numpy(), np.ones((4, 4), dtype=bool))
    assert expected.sum() == 80
    np.testing.assert_array_equal(np.isnan(_result(sample, order)), expected)


@pytest.mark.parametrize("order", ORDERS)
def test_inpainted_holes_are_interpolated_from_their_nearest_valid_pixels(order: Order) -> None:
    sample = _sample(_with_holes())
    filled = to_range(sample.depth_lr, sample.camera_lr, "perspective")[0].clone()
    for i, j, source in ((1, 2, (1, 1)), (2, 2, (2, 1)), (1, 3, (1, 4)), (2, 3, (2, 4))):
        filled[i, j] = filled[source]
    fine = _result(sample, order, fill_holes=True)
    assert np.isfinite(fine).all()
    if order == "nearest":  # each hole's pixels all have a known neighbour on two sides: either is nearest
        for i, j in ((1, 2), (2, 2), (1, 3), (2, 3)):
            around = [filled[i + di, j + dj].item() for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0))]
            assert min(abs(fine[4 * i, 4 * j] - value) for value in around) < 1e-12
    kept = np.isfinite(_result(sample, order))
    np.testing.assert_array_equal(fine[kept], _result(sample, order)[kept])


def test_values_far_from_a_hole_do_not_depend_on_it() -> None:
    whole, holed = _random(), _random()
    holed[:4, :4] = torch.nan
    np.testing.assert_allclose(
        _result(_sample(holed), "bilinear")[8:, 8:], _result(_sample(whole), "bilinear")[8:, 8:], rtol=1e-12
    )


def test_overshoot_below_zero_becomes_a_hole() -> None:
    perspective = torch.full((32, 48), 60.0, dtype=torch.float64)
    perspective[:, :24] = 0.05
    fine = _result(_sample(perspective))
    assert 0 < np.isnan(fine).sum() < 32 * 12
    assert (fine[np.isfinite(fine)] > 0).all()


def test_unknown_order_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"^order: expected one of nearest, bilinear, bicubic, clough_tocher, got 'cubic'"
    ):
        Interpolation("cubic")  # type: ignore[arg-type]
