"""Depth of references: levels that are smoothed, holes that are filled, and other sizes, against planes and spheres."""

import numpy as np
import pytest
import torch
from small_scenes import sphere_depth

from dsr.data.reference_depth import fit, inpaint_depth, resize, resize_depth, smooth_levels
from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.sample import Scene

Y, X = np.mgrid[:120, :160].astype(float)


@pytest.mark.parametrize(("a", "b", "share"), [(0.03, 0.0, 0.2), (0.05, -0.03, 0.2), (0.4, 0.3, 0.3), (0.9, -0.8, 0.8)])
def test_slope_is_restored_and_the_more_accurately_the_wider_its_terraces(a, b, share):
    truth = 100 + a * X + b * Y
    error = np.abs(smooth_levels(np.round(truth)) - truth)[8:-8, 8:-8]
    rounded = np.abs(np.round(truth) - truth)[8:-8, 8:-8]
    assert error.mean() < share * rounded.mean()


def test_slopes_of_a_curved_surface_are_nearer_to_the_truth_than_terraces():
    truth = 100 + 12 * np.sin(X / 40) * np.cos(Y / 35)
    slopes = [np.gradient(values)[1] for values in (truth, np.round(truth), smooth_levels(np.round(truth)))]
    assert np.abs(slopes[2] - slopes[0]).mean() < 0.25 * np.abs(slopes[1] - slopes[0]).mean()


def test_result_rounds_to_the_stored_levels():
    truth = 100 + 12 * np.sin(X / 40) * np.cos(Y / 35)
    assert np.abs(smooth_levels(np.round(truth)) - np.round(truth)).max() <= 0.5


def test_edges_and_holes_are_borders_of_the_smoothing():
    levels = np.full((40, 60), 50.0)
    levels[:, 30:] = 90.0
    levels[10:20, 10:20] = np.nan
    smooth = smooth_levels(levels)
    assert np.array_equal(np.isnan(smooth), np.isnan(levels))
    np.testing.assert_allclose(smooth[~np.isnan(levels)], levels[~np.isnan(levels)], atol=1e-6)


CAMERA = Camera(90, 60, 80.0, 82.0, 44.0, 30.5, baseline=0.1, doffs=3.0)


def plane_depth(camera):
    x, y, _ = camera.rays()
    return 1 / (0.05 * x - 0.3 * y + 0.4)[None]


def scene(depth, camera=CAMERA):
    rgb = torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(0))
    return Scene("set", "one", rgb, camera, depth)


@pytest.mark.parametrize(("height", "width"), [(20, 30), (17, 25), (41, 61), (60, 90), (66, 99), (120, 180)])
def test_plane_is_reproduced_in_the_new_camera_up_to_the_border_and_beside_a_hole(height, width):
    depth = plane_depth(CAMERA)
    depth[:, 20:33, 11:40] = torch.nan
    fine = resize_depth(depth, height, width)
    truth = plane_depth(CAMERA.rescale(width, height))
    known = fine.isfinite()
    torch.testing.assert_close(fine[known], truth[known], rtol=1e-7, atol=0)
    assert 0.8 < known.double().mean() < 0.97


def test_same_size_leaves_depth_unchanged():
    depth = 1 + torch.rand(1, 60, 90, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert torch.equal(resize(scene(depth), 60, 90).depth, depth)


@pytest.mark.parametrize(("height", "width"), [(20, 30), (23, 31), (66, 99)])
def test_depth_edges_are_not_mixed(height, width):
    depth = torch.full((1, 60, 90), 2.0, dtype=torch.float64)
    depth[:, 15:41, 22:67] = 1.0
    fine = resize_depth(depth, height, width)
    assert set(fine.unique().tolist()) == {1.0, 2.0}
    share = (fine == 1).double().mean()
    assert share == pytest.approx(26 * 45 / 5400, abs=0.02)


def test_pixel_is_a_hole_exactly_where_its_centre_falls_on_one():
    depth = torch.full((1, 60, 90), 2.0, dtype=torch.float64)
    depth[:, 10:20, 30:33] = torch.nan
    fine = resize_depth(depth, 20, 30)
    expected = torch.zeros(1, 20, 30, dtype=torch.bool)
    expected[:, 3:7, 10] = True  # centres at rows 10, 13, 16, 19 and column 31
    assert torch.equal(fine.isnan(), expected)


def test_averaging_halves_the_noise_of_a_plane():
    noise = 1e-3 * torch.randn(1, 120, 180, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    fine = resize_depth(2 + noise, 30, 45)
    assert float((fine - 2).std()) < 0.35e-3


def test_scene_keeps_its_normals_and_disparities_scale_with_the_size():
    before = scene(plane_depth(CAMERA))
    after = resize(before, 30, 45)
    assert after.rgb.shape == (3, 30, 45)
    assert after.camera == CAMERA.rescale(45, 30)
    normal = depth_to_normals(before.depth[None], before.camera.rays()[None])[0, :, 5, 5]
    torch.testing.assert_close(
        depth_to_normals(after.depth[None], after.camera.rays()[None])[0],
        normal[:, None, None].expand(3, 30, 45), rtol=0, atol=1e-6,
    )  # fmt: skip


def sphere_before_wall(camera):
    return sphere_depth(camera.rays(), (0, 0, 2), 0.4).clamp(max=2.5)[None]


@pytest.mark.parametrize("size", [(120, 180), (200, 300), (480, 720), (520, 780)])
def test_curved_surface_keeps_its_place(size):
    camera = Camera(720, 480, 640.0, 640.0, 350.0, 244.0)
    small = resize(scene(sphere_before_wall(camera), camera), *size)
    truth = sphere_before_wall(small.camera)
    inner = (truth < 1.7) & (small.depth < 1.7)  # the sphere but for its rim
    assert inner.double().mean() > 0.05
    torch.testing.assert_close(small.depth[inner], truth[inner], rtol=2e-4, atol=0)
    normals, exact = (depth_to_normals(depth[None], small.camera.rays()[None]) for depth in (small.depth, truth))
    angle = (normals * exact).sum(dim=1).clamp(-1, 1).arccos().rad2deg()
    assert float(angle[0][inner[0]].quantile(0.95)) < 1.0


@pytest.mark.parametrize(("place", "left"), [(0.0, 0), (0.5, 12), (1.0, 24)])
def test_fitting_resizes_the_shorter_side_and_crops_the_longer(place, left):
    found = fit(scene(plane_depth(CAMERA)), 48, place)
    assert (found.camera.height, found.camera.width) == (48, 48)
    assert found.camera == CAMERA.rescale(72, 48).crop(0, left, 48, 48)


def test_fitting_without_a_window_or_without_enlarging():
    whole = scene(plane_depth(CAMERA))
    assert fit(whole, 48, None).rgb.shape == (3, 48, 72)
    assert fit(whole, 120, None, enlarge=False).rgb.shape == (3, 60, 90)
    assert fit(whole, 120, 0.5, enlarge=False).rgb.shape == (3, 60, 60)


def test_camera_of_plant_follows_from_that_of_icl_nuim():
    native = Camera(640, 480, 480.6, 480.6, 319.5, 239.5)  # the authors take the mean of 481.2 and 480 for both
    height, width = 480, 640
    depth = torch.full((1, height, width), 2.0, dtype=torch.float64)
    found = fit(Scene("icl", "plant", torch.zeros(3, height, width), native, depth), 512)
    assert (found.camera.width, found.camera.height) == (512, 512)
    assert (found.camera.fx, found.camera.fy) == (pytest.approx(512.64, rel=1e-3), pytest.approx(512.64))
    assert (found.camera.cx, found.camera.cy) == (pytest.approx(255.8, abs=0.6), pytest.approx(255.4667, abs=0.04))


def test_scene_without_high_resolution_depth_cannot_be_resized():
    only = Scene("set", "one", torch.zeros(3, 60, 90), CAMERA, None, {2: torch.ones(1, 30, 45)})
    with pytest.raises(ValueError, match="one: expected a true depth map to resize, there is none"):
        resize(only, 30, 45)


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
