"""Distances to known pixels, and wide holes."""

import pytest
import torch

from dsr.geometry.hole_size import distance_to_known, wide_holes


def test_distance_is_that_of_the_nearest_known_pixel():
    known = torch.rand((1, 23, 31), generator=torch.Generator().manual_seed(0)) < 0.05
    rows, columns = torch.meshgrid(torch.arange(23.0), torch.arange(31.0), indexing="ij")
    y, x = known[0].nonzero().T
    expected = torch.hypot(rows[..., None] - y, columns[..., None] - x).amin(-1)
    torch.testing.assert_close(distance_to_known(known)[0], expected, rtol=1e-4, atol=1e-4)


def test_without_known_pixels_the_distance_is_infinite():
    known = torch.zeros((1, 4, 5), dtype=torch.bool)
    assert bool(distance_to_known(known).isinf().all())
    assert bool(wide_holes(known, 6).all())


def test_narrow_parts_of_wide_holes_are_not_wide():
    known = torch.ones((1, 60, 80), dtype=torch.bool)
    known[:, 10:40, 10:40] = False  # 30 pixels wide
    known[:, 20:26, 40:70] = False  # a channel of 6 pixels
    wide = wide_holes(known, 12)
    assert not bool((wide & known).any())
    assert bool(wide[:, 14:36, 14:36].all())
    assert not bool(wide[:, :, 45:].any())
    assert 0.9 * 900 < int(wide[:, :, :40].sum()) <= 900  # but for the corners
    assert not bool(wide_holes(known, 32).any())


def test_holes_at_the_border_are_wide_from_half_of_the_width_on():
    known = torch.ones((1, 40, 50), dtype=torch.bool)
    known[:, :, :8] = False
    assert bool(wide_holes(known, 14)[:, :, :7].all())
    assert not bool(wide_holes(known, 16).any())


@pytest.mark.parametrize("size", [1, 3, 5])
def test_holes_of_a_few_pixels_are_never_wide(size):
    known = torch.ones((1, 16, 16), dtype=torch.bool)
    known[:, 5 : 5 + size, 5 : 5 + size] = False
    assert not bool(wide_holes(known, 0.1).any())
