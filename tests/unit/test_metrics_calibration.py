"""Expected errors against measured ones: closed forms of known distributions, numpy, and planes of known normals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.metrics.calibration import error_ratios, measured_errors, squared_error_share

CAMERA = Camera(width=24, height=20, fx=30.0, fy=29.0, cx=11.0, cy=10.5)


def _laplace(seed: int, count: int = 400_000) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the scales of Laplace distributions, uniform in (0, 1), and the sizes of one error of each."""
    random = np.random.default_rng(seed)
    scales = random.uniform(0, 1, count)
    return torch.from_numpy(scales), torch.from_numpy(np.abs(random.laplace(0, scales)))


def _plane(normal: tuple[float, float, float], distance: float) -> torch.Tensor:
    """Return the depth of the plane n . P = d, (1, 1, H, W)."""
    direction = torch.tensor(normal, dtype=torch.float64)
    return distance / torch.einsum("c,chw->hw", direction, CAMERA.rays())[None, None]


@pytest.mark.parametrize("factor", [1.0, 0.5, 3.0])
def test_ratios_of_laplace_errors_of_known_scale_are_one_over_what_scales_them(factor: float) -> None:
    scales, errors = _laplace(0)
    found = error_ratios(factor * scales, errors)
    np.testing.assert_allclose(found.numpy(), 1 / factor, rtol=0.025)  # 5 standard deviations of 40,000 pixels


def test_ratios_of_errors_that_do_not_depend_on_the_expected_ones_fall_as_these_rise() -> None:
    expected = torch.linspace(0, 1, 100_001, dtype=torch.float64)[1:]
    measured = torch.full_like(expected, 0.5)
    middles = np.arange(10) / 10 + 0.05
    np.testing.assert_allclose(error_ratios(expected, measured).numpy(), 0.5 / middles, rtol=1e-3)


@pytest.mark.parametrize("lowest", [0.0, -0.5])
def test_values_of_half_precision_are_ordered_as_others_and_equal_ones_as_they_come(lowest: float) -> None:
    random = np.random.default_rng(2)
    expected = torch.from_numpy(random.uniform(lowest, 2, 20_000).astype(np.float16).astype(float))
    expected[:50], expected[50:70] = 0.0, -0.0
    measured = torch.from_numpy(random.uniform(0, 1, 20_000))
    assert len(expected.unique()) < 10_000
    order = np.argsort(expected.numpy(), kind="stable")
    parts = zip(*(np.array_split(each.numpy()[order], 10) for each in (expected, measured)), strict=True)
    ratios = [theirs.mean() / own.mean() for own, theirs in parts]
    np.testing.assert_allclose(error_ratios(expected, measured).numpy(), ratios, rtol=1e-12)


def test_ratios_and_share_are_those_of_numpy_over_pixels_that_have_both_errors() -> None:
    random = np.random.default_rng(1)
    expected, measured = random.uniform(0, 2, (2, 3, 1, 17, 23)).astype(np.float32)
    expected[random.random(expected.shape) < 0.1] = np.nan
    measured[random.random(measured.shape) < 0.1] = np.nan
    both = np.isfinite(expected) & np.isfinite(measured)
    first, second = expected[both].astype(float), measured[both].astype(float)
    order = np.argsort(first)
    ratios = [second[part].mean() / first[part].mean() for part in np.array_split(order, 7)]
    given = torch.from_numpy(expected), torch.from_numpy(measured)
    np.testing.assert_allclose(error_ratios(*given, parts=7).numpy(), ratios)
    kept = (second[order[: round(0.6 * len(order))]] ** 2).sum() / (second**2).sum()
    assert float(squared_error_share(*given, kept=0.6)) == pytest.approx(kept)


def test_share_of_laplace_errors_of_known_scale_is_that_of_the_integral() -> None:
    scales, errors = _laplace(2)
    assert float(squared_error_share(scales, errors)) == pytest.approx(0.8**3, abs=0.01)


def test_share_of_uniform_errors_is_the_cube_when_they_are_known_and_the_fraction_when_they_are_not() -> None:
    random = np.random.default_rng(3)
    measured, unrelated = (torch.from_numpy(random.uniform(0, 1, 200_000)) for _ in range(2))
    assert float(squared_error_share(measured, measured)) == pytest.approx(0.8**3, abs=0.005)
    assert float(squared_error_share(unrelated, measured)) == pytest.approx(0.8, abs=0.005)
    assert float(squared_error_share(measured, measured, kept=1)) == 1


def test_parts_without_pixels_and_errors_of_zero_have_no_value() -> None:
    found = error_ratios(torch.tensor([1.0, 2.0, math.nan]), torch.tensor([3.0, 4.0, 5.0]), parts=3)
    np.testing.assert_allclose(found.numpy(), [3, 2, math.nan])
    assert error_ratios(torch.zeros(4), torch.ones(4), parts=1).tolist() == [math.inf]
    assert math.isnan(squared_error_share(torch.ones(4), torch.zeros(4)))
    assert math.isnan(squared_error_share(torch.empty(0), torch.empty(0)))


def test_errors_of_different_pixels_are_refused() -> None:
    with pytest.raises(ValueError, match=r"same pixels, got shapes \(4,\) and \(1,\)"):
        error_ratios(torch.ones(4), torch.ones(1))


def test_measured_errors_of_planes_are_their_distance_and_the_angle_between_them() -> None:
    tilt = math.radians(25)
    first, second = _plane((0, 0, 1), 2.0), _plane((math.sin(tilt), 0, math.cos(tilt)), 2.1)
    depth, angle = measured_errors(first, second, CAMERA.rays()[None])
    np.testing.assert_allclose(depth.numpy(), np.abs(first.numpy() - second.numpy()))
    np.testing.assert_allclose(angle.numpy(), 25, rtol=1e-9)
    np.testing.assert_allclose(measured_errors(second, second, CAMERA.rays()[None])[1].numpy(), 0, atol=1e-9)


def test_measured_errors_are_unknown_in_holes_of_either_map_and_those_of_normals_beside_them() -> None:
    first, second = _plane((0, 0, 1), 2.0), _plane((0, 0, 1), 2.1)
    first[..., 5, 6] = torch.nan
    second[..., 9, 3] = torch.nan
    depth, angle = measured_errors(first, second, CAMERA.rays()[None])
    holes = {(5, 6), (9, 3)}
    beside = {(v + dv, u + du) for v, u in holes for dv, du in ((0, 0), (-1, 0), (0, -1))}
    assert {tuple(place) for place in np.argwhere(depth[0, 0].isnan().numpy())} == holes
    assert {tuple(place) for place in np.argwhere(angle[0, 0].isnan().numpy())} == beside
