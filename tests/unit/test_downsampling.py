"""Downsampling models, against numpy, Pillow and weights written out in the test; samples, against closed forms."""

import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image

from dsr.degradation.downsampling import Downsampling, Kernel, Measured, make_sample
from dsr.degradation.noise import GaussianMultiplicative
from dsr.geometry.camera import RANGE_TYPES, Camera, to_range
from dsr.sample import Scene
from dsr.utils.ratios import SCALES

KERNELS = get_args(Kernel)
ASKED_AND_METHOD = [*((None, method) for method in RANGE_TYPES), ("perspective", "disparity")]
CENTRED = tuple(kernel for kernel in KERNELS if kernel != "nearest")
CAMERA = Camera(width=48, height=32, fx=60.0, fy=55.0, cx=21.3, cy=17.9)
BOX = Downsampling("box")
STEREO = Camera(width=48, height=32, fx=60.0, fy=55.0, cx=21.3, cy=17.9, baseline=0.12, doffs=1.7)


def _values(height, width, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(1.0, 3.0, (1, height, width)))


def _scene(depth, camera=CAMERA, measured=None):
    rgb = torch.linspace(0, 1, 3 * camera.height * camera.width).view(3, camera.height, camera.width)
    return Scene("set", "hall", rgb, camera, depth, measured or {})


def _profile(kernel, x, sigma=0.5):
    """Return the weight at a distance of x low-resolution pixels: textbook formulas, one number at a time."""
    x = abs(x)
    if kernel == "box":
        return float(x < 0.5)
    if kernel == "bilinear":
        return max(0.0, 1 - x)
    if kernel == "gaussian":
        return math.exp(-(x**2) / (2 * sigma**2)) if x <= 3 * sigma else 0.0
    if x < 1:  # Keys with a = -1/2
        return 1.5 * x**3 - 2.5 * x**2 + 1
    return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2 if x < 2 else 0.0


def _slow(values, kernel, scale, sigma=0.5):
    """Downsample one (H, W) map with holes, weight by weight, as the docstring of Downsampling says."""
    height, width = values.shape
    known = np.isfinite(values)
    coarse = np.full((height // scale, width // scale), np.nan)
    for i, j in np.ndindex(*coarse.shape):
        block = values[i * scale : (i + 1) * scale, j * scale : (j + 1) * scale]
        if np.isnan(block).all():
            continue
        rows = np.array([_profile(kernel, (v - (i + 0.5) * scale + 0.5) / scale, sigma) for v in range(height)])
        columns = np.array([_profile(kernel, (u - (j + 0.5) * scale + 0.5) / scale, sigma) for u in range(width)])
        weights = np.outer(rows / rows.sum(), columns / columns.sum())
        share = weights[known].sum()
        coarse[i, j] = (weights[known] @ values[known]) / share if share >= 0.5 else np.nanmean(block)
    return coarse


@pytest.mark.parametrize("scale", SCALES)
def test_box_is_the_mean_of_the_block_and_nearest_the_pixel_at_its_half_with_its_hole(scale):
    values = _values(32, 48)
    expected = values.numpy().reshape(1, 32 // scale, scale, 48 // scale, scale).mean(axis=(2, 4))
    np.testing.assert_allclose(BOX(values, scale).numpy(), expected, rtol=1e-13)
    values[0, scale // 2, scale // 2] = torch.nan
    coarse = Downsampling("nearest")(values, scale).numpy()
    np.testing.assert_array_equal(coarse, values.numpy()[:, scale // 2 :: scale, scale // 2 :: scale])
    assert np.isnan(coarse[0, 0, 0])
    assert bool(Downsampling("gaussian", sigma=0.1)(torch.ones(1, 32, 32), scale).isfinite().all())


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(
    ("kernel", "filter_"), [("bilinear", Image.Resampling.BILINEAR), ("bicubic", Image.Resampling.BICUBIC)]
)
def test_bilinear_and_bicubic_equal_pillow(kernel, filter_, scale):
    values = _values(32, 48)
    image = Image.fromarray(values[0].numpy().astype(np.float32))
    expected = np.asarray(image.resize((48 // scale, 32 // scale), filter_))
    np.testing.assert_allclose(Downsampling(kernel)(values, scale)[0].numpy(), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.7])
def test_gaussian_equals_its_formula(sigma):
    values = _values(12, 20)
    expected = _slow(values[0].numpy(), "gaussian", 4, sigma)
    np.testing.assert_allclose(Downsampling("gaussian", sigma)(values, 4)[0].numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("kernel", CENTRED)
@pytest.mark.parametrize("fraction", [0.05, 0.8])
def test_holes_are_left_out_of_the_average(kernel, fraction):
    values = _values(12, 20)
    values[torch.from_numpy(np.random.default_rng(1).random((1, 12, 20)) < fraction)] = torch.nan
    values[0, :4, 4:8] = torch.nan  # a block without a known pixel
    coarse = Downsampling(kernel)(values, 4)[0].numpy()
    assert np.isnan(coarse[0, 1])
    np.testing.assert_allclose(coarse, _slow(values[0].numpy(), kernel, 4), rtol=1e-12)


def test_size_that_the_scale_does_not_divide_is_refused():
    with pytest.raises(ValueError, match="downsampling: expected"):
        BOX(_values(8, 10), 4)


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
@pytest.mark.parametrize("kernel", KERNELS)
def test_low_resolution_camera_has_the_points_of_a_tilted_plane(kernel, camera):
    normal = torch.tensor([0.3, -0.4, -1.0], dtype=torch.float64)[:, None, None]
    tilted = -2.0 / (normal * camera.rays()).sum(dim=0, keepdim=True)  # its disparity is linear in u and v
    narrow = kernel in ("box", "nearest")
    inside = (slice(None), slice(None)) if narrow else (slice(2, -2), slice(2, -2))
    for scale in SCALES if narrow else (2, 4):
        sample = make_sample(_scene(tilted, camera), scale, Downsampling(kernel), "disparity")
        offset = (normal * sample.depth_lr * sample.camera_lr.rays()).sum(dim=0)
        torch.testing.assert_close(offset[inside], torch.full_like(offset[inside], -2.0), rtol=1e-12, atol=0)


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
@pytest.mark.parametrize(("asked", "method"), ASKED_AND_METHOD)
def test_average_is_taken_in_the_range_type(camera, asked, method):
    depth = _values(32, 48)
    sample = make_sample(_scene(depth, camera), 4, Downsampling("box", range_type=asked), method)
    z = depth.numpy()[0]
    v, u = np.mgrid[:32, :48]
    lengths = np.sqrt(((u - 21.3) / 60) ** 2 + ((v - 17.9) / 55) ** 2 + 1)
    i, j = np.mgrid[:8, :12]
    coarse_lengths = np.sqrt(((4 * j + 1.5 - 21.3) / 60) ** 2 + ((4 * i + 1.5 - 17.9) / 55) ** 2 + 1)

    def mean(x):
        return x.reshape(8, 4, 12, 4).mean(axis=(1, 3))

    expected = {
        "orthogonal": mean(z),
        "perspective": mean(z * lengths) / coarse_lengths,
        "disparity": 1 / mean(1 / z),
    }[asked or method]
    np.testing.assert_allclose(sample.depth_lr[0].numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
def test_sample_has_the_scenes_data_cropped_with_a_note_to_a_size_that_the_scale_divides(kernel):
    scene = replace(_scene(_values(35, 50), replace(CAMERA, width=50, height=35)), notes=("not metric",))
    sample = make_sample(scene, 4, Downsampling(kernel), "perspective")
    assert (sample.dataset, sample.scene, sample.scale) == ("set", "hall", 4)
    assert sample.notes == ("not metric", "cropped from 35 x 50 to 32 x 48, which 4 divides")
    assert sample.camera == CAMERA
    assert torch.equal(sample.rgb, scene.rgb[:, :32, :48])
    assert torch.equal(sample.depth, scene.depth[:, :32, :48])
    whole = make_sample(_scene(scene.depth[:, :32, :48]), 4, Downsampling(kernel), "perspective")
    torch.testing.assert_close(sample.depth_lr, whole.depth_lr, rtol=0, atol=0)
    assert (whole.camera_lr, whole.notes) == (sample.camera_lr, ())


@pytest.mark.parametrize("range_type", RANGE_TYPES)
def test_bicubic_undershoot_below_zero_is_a_hole(range_type):
    depth = torch.full((1, 32, 48), 40.0, dtype=torch.float64)
    depth[..., :22] = 0.1
    sample = make_sample(_scene(depth), 4, Downsampling("bicubic"), range_type)
    assert 0 < int((~sample.mask_lr).sum()) <= 16
    assert bool((sample.depth_lr[sample.mask_lr] > 0).all())


@pytest.mark.parametrize(("size", "scale", "ratio"), [((8, 12), 4, 4), ((32, 48), "native", 1)])
def test_measured_map_is_used_unchanged(size, scale, ratio):
    measured = _values(*size)
    measured[0, 1, 1] = torch.nan
    noise = GaussianMultiplicative(0.1)  # a measured map has its own
    sample = make_sample(_scene(None, measured={ratio: measured}), scale, Measured(), "disparity", noise)
    assert sample.depth_lr is measured
    assert sample.depth is None
    assert (sample.camera_lr, sample.scale) == (CAMERA.rescale(size[1], size[0]), ratio)


@pytest.mark.parametrize("scale", [2.6667, 2.65, "native"])
def test_measured_map_at_any_ratio_covers_the_whole_photo(scale):
    camera = Camera(width=16, height=11, fx=9.0, fy=9.0, cx=7.5, cy=5.0)
    sample = make_sample(_scene(None, camera, {16 / 6: _values(4, 6)}), scale, Measured(), "disparity")
    assert (sample.camera, sample.camera_lr, sample.scale) == (camera, camera.rescale(6, 4), 16 / 6)
    assert sample.notes == ()


SMALL = Camera(48, 7, 60.0, 55.0, 21.3, 3.0)
ANY_RATIO = _scene(None, Camera(16, 11, 9.0, 9.0, 7.5, 5.0), {16 / 6: _values(4, 6)})
TWO_MAPS = _scene(None, measured={1: _values(32, 48), 4: _values(8, 12)})


@pytest.mark.parametrize(
    ("scene", "scale", "downsampling", "range_type", "message"),
    [
        *((_scene(_values(32, 48)), scale, BOX, "disparity", "scale: expected") for scale in (0, 1, 3, 32, "native")),
        (_scene(_values(7, 48), SMALL), 8, BOX, "disparity", "hall: expected at least 8 x 8"),
        (_scene(_values(32, 48)), 4, BOX, "inverse", "range_type: "),
        (_scene(None, measured={4: _values(8, 12)}), 4, BOX, "disparity", "hall: expected a high-resolution"),
        (_scene(None, measured={4: _values(8, 12)}), 8, Measured(), "disparity", "hall: .* at x8, the scene has x4"),
        (_scene(_values(32, 48)), 4, Measured(), "disparity", "hall: .* at x4, the scene has none"),
        (TWO_MAPS, "native", Measured(), "disparity", "hall: .*scale=native expects .*the scene has x1, x4"),
        (_scene(_values(32, 48)), "native", Measured(), "disparity", "hall: .*scale=native expects .*there is none"),
        *((ANY_RATIO, scale, Measured(), "disparity", "hall: .* at x.*x2.667") for scale in (0, 2.63, 2.7, math.nan)),
    ],
)
def test_sample_that_cannot_be_made_is_refused(scene, scale, downsampling, range_type, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        make_sample(scene, scale, downsampling, range_type)


def test_measured_map_of_an_indivisible_size_is_that_of_the_cropped_photo():
    camera = Camera(width=23, height=21, fx=30.0, fy=30.0, cx=11.0, cy=10.0)
    measured = torch.full((1, 5, 5), 2.0, dtype=torch.float64)
    scene = Scene("test", "odd", torch.rand(3, 21, 23), camera, measured={4: measured})
    sample = make_sample(scene, 4, Measured(), "disparity")
    assert tuple(sample.rgb.shape) == (3, 20, 20)
    assert sample.camera == camera.crop(0, 0, 20, 20)
    assert sample.camera_lr == camera.crop(0, 0, 20, 20).rescale(5, 5)
    assert sample.notes == ("cropped from 21 x 23 to 20 x 20, which 4 divides",)


def _wall(name="hall", dataset="set"):
    depth = torch.full((1, 320, 480), 2.0, dtype=torch.float64)
    return Scene(dataset, name, torch.rand(3, 320, 480), Camera(480, 320, 60.0, 55.0, 240.0, 160.0), depth)


@pytest.mark.parametrize("camera", [CAMERA, STEREO])
@pytest.mark.parametrize(("asked", "method"), ASKED_AND_METHOD)
def test_noise_is_one_plus_std_times_the_draws_in_the_averaged_range_type(camera, asked, method):
    noisy, clean = (
        make_sample(_scene(_values(32, 48), camera), 4, Downsampling("box", range_type=asked), method, noise, generator)
        for noise, generator in ((GaussianMultiplicative(0.03), torch.Generator().manual_seed(3)), (None, 0))
    )
    one, other = (to_range(each.depth_lr, each.camera_lr, asked or method) for each in (noisy, clean))
    draws = torch.randn(1, 8, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    torch.testing.assert_close(one, other * (1 + 0.03 * draws), rtol=1e-10, atol=1e-10)


def test_noise_is_a_function_of_seed_scene_names_and_scale_or_goes_on_with_a_generator():
    def coarse(scene, seed=0, scale=4):
        noise = GaussianMultiplicative(0.01)
        return make_sample(scene, scale, BOX, "disparity", noise, seed).depth_lr.flatten()[:300]

    first = coarse(_wall())
    assert torch.equal(first, coarse(_wall()))
    others = coarse(_wall("attic")), coarse(_wall(dataset="b")), coarse(_wall(), 1), coarse(_wall(), 0, 8)
    generator = torch.Generator().manual_seed(5)
    own, next_one = coarse(_wall(), generator), coarse(_wall(), generator)
    assert torch.equal(own, coarse(_wall(), torch.Generator().manual_seed(5)))
    for one, other in (*((first, each) for each in others), (own, next_one)):
        assert abs(float(torch.corrcoef(torch.stack((one, other)))[0, 1])) < 0.25
