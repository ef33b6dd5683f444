"""Frames of a camera that stands still: noise is averaged away, changes are followed at once."""

import math

import pytest
import torch

from dsr.inference import Steady
from dsr.inference.steady import KEPT
from dsr.methods.base import Surface
from dsr.metrics.temporal import flicker

SIZE = (1, 40, 48)
PHOTO = torch.rand((3, 40, 48), generator=torch.Generator().manual_seed(9))
DEVIATION = 0.002  # Of inverse depth, 1/m


def surfaces(count, factor=1.0, depth=2.0, seed=0):
    """Yield surfaces with white noise of inverse depth, ``factor`` times as strong as is expected of it."""
    generator = torch.Generator().manual_seed(seed)
    expected = math.sqrt(2 / math.pi) * DEVIATION * depth**2  # The mean absolute error
    for _ in range(count):
        noise = factor * DEVIATION * torch.randn(SIZE, generator=generator)
        yield Surface((1 / depth + noise).reciprocal(), torch.full(SIZE, expected))


@pytest.mark.parametrize("alpha", [0.1, 0.4])
def test_noise_falls_to_the_exponential_means(alpha):
    steady = Steady(alpha)
    *_, last = (steady(each, PHOTO).depth for each in surfaces(60, factor=0.5))  # so that no noise seems a change
    expected = 0.5 * DEVIATION * math.sqrt(alpha / (2 - alpha))
    assert float((last.reciprocal() - 0.5).std()) == pytest.approx(expected, rel=0.05)


def test_flicker_falls_to_a_third_also_where_more_noise_occurs_than_is_expected():
    """Also at pixels that every other frame lacks."""
    frames = list(surfaces(40, factor=6.0))
    for each in frames[::2]:
        each.depth[:, :8] = torch.nan
    steady = Steady()
    averaged = [steady(each, PHOTO) for each in frames]
    before, after = (torch.stack([each.depth for each in some[10:]]) for some in (frames, averaged))
    assert float(flicker(after)) < float(flicker(before)) / 3
    assert torch.equal(after.isnan(), before.isnan())
    off = (after[-1] - 2).abs().nanmean()
    assert float(off) < float(averaged[-1].depth_error.mean()) < 12 * float(frames[-1].depth_error.mean())


def test_changed_depth_is_followed_at_once_and_leaves_nothing_behind():
    steady = Steady()
    for each in surfaces(20):
        steady(each, PHOTO)
    for number, each in enumerate(surfaces(10, seed=1)):  # a plate that moves by half its width
        moved = each.depth.clone()
        here = (slice(None), slice(10, 20), slice(4 * number, 4 * number + 8))
        moved[here] -= 0.3
        found = steady(each._replace(depth=moved), PHOTO).depth
        new = (slice(None), slice(10, 20), slice(4 * number + 4, 4 * number + 8))
        torch.testing.assert_close(found[new], moved[new])
        left = (slice(None), slice(10, 20), slice(0, 4 * number))
        assert number == 0 or float((found[left] - 2).abs().max()) < 0.05  # Noise, and no part of the object


def test_small_difference_is_followed_by_alpha_in_inverse_depth():
    steady, error = Steady(0.25), torch.full(SIZE, 0.02)
    steady(Surface(torch.full(SIZE, 2.0), error), PHOTO)
    found = [steady(Surface(torch.full(SIZE, 2.05), error), PHOTO).depth for _ in range(3)]
    for number, depth in enumerate(found, 1):
        expected = 1 / 2.05 + 0.75**number * (1 / 2.0 - 1 / 2.05)
        torch.testing.assert_close(depth, torch.full(SIZE, 1 / expected))


def test_pixels_begin_anew_where_the_photo_changes_and_nowhere_else():
    steady, error = Steady(), torch.full(SIZE, 0.02)
    steady(Surface(torch.full(SIZE, 2.0), error), PHOTO)
    other = PHOTO.clone()
    other[:, 20, 24] += 0.5
    found = steady(Surface(torch.full(SIZE, 2.01), error), other).depth
    anew = (found - 2.01).abs() < 1e-6
    expected = torch.zeros_like(anew)
    expected[:, 17:24, 21:28] = True  # the mean of 3 x 3 pixels, and two around it
    assert torch.equal(anew, expected)
    noisy = PHOTO + 0.02 * torch.randn(PHOTO.shape, generator=torch.Generator().manual_seed(0))
    steady = Steady()
    steady(Surface(torch.full(SIZE, 2.0), error), PHOTO)
    assert bool((steady(Surface(torch.full(SIZE, 2.01), error), noisy).depth < 2.005).all())


@pytest.mark.parametrize("holes", [KEPT - 1, KEPT])
def test_mean_outlasts_some_frames_of_holes(holes):
    steady, error = Steady(0.5), torch.full(SIZE, 0.1)
    steady(Surface(torch.full(SIZE, 2.0), error), PHOTO)
    for _ in range(holes):
        assert bool(steady(Surface(torch.full(SIZE, torch.nan), error), PHOTO).depth.isnan().all())
    found = steady(Surface(torch.full(SIZE, 2.1), error), PHOTO).depth
    expected = 2.1 if holes == KEPT else 2 / (1 / 2.0 + 1 / 2.1)
    torch.testing.assert_close(found, torch.full(SIZE, expected))


def test_last_results_are_all_that_the_next_one_depends_on():
    frames = list(surfaces(30, factor=3.0))
    for number, each in enumerate(frames):
        each.depth[:, number % 7 :: 7, : 3 * number] = torch.nan
    steady, again = Steady(), Steady()
    results = [steady(each, PHOTO) for each in frames[:-1]]
    for each in results[-KEPT:]:
        again.remember(each, PHOTO)
    for one, other in zip(steady(frames[-1], PHOTO)[:2], again(frames[-1], PHOTO)[:2], strict=True):
        assert torch.equal(one.nan_to_num(0), other.nan_to_num(0))


def test_other_sizes_begin_anew_and_bad_values_are_refused():
    steady = Steady()
    steady(next(surfaces(1)), PHOTO)
    small = Surface(torch.full((1, 4, 5), 3.0), torch.full((1, 4, 5), 9.0))
    assert bool((steady(small, torch.zeros(3, 4, 5)).depth == 3).all())
    with pytest.raises(ValueError, match="surface: expected one with expected errors"):
        steady(Surface(torch.full(SIZE, 2.0)), PHOTO)
    with pytest.raises(ValueError, match="alpha: expected a number above 0 and at most 1, got 0"):
        Steady(0)
