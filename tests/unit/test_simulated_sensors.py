"""Simulated sensors: amplitudes, lengths, steps, bands and edges as stated, and nothing where nothing is known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsr.degradation.holes import Shadows, occluded
from dsr.degradation.noise import NOISES
from dsr.degradation.random_degradation import Everything
from dsr.degradation.random_fields import field_of, waves_of
from dsr.geometry.camera import Camera
from dsr.sample import Scene

SENSORS = ("structured", "flight", "lidar", "stereo")


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _wall(depth: float, size: int = 256) -> Tensor:
    """Return inverse depth of a wall that turns away by 10 %."""
    return torch.linspace(1, 1.1, size).repeat(1, size, 1) / depth


def _photo(like: Tensor) -> Tensor:
    """Return a photo with texture everywhere."""
    return torch.rand(like.shape, generator=_generator(1))


def _square(size: int = 200) -> Tensor:
    """Return inverse depth of a square at 1 m, columns 80 to 119, before a wall at 2 m."""
    values = torch.full((1, size, size), 0.5)
    values[:, 60:140, 80:120] = 1
    return values


def _errors(kind: str, values: Tensor, draws: int) -> list[Tensor]:
    """Return relative errors of inverse depth."""
    return [NOISES[kind](values, _photo(values), _generator(seed)) / values - 1 for seed in range(draws)]


def _full_width(field: Tensor) -> float:
    """Return the full width at half maximum of the autocorrelation of fields, (n, h, w), along rows and columns."""
    power, before = float(field.square().nanmean()), 1.0
    for lag in range(1, field.shape[-1] // 2):
        along = (field[..., lag:] * field[..., :-lag]).nanmean() + (field[:, lag:] * field[:, :-lag]).nanmean()
        now = float(along) / 2 / power
        if now < 0.5:
            return 2 * (lag - 1 + (before - 0.5) / (before - now))
        before = now
    return math.inf


@pytest.mark.parametrize("length", [1, 3, 8, 20, 40])
def test_waves_are_as_long_as_asked(length: float) -> None:
    waves = torch.cat([waves_of(torch.empty(1, 256, 256), length, _generator(seed)) for seed in range(12)])
    assert float(waves.std()) == pytest.approx(1, rel=0.1)
    assert _full_width(waves) == pytest.approx(length, rel=0.2)
    stretched = torch.cat([waves_of(torch.empty(1, 256, 256), 8, _generator(seed), 1.5) for seed in range(4)])
    columns, rows = (float((each[0] * each[1]).mean()) for each in (
        (stretched[:, 4:], stretched[:, :-4]), (stretched[..., 4:], stretched[..., :-4])))  # fmt: skip
    assert rows > columns + 0.2


@pytest.mark.parametrize("sigma", [1.0, 4.0, 12.0])
def test_fields_are_alike_as_far_as_a_gaussian_makes_them(sigma: float) -> None:
    field = torch.cat([field_of(torch.empty(1, 250, 250), sigma, _generator(seed)) for seed in range(12)])
    lag = round(sigma)
    assert float(field.std()) == pytest.approx(1, rel=0.08)
    alike = float((field[..., lag:] * field[..., :-lag]).mean() / field.square().mean())
    assert alike == pytest.approx(math.exp(-((lag / sigma) ** 2) / 4), abs=0.06)


def test_plain_waves_are_weak_and_lie_on_the_map() -> None:
    for error in _errors("waves", _wall(2), 12):
        assert 0.001 < float(error.std()) < 0.012
        assert 1.5 < _full_width(error - error.mean()) < 35
    assert Everything().noises["waves"] == 0


@pytest.mark.parametrize("kind", sorted(NOISES))
@pytest.mark.parametrize("size", [(17, 24), (96, 96)])
def test_noise_is_drawn_from_its_generator_alone_as_float32(kind: str, size: tuple[int, int]) -> None:
    values = _wall(1.5)[:, : size[0], : size[1]]
    for seed in range(6):
        first, again, other = (NOISES[kind](values, _photo(values), _generator(number)) for number in (seed, seed, 99))
        assert first.dtype == torch.float32
        assert first.shape == values.shape
        torch.testing.assert_close(first, again, rtol=0, atol=0, equal_nan=True)
        assert not torch.equal(first.nan_to_num(0), other.nan_to_num(0))
        if kind not in ("structured", "flight", "stereo"):
            assert bool(first.isfinite().all())


@pytest.mark.parametrize("kind", sorted(NOISES))
def test_what_is_not_known_stays_unknown(kind: str) -> None:
    depth = _square(128).double().reciprocal()
    depth[:, 50:90, 30:70] = torch.nan
    scene = Scene(
        "test", "square", torch.rand((3, 128, 128), generator=_generator()), Camera.from_fov(60, 128, 128), depth
    )
    everything = Everything(
        noises={kind: 1}, holes={"none": 1}, displaced=0, rounded=0.5, folds=0, relief=0, kernels={"nearest": 1}
    )
    for seed in range(10):
        sample, _ = everything(scene, 1, _generator(seed))
        assert bool(sample.depth_lr[depth.isnan()].isnan().all())
        assert float(sample.depth_lr.isfinite().float().mean()) > 0.2


def test_the_occluded_band_is_as_wide_as_the_disparities_differ() -> None:
    values, constant = _square(), 24.5
    expected = torch.zeros(values.shape, dtype=torch.bool)
    expected[:, 60:140, 80 - 12 : 80] = True  # 24.5 (1/1 - 1/2) but for a part of a pixel, on the left
    assert torch.equal(occluded(constant * values), expected)
    assert torch.equal(occluded(-constant * values).flip(-1), occluded(constant * values.flip(-1)))
    camera = Camera.from_fov(60, 200, 200)
    assert torch.equal(Shadows(constant / camera.fx)(values.reciprocal().double(), camera, _generator()), expected)


def test_stereo_loses_a_band_on_one_side() -> None:
    values = _square()
    lost = sum(NOISES["stereo"](values, _photo(values), _generator(seed)).isnan() for seed in range(40))
    assert isinstance(lost, Tensor)
    left, right = (float(lost[0, 70:130, columns].float().mean()) for columns in (slice(70, 76), slice(124, 130)))
    assert left > 2.5 * right
    assert left > 8, "of 40"


def test_stereo_repeats_values_has_waves_of_all_lengths_and_few_pixels_are_far_off() -> None:
    lengths, repeated = [], 0
    for error in _errors("stereo", _wall(1.5, 320), 30):
        known = error.isfinite()
        assert float(known.float().mean()) > 0.4
        assert 2e-4 < float(error[known].std()) < 0.03
        lengths.append(_full_width(error - error.nanmean()))
        values = (1 + error) * _wall(1.5, 320)
        repeated += float((values[..., 1:] == values[..., :-1]).float().mean()) > 0.3
    assert min(lengths) < 6
    assert max(lengths) > 25
    assert sum(5 < length < 45 for length in lengths) > 15
    assert 10 < repeated < 28


def test_structured_light_is_as_noisy_as_measured_ones() -> None:
    """Nguyen et al. 2012: 1.2 mm + 1.9 mm (z - 0.4)^2, times 0.4 to 2.5, and steps of disparity."""

    def deviation(depth: float) -> float:
        errors = torch.stack([error[error.isfinite()].std() for error in _errors("structured", _wall(depth), 80)])
        return depth * float(errors.median())

    near, middle, far = (deviation(depth) for depth in (0.5, 1, 3))
    assert 0.0006 < middle < 0.006
    assert near / middle > 0.35, "0.65 by the formula; noise of disparity alone would give 0.25"
    assert 4 < far / middle < 11


def test_lidar_smears_steps_and_is_biased_by_distance() -> None:
    """A seventh of a jump between neighbours at the softest; bias of up to 3 % near the sensor, less far away."""
    shares = []
    for seed in range(30):
        values = NOISES["lidar"](_square(), _photo(_square()), _generator(seed))
        row = values[0, 70:130].median(dim=0).values
        shares.append([float((row[n:100] - row[: 100 - n]).max() / 0.5) for n in (1, 3)])
    one, three = torch.tensor(shares).T
    assert float(one.min()) < 0.25
    assert 0.2 < float(one.median()) < 0.7
    assert 0.45 < float(three.median()) < 1.05
    bias = [torch.stack([error.mean().abs() for error in _errors("lidar", _wall(depth), 30)]) for depth in (0.35, 3)]
    assert 0.015 < float(bias[0].max()) < 0.035
    assert 2 < float(bias[0].max() / bias[1].max()) < 8


def test_time_of_flight_mixes_depth_on_both_sides_of_steps() -> None:
    sides = torch.zeros(2)
    for seed in range(30):
        depth = NOISES["flight"](_square(), _photo(_square()), _generator(seed)).reciprocal()
        between = ((depth > 1.05) & (depth < 1.95))[0, 70:130]
        sides += torch.stack((between[:, 76:80].float().mean(), between[:, 80:84].float().mean()))
    assert bool((sides > 2).all())


def test_time_of_flight_sees_dark_surfaces_too_far_and_rounds_inner_corners() -> None:
    depth = 2 - 0.004 * (torch.arange(200.0) - 100).abs().repeat(1, 200, 1)  # the farthest in the middle
    luma = torch.full(depth.shape, 0.7)
    luma[:, 100:] = 0.02
    dark, corner = [], []
    for seed in range(60):
        error = NOISES["flight"](depth.reciprocal(), luma, _generator(seed)).reciprocal() - depth
        profile, bright = error.nanmean(dim=-2)[0], error[:, :100].nanmean(dim=-2)[0]
        dark.append(float(error[:, 100:].nanmean() - error[:, :100].nanmean()))
        corner.append(float(bright[98:103].mean() - (bright[60:75].mean() + bright[125:140].mean()) / 2))
        assert bool(profile.isfinite().any())
    farther = torch.tensor(dark).nan_to_num(0)
    assert 10 < int((farther > 1e-3).sum()) < 50
    assert float(torch.tensor(corner).mean()) < -2e-4
