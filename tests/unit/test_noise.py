"""Noise, against its laws: exact numbers where the draws are known, statistics of large maps where they are not.

The noise of cameras drawn at random has the stated amplitudes, lengths and bands.
"""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from small_scenes import seeded

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import NOISES, GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_fields import field_of, waves_of
from dsr.geometry.camera import RANGE_TYPES, Camera
from dsr.sample import Scene

CAMERA = Camera(8, 4, 10.0, 10.0, 3.5, 1.5, baseline=0.1, doffs=0.5)
STEPS = torch.arange(32, dtype=torch.float64).view(1, 4, 8) / 16 + 1
KINDS = (GaussianMultiplicative(0.02), TimeOfFlight(), Kinect())
SENSORS = KINDS[1:]
QUIET = {"std": 0.0, "dropout": 0.0}
BOX = Downsampling("box")


def _wall(depth, size=400):
    return torch.full((1, size, size), depth, dtype=torch.float64)


@pytest.mark.parametrize("method", RANGE_TYPES)
@pytest.mark.parametrize("noise", SENSORS)
def test_sensor_noise_applies_to_metric_depth_whatever_is_averaged(noise, method):
    scene = Scene("set", "hall", torch.zeros(3, 4, 8), CAMERA, STEPS)
    clean = make_sample(scene, 2, BOX, method).depth_lr
    noisy = make_sample(scene, 2, BOX, method, noise, seeded(5)).depth_lr
    torch.testing.assert_close(noisy, noise(clean, seeded(5)), rtol=1e-12, atol=0, equal_nan=True)


def test_disparity_noise_of_time_of_flight_is_normal_with_the_given_deviation():
    depth = 1 + 2 * torch.rand(1, 40, 50, generator=seeded(1), dtype=torch.float64)
    noise = TimeOfFlight(strength=300.0, stereo_constant=500.0, doffs=20.0)
    clean = 500 / depth - 20
    draws = torch.randn(depth.shape, generator=seeded(), dtype=torch.float64)
    torch.testing.assert_close(500 / noise(depth, seeded()) - 20, clean + 300 / clean * draws, rtol=1e-12, atol=0)


def test_non_positive_disparity_of_time_of_flight_is_a_hole():
    noisy = TimeOfFlight()(_wall(30.0, 100), seeded())
    draws = torch.randn(1, 100, 100, generator=seeded(), dtype=torch.float64)
    v = 598.4 / 30
    assert torch.equal(noisy.isnan(), v + 651 / v * draws <= 0)
    assert bool((noisy[noisy.isfinite()] > 0).all())
    assert bool(TimeOfFlight(doffs=200.0)(_wall(3.0, 10), seeded()).isnan().all())


@pytest.mark.parametrize("depth", [1.0, 2.0, 3.0, 5.0])
def test_kinect_noise_is_that_of_khoshelham_and_grows_with_the_square_of_depth(depth):
    span = 1 + 0.02 * torch.linspace(-1, 1, 400, dtype=torch.float64)  # several steps: one depth lies well or badly
    wall = _wall(depth) * span
    errors = (Kinect()(wall, seeded()) - wall) / wall**2
    assert float(errors.std()) == pytest.approx(1.425e-3, rel=0.02)
    assert float(errors.mean()) == pytest.approx(0, abs=2e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kinect_disparity_comes_in_eighths_of_the_sensors_pixels(dtype):
    depth = 0.5 + 7 * torch.rand(1, 60, 80, generator=seeded(1), dtype=torch.float64).to(dtype)
    reading = Kinect()(depth, seeded())
    eighths = (8 * 0.075 * 580 / reading[reading.isfinite()]).double()
    assert eighths.numel() > 1000
    torch.testing.assert_close(eighths, eighths.round(), rtol=0, atol=1e-9 if dtype == torch.float64 else 2e-4)


def test_kinect_without_noise_reads_the_nearest_step():
    noise = Kinect(**QUIET, step=0.5, stereo_constant=10.0, nearest=None, farthest=None)
    disparity = torch.tensor([[[9.8, 10.2, 10.3, 0.3, 0.2]]], dtype=torch.float64)
    expected = torch.tensor([[[1.0, 1.0, 10 / 10.5, 20.0, torch.nan]]], dtype=torch.float64)
    torch.testing.assert_close(noise(10 / disparity, seeded()), expected, rtol=1e-12, atol=0, equal_nan=True)


def _step():
    """Return a wall at 3 m with a box at 2 m before it, in rows 10 to 19 and columns 15 to 24."""
    depth = _wall(3.0, 40)
    depth[0, 10:20, 15:25] = 2.0
    return depth


@pytest.mark.parametrize("reach", [1, 2, 4])
def test_dropouts_lie_near_depth_edges_alone(reach):
    lost = Kinect(dropout=1.0, reach=reach)(_step(), seeded()).isnan()
    near, cross = (_step()[0] == 2).numpy(), ndimage.generate_binary_structure(2, 1)
    edge = (ndimage.binary_dilation(near, cross) & ~near) | (ndimage.binary_dilation(~near, cross) & near)
    expected = torch.from_numpy(ndimage.binary_dilation(edge, np.ones((2 * reach - 1, 2 * reach - 1))))[None]
    assert torch.equal(lost, expected)


def test_dropouts_have_their_probability_at_jumps_by_more_than_a_fraction_of_the_nearer_depth():
    depth = _wall(2.0, 300)
    depth[..., ::2] = 3.0
    for dropout in (0.2, 0.7):
        lost = Kinect(dropout=dropout)(depth, seeded()).isnan().double().mean()
        assert float(lost) == pytest.approx(dropout, abs=0.01)
    for jump, expected in ((0.49, True), (0.51, False)):
        assert bool(Kinect(dropout=1.0, jump=jump)(_step(), seeded()).isnan().any()) is expected


def test_hole_makes_no_edge():
    depth = _wall(2.0, 20)
    depth[0, 5:9, 5:9] = torch.nan
    assert torch.equal(Kinect(dropout=1.0)(depth, seeded()).isnan(), depth.isnan())


def test_readings_out_of_range_are_holes_unless_the_limits_are_off():
    depth = torch.tensor([[[0.2, 0.39, 0.41, 2.0, 7.8, 8.3, 20.0, 1e6, -1.0]]], dtype=torch.float64)
    quiet = Kinect(**QUIET)(depth, seeded())
    assert quiet.isnan()[0, 0].tolist() == [True, True, False, False, False, *4 * [True]]
    open_ended = Kinect(**QUIET, nearest=None, farthest=None)(depth, seeded())
    torch.testing.assert_close(open_ended[..., :7], depth[..., :7], rtol=0.03, atol=0)
    assert bool(open_ended[..., 7:].isnan().all())  # no disparity, and behind the sensor
    assert bool(TimeOfFlight()(depth, seeded())[0, 0, 8].isnan())


def _photo(like):
    """Return a photo with texture everywhere."""
    return torch.rand(like.shape, generator=seeded(1))


def _full_width(field):
    """Return the full width at half maximum of the autocorrelation of fields, (n, h, w), along rows and columns."""
    power, before = float(field.square().nanmean()), 1.0
    for lag in range(1, field.shape[-1] // 2):
        along = (field[..., lag:] * field[..., :-lag]).nanmean() + (field[:, lag:] * field[:, :-lag]).nanmean()
        now = float(along) / 2 / power
        if now < 0.5:
            return 2 * (lag - 1 + (before - 0.5) / (before - now))
        before = now
    return math.inf


@pytest.mark.parametrize("length", [1, 3, 20])
def test_waves_are_as_long_as_asked(length):
    waves = torch.cat([waves_of(torch.empty(1, 200, 200), length, seeded(seed)) for seed in range(10)])
    assert float(waves.std()) == pytest.approx(1, rel=0.1)
    assert _full_width(waves) == pytest.approx(length, rel=0.2)
    stretched = torch.cat([waves_of(torch.empty(1, 128, 128), 8, seeded(seed), 1.5) for seed in range(4)])
    columns, rows = (float((each[0] * each[1]).mean()) for each in (
        (stretched[:, 4:], stretched[:, :-4]), (stretched[..., 4:], stretched[..., :-4])))  # fmt: skip
    assert rows > columns + 0.2


@pytest.mark.parametrize("sigma", [1.0, 8.0])
def test_fields_are_alike_as_far_as_a_gaussian_makes_them(sigma):
    field = torch.cat([field_of(torch.empty(1, 250, 250), sigma, seeded(seed)) for seed in range(12)])
    lag = round(sigma)
    assert float(field.std()) == pytest.approx(1, rel=0.08)
    alike = float((field[..., lag:] * field[..., :-lag]).mean() / field.square().mean())
    assert alike == pytest.approx(math.exp(-((lag / sigma) ** 2) / 4), abs=0.06)


def test_stereo_loses_a_band_on_one_side():
    values = torch.full((1, 200, 200), 0.5)
    values[:, 60:140, 80:120] = 1  # a square at 1 m before a wall at 2 m
    lost = sum(NOISES["stereo"](values, _photo(values), seeded(seed)).isnan() for seed in range(20))
    left, right = (float(lost[0, 70:130, columns].float().mean()) for columns in (slice(70, 76), slice(124, 130)))
    assert left > 2.5 * right
    assert left > 4, "of 20"


def test_structured_light_is_as_noisy_as_measured_ones():
    """Nguyen et al. 2012: 1.2 mm + 1.9 mm (z - 0.4)^2, times 0.4 to 2.5, and steps of disparity."""

    def deviation(depth):
        values = torch.linspace(1, 1.1, 128).repeat(1, 128, 1) / depth  # a wall that turns away by 10 %
        errors = [NOISES["structured"](values, _photo(values), seeded(seed)) / values - 1 for seed in range(40)]
        return depth * float(torch.stack([each[each.isfinite()].std() for each in errors]).median())

    near, middle, far = (deviation(depth) for depth in (0.5, 1, 3))
    assert 0.0006 < middle < 0.006
    assert near / middle > 0.35, "0.65 by the formula; noise of disparity alone would give 0.25"
    assert 4 < far / middle < 11
