"""Interpolation, against scipy's zoom, repetition and closed forms of perspective depth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import RANGE_TYPES, Camera, from_range, to_range
from dsr.methods.classical.interpolation import CubicConvolution, Interpolation
from dsr.sample import DepthSample, Scene
from dsr.utils.ratios import SCALES

CAMERA = Camera(width=48, height=32, fx=60.0, fy=55.0, cx=21.3, cy=17.9)
ORDERS = ("nearest", "bilinear", "bicubic")


def _sample(perspective, kernel="box", scale=4):
    """Return the problem of a scene with these perspective depths, (H, W)."""
    camera = CAMERA.crop(0, 0, *perspective.shape)
    depth = from_range(perspective[None], camera, "perspective")
    scene = Scene("set", "hall", torch.zeros(3, *perspective.shape), camera, depth)
    return make_sample(scene, scale, Downsampling(kernel), "perspective")


def _coarse(perspective, scale=4):
    height, width = perspective.shape
    return perspective.reshape(height // scale, scale, width // scale, scale).mean(axis=(1, 3))


def _random():
    return torch.from_numpy(np.random.default_rng(0).uniform(1.0, 3.0, (32, 48)))


def _result(sample, order="bicubic", *, fill_holes=False):
    """Return the fine perspective depth, (H, W)."""
    fine = Interpolation(order, fill_holes=fill_holes)(sample)
    assert fine.shape == (1, sample.camera.height, sample.camera.width)
    return to_range(fine, sample.camera, "perspective")[0].numpy()


@pytest.mark.parametrize("scale", SCALES)
def test_bicubic_equals_scipys_zoom_of_the_box_mean_of_perspective_depth(scale):
    perspective = _random()
    expected = ndimage.zoom(_coarse(perspective.numpy(), scale), scale, order=3, grid_mode=True, mode="nearest")
    np.testing.assert_allclose(_result(_sample(perspective, scale=scale)), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", SCALES)
def test_nearest_repeats_each_low_resolution_pixel(scale):
    perspective = _random()
    expected = np.kron(_coarse(perspective.numpy(), scale), np.ones((scale, scale)))
    np.testing.assert_allclose(_result(_sample(perspective, scale=scale), "nearest"), expected, rtol=1e-12)


def test_bilinear_weights_the_four_neighbours_by_distance():
    perspective = _random()
    coarse = np.pad(_coarse(perspective.numpy()), 1, mode="edge")
    v, u = (np.arange(size) / 4 - 0.375 + 1 for size in (32, 48))  # in the padded map
    i, j = v.astype(int), u.astype(int)
    a, b = (v - i)[:, None], (u - j)[None]
    upper = (1 - b) * coarse[np.ix_(i, j)] + b * coarse[np.ix_(i, j + 1)]
    lower = (1 - b) * coarse[np.ix_(i + 1, j)] + b * coarse[np.ix_(i + 1, j + 1)]
    np.testing.assert_allclose(_result(_sample(perspective), "bilinear"), (1 - a) * upper + a * lower, rtol=1e-12)


@pytest.mark.parametrize("kernel", ["box", "nearest"])
def test_low_and_high_resolution_pixels_are_matched_through_their_cameras(kernel):
    v, u = np.mgrid[:32, :48]
    perspective = torch.from_numpy(2 + 0.03 * u - 0.02 * v)
    fine = _result(_sample(perspective, kernel), "bilinear")
    inside = (slice(2, -2), slice(2, -2))  # between the outermost low-resolution pixel centres
    np.testing.assert_allclose(fine[inside], perspective.numpy()[inside], rtol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_inpainted_holes_have_the_values_of_their_nearest_pixels_and_change_no_others(order):
    perspective = _random()
    perspective[4:12, 8:16] = torch.nan  # 2 x 2 low-resolution pixels
    perspective[28:, :4] = torch.nan
    perspective[20, 20] = torch.nan  # one high-resolution pixel is no coarse hole
    sample = _sample(perspective)
    known = to_range(sample.depth_lr, sample.camera_lr, "perspective")[0]
    filled, kept = _result(sample, order, fill_holes=True), _result(sample, order)
    assert int(np.isnan(kept).sum()) == 80
    assert np.isfinite(filled).all()
    np.testing.assert_array_equal(filled[np.isfinite(kept)], kept[np.isfinite(kept)])
    if order == "nearest":  # each of the four has a known neighbour on two sides: either is nearest
        for i, j, sides in ((1, 2, ((0, 2), (1, 1))), (2, 2, ((3, 2), (2, 1))), (1, 3, ((0, 3), (1, 4)))):
            assert min(abs(filled[4 * i, 4 * j] - known[side].item()) for side in sides) < 1e-12


def test_overshoot_below_zero_becomes_a_hole():
    perspective = torch.full((32, 48), 60.0, dtype=torch.float64)
    perspective[:, :24] = 0.05
    fine = _result(_sample(perspective))
    assert 0 < np.isnan(fine).sum() < 32 * 12
    assert (fine[np.isfinite(fine)] > 0).all()


SMALL = Camera(48, 40, 50.0, 50.0, 22.0, 21.0, baseline=0.3, doffs=4.0)


def _cubic_convolution_sample(range_type, scale):
    depth = torch.from_numpy(1 + np.random.default_rng(0).random((1, 40, 48)))
    scene = Scene("set", "random", torch.zeros(3, 40, 48), SMALL, depth)
    return make_sample(scene, scale, Downsampling("bicubic"), range_type)


def _pillow(values, height, width):
    image = Image.fromarray(values[0].numpy().astype(np.float32))
    return np.array(image.resize((width, height), Image.Resampling.BICUBIC))


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("range_type", RANGE_TYPES)
def test_down_and_up_is_pillows_bicubic(range_type, scale):
    sample = _cubic_convolution_sample(range_type, scale)
    true = to_range(sample.depth, SMALL, range_type)
    small = _pillow(true, 40 // scale, 48 // scale)
    found = to_range(CubicConvolution(range_type)(sample), SMALL, range_type)[0].numpy()
    np.testing.assert_allclose(found, _pillow(torch.from_numpy(small)[None], 40, 48), rtol=2e-5)


def test_pixels_are_matched_through_the_cameras():
    camera = Camera(48, 40, 50.0, 50.0, 22.0, 21.0)
    slope = (2 + 0.01 * torch.arange(48, dtype=torch.float64)).repeat(1, 40, 1)
    scene = Scene("set", "slope", torch.zeros(3, 40, 48), camera, slope)
    found = CubicConvolution("orthogonal")(make_sample(scene, 4, Downsampling("nearest"), "orthogonal"))
    torch.testing.assert_close(found[..., 8:-8], slope[..., 8:-8])


def test_hole_stays_a_hole_and_does_not_spread():
    sample = _cubic_convolution_sample("orthogonal", 4)
    flat = torch.full_like(sample.depth_lr, 2.0)
    flat[0, 4, 5] = torch.nan
    found = CubicConvolution()(replace(sample, depth_lr=flat))
    holes = torch.zeros(1, 40, 48, dtype=torch.bool)
    holes[0, 16:20, 20:24] = True
    assert torch.equal(found.isnan(), holes)
    torch.testing.assert_close(found[~holes], torch.full((1920 - 16,), 2.0, dtype=torch.float64))


def test_map_of_the_photos_own_size_is_returned_and_any_ratio_is_taken():
    depth = torch.from_numpy(1 + np.random.default_rng(0).random((1, 40, 48)))
    sample = DepthSample("set", "random", torch.zeros(3, 40, 48), depth, SMALL, SMALL, 1)
    torch.testing.assert_close(CubicConvolution("orthogonal")(sample), depth)
    small = SMALL.rescale(18, 15)
    sample = DepthSample("set", "random", torch.zeros(3, 40, 48), depth[:, :15, :18], SMALL, small, 48 / 18)
    expected = _pillow(depth[:, :15, :18], 40, 48)
    np.testing.assert_allclose(CubicConvolution("orthogonal")(sample)[0].numpy(), expected, rtol=2e-5)
