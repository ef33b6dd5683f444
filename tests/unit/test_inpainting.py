"""Filling holes: harmonic inside, the background's depth in occlusions."""

import torch

from dsr.data.reference_depth import inpaint_depth


def inverse_plane(height=40, width=60):
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    return (0.5 + 1e-3 * x - 5e-4 * y)[None]


def test_plane_is_restored_in_any_holes_and_valid_pixels_are_unchanged():
    plane = 1 / inverse_plane()
    holed = plane.clone()
    holed[:, 5:20, 10:33] = torch.nan
    holed[:, 30:33, 40:58] = torch.nan
    torch.testing.assert_close(inpaint_depth(holed), plane, rtol=1e-10, atol=0)
    holed[:, 3, 3] = 7.0
    assert inpaint_depth(holed)[0, 3, 3] == 7


def test_hole_at_the_border_is_filled_from_its_partial_rim():
    holed = torch.full((1, 20, 30), 2.0, dtype=torch.float64)
    holed[:, :, :7] = torch.nan
    torch.testing.assert_close(inpaint_depth(holed), torch.full_like(holed, 2.0))


def test_occlusion_behind_a_near_object_takes_the_background():
    depth = 1 / inverse_plane()
    truth = depth.clone()
    depth[:, 10:30, 30:50] = 0.7
    truth[:, 10:30, 30:50] = 0.7
    depth[:, 10:30, 24:30] = torch.nan  # what a second camera on the left does not see
    filled = inpaint_depth(depth)
    torch.testing.assert_close(filled[:, 12:28, 24:30], truth[:, 12:28, 24:30], rtol=1.5e-2, atol=0)
