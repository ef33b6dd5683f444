"""Frames of a camera that stands still: noise is averaged away, changes are followed at once."""

import math

import numpy as np
import pytest
import torch
from small_scenes import seeded

from dsr.inference import Steady
from dsr.inference.steady import KEPT
from dsr.methods.base import Surface
from dsr.metrics.temporal import flicker

SIZE = (1, 40, 48)
PHOTO = torch.rand((3, 40, 48), generator=seeded(9))
DEVIATION = 0.002  # Of inverse depth, 1/m


def flat(depth, error=0.02):
    return Surface(torch.full(SIZE, depth), torch.full(SIZE, error))


def begun(alpha=0.1, error=0.02):
    """Return what has seen a surface at 2 m."""
    steady = Steady(alpha)
    steady(flat(2.0, error), PHOTO)
    return steady


def surfaces(count, factor=1.0, seed=0):
    """Return surfaces at 2 m with white noise of inverse depth, ``factor`` times as strong as is expected of it."""
    inverse = 0.5 + factor * DEVIATION * torch.randn((count, *SIZE), generator=seeded(seed))
    expected = math.sqrt(2 / math.pi) * DEVIATION * 4  # The mean absolute error
    return [Surface(each.reciprocal(), torch.full(SIZE, expected)) for each in inverse]


def test_flicker_falls_to_a_third_also_where_more_noise_occurs_than_is_expected():
    """Also at pixels that every other frame lacks."""
    frames = surfaces(40, factor=6.0)
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
        place = 4 * number
        each.depth[:, 10:20, place : place + 8] -= 0.3
        found = steady(each, PHOTO).depth
        new = np.s_[:, 10:20, place + 4 : place + 8]
        torch.testing.assert_close(found[new], each.depth[new])
        assert ((found[:, 10:20, :place] - 2).abs() < 0.05).all()  # Noise, and no part of the object


def test_small_difference_is_followed_by_alpha_in_inverse_depth():
    steady = begun(0.25)
    for number in (1, 2, 3):
        expected = 1 / 2.05 + 0.75**number * (1 / 2.0 - 1 / 2.05)
        torch.testing.assert_close(steady(flat(2.05), PHOTO).depth, flat(1 / expected).depth)


def test_pixels_begin_anew_where_the_photo_changes_and_nowhere_else():
    other = PHOTO.clone()
    other[:, 20, 24] += 0.5
    anew = begun()(flat(2.01), other).depth > 2.0099
    expected = torch.zeros_like(anew)
    expected[:, 17:24, 21:28] = True  # the mean of 3 x 3 pixels, and two around it
    assert torch.equal(anew, expected)
    noisy = PHOTO + 0.02 * torch.randn(PHOTO.shape, generator=seeded())
    assert (begun()(flat(2.01), noisy).depth < 2.005).all()


@pytest.mark.parametrize("holes", [KEPT - 1, KEPT])
def test_mean_outlasts_some_frames_of_holes(holes):
    steady = begun(0.5, 0.1)
    for _ in range(holes):
        assert steady(flat(torch.nan, 0.1), PHOTO).depth.isnan().all()
    expected = 2.1 if holes == KEPT else 2 / (1 / 2.0 + 1 / 2.1)
    torch.testing.assert_close(steady(flat(2.1, 0.1), PHOTO).depth, flat(expected).depth)


def test_other_sizes_begin_anew_and_bad_values_are_refused():
    small = Surface(torch.full((1, 4, 5), 3.0), torch.full((1, 4, 5), 9.0))
    assert (begun()(small, torch.zeros(3, 4, 5)).depth == 3).all()
    with pytest.raises(ValueError, match="surface: expected one with expected errors"):
        Steady()(Surface(torch.full(SIZE, 2.0)), PHOTO)
    with pytest.raises(ValueError, match="alpha: expected a number above 0 and at most 1, got 0"):
        Steady(0)
