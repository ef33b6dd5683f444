"""Resizing scenes: against planes in closed form, and by what must not happen."""

import pytest
import torch

from dsr.data.reference_depth import fit, resize, resize_depth
from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.sample import Scene

CAMERA = Camera(90, 60, 80.0, 82.0, 44.0, 30.5, baseline=0.1, doffs=3.0)


def plane_depth(camera, a=0.05, b=-0.3, c=0.4):
    """Return the exact depth of the plane 1 / z = (a, b, c) . r."""
    rays = camera.rays()
    return 1 / (a * rays[0] + b * rays[1] + c * rays[2])[None]


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


def sphere_depth(camera):
    """Return the exact depth of a sphere of 0.4 m around (0, 0, 2), and of a wall 2.5 m away beside it."""
    rays = camera.rays()
    square, along = rays.square().sum(dim=0), 2 * rays[2]
    root = along.square() - square * (4 - 0.16)
    return torch.where(root > 0, (along - root.clamp(min=0).sqrt()) / square, 2.5)[None]


@pytest.mark.parametrize("size", [(120, 180), (200, 300), (480, 720), (520, 780)])
def test_curved_surface_keeps_its_place(size):
    camera = Camera(720, 480, 640.0, 640.0, 350.0, 244.0)
    small = resize(scene(sphere_depth(camera), camera), *size)
    truth = sphere_depth(small.camera)
    inner = (truth < 1.7) & (small.depth < 1.7)  # the sphere but for its rim
    assert inner.double().mean() > 0.05
    torch.testing.assert_close(small.depth[inner], truth[inner], rtol=2e-4, atol=0)
    normals, exact = (depth_to_normals(depth[None], small.camera.rays()[None]) for depth in (small.depth, truth))
    angle = (normals * exact).sum(dim=1).clamp(-1, 1).arccos().rad2deg()
    assert float(angle[0][inner[0]].quantile(0.95)) < 1.0


def test_crop_has_the_same_points():
    whole = scene(plane_depth(CAMERA))
    part = whole.crop(7, 11, 30, 40)
    points, window = (each.depth * each.camera.rays() for each in (whole, part))
    torch.testing.assert_close(window, points[:, 7:37, 11:51])


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
    with pytest.raises(ValueError, match="one: expected a high-resolution depth map to resize, there is none"):
        resize(only, 30, 45)
