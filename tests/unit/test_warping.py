"""Warped depth maps against ray casts of the same world from the other camera: planes, a sphere, a step."""

import math

import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid, from_quaternion, invert, relative
from dsr.geometry.resampling import registered_camera, source_pixels, warp_depth
from dsr.synthetic.raycast import rotation

SENSOR = Camera(96, 72, 90.0, 88.0, 46.0, 36.5)
PHOTO = Camera(120, 90, 130.0, 131.0, 60.0, 44.0)


def transform(turn=(2.0, -3.0, 1.5), shift=(0.05, -0.02, 0.03)):
    """Return a transform from the sensor's to the photo's frame."""
    return as_rigid(np.column_stack((rotation(*turn), shift)), "transform")


def on_plane(camera, normal, offset):
    """Return the depth of the plane n . P = offset in a camera's own frame, (1, 1, H, W)."""
    along = (torch.tensor(normal)[:, None, None] * camera.rays()).sum(0)
    return torch.where(offset / along > 0, offset / along, torch.nan)[None, None]


def moved_plane(normal, offset, move):
    """Return normal and offset of a plane in the frame that a transform leads to."""
    turned = move[:3, :3] @ np.array(normal)
    return turned.tolist(), offset + float(turned @ move[:3, 3])


def on_sphere(camera, centre, radius, wall):
    """Return the depth of a sphere before a wall at infinity or at a plane's depth map, (1, 1, H, W)."""
    rays, middle = camera.rays(), torch.tensor(centre, dtype=torch.float64)[:, None, None]
    square, half = (rays**2).sum(0), (rays * middle).sum(0)
    root = half**2 - square * ((middle**2).sum(0) - radius**2)
    hit = torch.where(root > 0, (half - root.clamp(min=0).sqrt()) / square, torch.inf)
    return torch.minimum(hit[None, None], wall)


def warp(depth, move, camera=SENSOR, target=PHOTO):
    return warp_depth(depth, camera, torch.from_numpy(move)[None], target)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.93), (0.0, 0.75, 0.66)])
@pytest.mark.parametrize("target", [PHOTO, PHOTO.rescale(400, 300), PHOTO.rescale(40, 30)])
def test_warped_plane_is_the_plane_without_pinholes(normal, target):
    move = transform()
    seen = warp(on_plane(SENSOR, normal, 1.5), move, target=target)
    expected = on_plane(target, *moved_plane(normal, 1.5, move))
    assert float((seen - expected).abs().nan_to_num(0).max()) < 1e-6
    u, v = source_pixels(expected, SENSOR, torch.from_numpy(move)[None], target)
    inside = (u > -0.49) & (v > -0.49) & (u < SENSOR.width - 0.51) & (v < SENSOR.height - 0.51)
    outside = (u < -0.51) | (v < -0.51) | (u > SENSOR.width - 0.49) | (v > SENSOR.height - 0.49)
    assert bool(seen[:, 0][inside].isfinite().all())
    assert bool(seen[:, 0][outside].isnan().all())
    assert int(inside.sum()) > 0.7 * inside.numel()


def test_warped_sphere_agrees_with_its_ray_cast_and_the_wall_behind_it_has_the_shadow():
    shift, centre, wall = (-0.2, 0.0, 0.0), np.array([0.0, 0.0, 1.2]), 2.0
    move = transform((0, 0, 0), shift)
    seen = warp(on_sphere(SENSOR, centre, 0.3, on_plane(SENSOR, (0.0, 0.0, 1.0), wall)), move)
    behind = on_plane(PHOTO, (0.0, 0.0, 1.0), wall)
    expected = on_sphere(PHOTO, centre + shift, 0.3, behind)
    u, v = source_pixels(expected, SENSOR, torch.from_numpy(move)[None], PHOTO)
    columns, rows = u.round().long().clamp(0, SENSOR.width - 1), v.round().long().clamp(0, SENSOR.height - 1)
    first = on_sphere(SENSOR, centre, 0.3, on_plane(SENSOR, (0.0, 0.0, 1.0), wall))[0, 0][rows, columns][:, None]
    in_view = ((u > 0) & (v > 0) & (u < SENSOR.width - 1) & (v < SENSOR.height - 1))[:, None]
    shadow = in_view & (expected == behind) & (first < wall - 0.1)  # of the wall, behind the sphere for the sensor
    assert int(shadow.sum()) > 300
    assert float(seen[shadow].isnan().double().mean()) > 0.9
    ball = in_view & (expected < wall)
    errors = (seen - expected).abs()[ball]
    assert float(errors.isnan().double().mean()) < 0.06  # of the part that the sensor does not see
    assert float(errors.nanmedian()) < 1e-3
    assert float((errors.nan_to_num(0) < 0.02).double().mean()) > 0.93  # all but the rim
    assert float((seen - wall).abs()[in_view & (expected == behind) & ~shadow].nanquantile(0.95)) < 1e-6


def test_nearer_surface_hides_the_farther_one_whatever_its_place_in_the_map():
    for flipped in (False, True):
        depth = torch.full((1, 1, 40, 60), 2.0, dtype=torch.float64)
        depth[..., 20:40] = 1.0
        depth = depth.flip(-1) if flipped else depth
        camera = Camera(60, 40, 60.0, 60.0, 29.5, 19.5)
        move = transform((0, 0, 0), (0.1, 0, 0))  # the nearer surface moves by 6 pixels, the farther one by 3
        seen = warp(depth, move, camera, camera)[0, 0, 20]
        assert seen[26:46].tolist() == pytest.approx([1.0] * 20)
        assert seen[46:].tolist() == pytest.approx([2.0] * 14)
        assert bool(seen[23:26].isnan().all())  # disoccluded
        assert seen[3:23].tolist() == pytest.approx([2.0] * 20)


def test_identity_returns_the_map_with_its_steps_and_holes():
    depth = 1 + torch.rand(2, 1, 72, 96, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth[:, :, 5:9, 10:30] = torch.nan
    seen = warp_depth(depth, SENSOR, torch.eye(4, dtype=torch.float64)[None], SENSOR)
    assert torch.equal(seen.isnan(), depth.isnan())
    assert torch.allclose(seen, depth, equal_nan=True, rtol=0.021)  # a rim may hide what is 2 % behind it


def test_registered_camera_has_the_photos_view_at_the_sensors_resolution():
    photo = Camera(1920, 1440, 1450.0, 1450.0, 950.0, 725.0)
    camera = registered_camera(Camera(640, 480, 400.0, 400.0, 319.5, 239.5), photo)
    assert (camera.width, camera.height) == (530, 397)
    assert camera.fx == pytest.approx(400, rel=2e-3)
    assert registered_camera(Camera(4000, 3000, 4000.0, 4000.0, 2000.0, 1500.0), photo) == photo


# poses


def test_relative_pose_maps_between_the_two_cameras():
    first, second = transform(), transform((20.0, 10.0, 0.0), (1.0, 2.0, 3.0))
    point = np.array([0.1, 0.2, 1.5, 1.0])
    assert second @ relative(first, second) @ point == pytest.approx(first @ point)
    assert invert(first) @ first == pytest.approx(np.eye(4))


def test_quaternion_of_a_quarter_turn_about_z_maps_x_to_y():
    half = math.sqrt(0.5)
    matrix = from_quaternion((1, 2, 3), (0, 0, half, half), "pose")
    assert matrix @ np.array([1, 0, 0, 1]) == pytest.approx([1, 3, 3, 1])


@pytest.mark.parametrize(
    "matrix",
    [np.eye(3), np.full((4, 4), np.nan), 1.01 * np.eye(4)[:3], np.diag([1.0, 1.0, -1.0, 1.0]), np.ones((4, 4)),
     [[1, 2], [3]]],
)  # fmt: skip
def test_matrices_that_are_not_rigid_are_refused(matrix):
    with pytest.raises(ValueError, match=r"^here: expected "):
        as_rigid(matrix, "here")


def test_rounded_rotation_is_made_orthonormal():
    matrix = as_rigid(np.round(transform(), 3), "here")
    assert matrix[:3, :3] @ matrix[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
