"""Depth that cannot be: what is taken for holes, where results may lie, and expected errors."""

import cv2
import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.inference.plausibility import count_patches, expect_errors, find_outliers, within_measured

HEIGHT, WIDTH = 96, 640


def wall(depth=4.0):
    """A tilted wall and a few holes, (1, h, w)."""
    columns = torch.arange(WIDTH, dtype=torch.float32)
    depth = (depth + 0.0005 * columns).expand(1, HEIGHT, WIDTH).clone()
    depth[:, 80:90, 300:340] = torch.nan
    return depth


def removed(depth):
    """Return what is found as row and column slices of its patches' bounding boxes."""
    _, _, boxes, _ = cv2.connectedComponentsWithStats(find_outliers(depth)[0].numpy().astype(np.uint8))
    return [(top, left, height, width) for left, top, width, height, _ in boxes[1:].tolist()]


@pytest.mark.parametrize("value", [0.025, 0.5, 30.0, 65.5])
def test_patches_far_from_all_around_them_are_found_to_the_pixel(value):
    depth = wall()
    depth[:, 10:16, 50:56] = value
    depth[:, 0:20, 200:220] = max(value, 30.0)  # the largest, at the border
    depth[:, 40, 400] = value
    depth[:, 41, 401] = value
    depth[:, 83:86, 305:309] = value  # in a hole
    expected = (depth == value) | (depth == max(value, 30.0))
    found = find_outliers(depth)
    torch.testing.assert_close(found, expected)
    assert count_patches(found) == (36 + 400 + 2 + 12, 4)
    assert not find_outliers(wall()).any()


def test_patch_that_is_too_large_or_not_far_enough_is_none():
    depth = wall()
    depth[:, 10:31, 50:70] = 0.5
    depth[:, 10:16, 200:206] = 1.2
    depth[:, 10:16, 400:406] = 15.0
    assert not find_outliers(depth).any()


def test_thin_things_survive():
    depth = wall()
    depth[:, 20:, 100:102] = 0.6  # a pole
    for step in range(60):  # a wire of single pixels
        depth[:, 10 + step, 200 + step] = 0.6
    depth[:, 50:60, 0:9] = 0.6  # a finger from outside
    depth[:, 90:, 400:] = 0.7  # a table, and the pieces of a lamp on it
    for top in range(30, 80, 10):
        depth[:, top : top + 6, 420:424] = 0.7
    assert not find_outliers(depth).any()


def test_gap_through_which_something_far_is_seen_survives_where_it_is_seen_elsewhere_too():
    near = torch.full((1, HEIGHT, WIDTH), 0.9)
    near[:, 40:46, 100:106] = 4.0
    assert removed(near) == [(40, 100, 6, 6)]
    near[:, :, 130:300] = 4.1
    assert removed(near) == []


def test_values_nearer_than_five_centimetres_are_holes_unless_the_map_is_of_near_things():
    depth = wall()
    depth[:, :, 600:] = 0.049  # larger than any patch
    torch.testing.assert_close(find_outliers(depth), depth == 0.049)
    assert not find_outliers(depth / 40).any()


def test_patches_of_small_maps_are_smaller():
    depth = torch.full((1, 60, 128), 4.0)
    depth[:, 10:14, 10:14] = 0.5
    depth[:, 30:35, 100:105] = 0.5
    assert removed(depth) == [(10, 10, 4, 4)]


@pytest.mark.parametrize("values", [[[1.0]], [[1.0, 9.0]], [[float("nan"), 2.0], [9.0, float("nan")]]])
def test_tiny_maps_stay_as_they_are(values):
    assert not find_outliers(torch.tensor([values])).any()


@pytest.mark.parametrize("size", [(48, 64), (12, 16), (18, 24), (3, 4)])
def test_planes_stay_planes_up_to_the_border_and_across_holes(size):
    rows, columns = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in (144, 192))
    plane = (0.5 + 0.3 * rows[:, None] - 0.25 * columns)[None]
    rows, columns = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in size)
    given = (0.5 + 0.3 * rows[:, None] - 0.25 * columns)[None]
    assert torch.equal(within_measured(plane, given), plane)
    h, w = size
    given[:, h // 3 : h // 3 + max(h // 6, 1), w // 4 : w // 2] = torch.nan
    given[:, :, : w // 12] = torch.nan
    assert torch.equal(within_measured(plane, given), plane)


def test_result_keeps_to_the_measured_values_around_it():
    given = torch.full((1, 60, 200), 0.5)
    given[:, :, 100:] = 0.9
    given[:, 20:24, 30:36] = torch.nan  # a narrow hole
    given[:, :, 185:] = torch.nan  # and a wide one, whose right end nothing is known of
    result = given.nan_to_num(0.5)
    given_values = ((5, 10, 40.0), (22, 33, 0.001), (6, 90, 5.0), (6, 110, 0.01), (7, 150, 1.4), (8, 195, 3))
    for row, column, value in given_values:
        result[0, row, column] = value
    kept = within_measured(result, given)
    expected = result.clone()
    for row, column, value in ((5, 10, 0.5), (22, 33, 0.5), (6, 90, 1.1), (6, 110, 0.3), (7, 150, 0.9)):
        expected[0, row, column] = value
    torch.testing.assert_close(kept[..., :185], expected[..., :185], rtol=2e-3, atol=0)
    assert within_measured(result, given[..., :1].expand_as(given).clone()).max() < 0.501
    torch.testing.assert_close(within_measured(result, torch.full_like(given, torch.nan)), result)


def test_result_is_at_most_twice_as_far_as_what_is_measured():
    given = torch.full((1, 60, 60), 0.1)
    given[:, :, 30:] = 2.0
    kept = within_measured(torch.full_like(given, 1e-6), given)
    torch.testing.assert_close(kept[0, 0, [10, 59]], torch.tensor([0.05, 2.0]), rtol=2e-3, atol=0)


CAMERA = Camera.from_fov(60, 96, 64)


def slanted(height, width):
    """Return inverse depth of a slanted plane, (1, height, width)."""
    across = (torch.arange(width) + 0.5) / width
    return (0.5 + 0.1 * across).expand(1, height, width).clone()


def test_a_plane_that_agrees_with_its_input_has_next_to_no_errors():
    spread, angle = expect_errors(slanted(64, 96), slanted(16, 24), CAMERA)
    assert spread.shape == angle.shape == (1, 64, 96)
    inside = (..., slice(20, -20), slice(20, -20))
    assert float(spread[inside].max()) < 1e-5
    assert float(angle[inside].max()) < 0.1


def test_copied_noise_is_expected_to_be_wrong():
    noise = 0.01 * torch.randn(1, 16, 24, generator=torch.Generator().manual_seed(0))
    given = slanted(16, 24) * (1 + noise)
    copied = given.repeat_interleave(4, -1).repeat_interleave(4, -2)
    rough, tilted = expect_errors(copied, given, CAMERA)
    smooth, flat = expect_errors(slanted(64, 96), given, CAMERA)
    assert 0.003 < float(rough.mean()) < 0.015
    assert float(smooth.mean()) < 0.7 * float(rough.mean())
    assert float(flat.mean()) < 0.7 * float(tilted.mean())


def test_errors_are_larger_at_steps_and_grow_into_holes():
    given = slanted(16, 24)
    given[..., 12:] *= 2
    given[:, 4:12, 2:8] = torch.nan
    result = slanted(64, 96)
    result[..., 48:] *= 2
    spread, angle = expect_errors(result, given, CAMERA)
    assert float(spread[0, 60, 48]) > 10 * float(spread[0, 60, 80])
    row = spread[0, 32, 8:17]
    assert bool((row.diff() > 0).all())
    assert float(row[0]) > 0.02
    assert float(angle[0, 32, 20]) >= 45
    assert float(angle[0, 32, 80]) < 1
