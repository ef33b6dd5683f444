"""Maps seen by another camera: warped ones against ray casts, displacements found and undone."""

import math

import numpy as np
import pytest
import torch
from small_scenes import sphere_depth

from dsr.degradation.noise import Kinect
from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid, from_quaternion, invert, relative
from dsr.geometry.registration import Displacement, find_displacement, undo
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


def warp(depth, move, camera=SENSOR, target=PHOTO):
    return warp_depth(depth, camera, torch.from_numpy(move)[None], target)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.93), (0.0, 0.75, 0.66)])
@pytest.mark.parametrize("target", [PHOTO, PHOTO.rescale(400, 300), PHOTO.rescale(40, 30)])
def test_warped_plane_is_the_plane_without_pinholes(normal, target):
    move = transform()
    seen = warp(on_plane(SENSOR, normal, 1.5), move, target=target)
    turned = move[:3, :3] @ np.array(normal)
    expected = on_plane(target, turned.tolist(), 1.5 + float(turned @ move[:3, 3]))
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
    measured = sphere_depth(SENSOR.rays(), centre, 0.3).clamp(max=wall)[None, None]
    seen = warp(measured, move)
    behind = torch.full_like(seen, wall)
    expected = torch.minimum(sphere_depth(PHOTO.rays(), centre + shift, 0.3), behind)
    u, v = source_pixels(expected, SENSOR, torch.from_numpy(move)[None], PHOTO)
    columns, rows = u.round().long().clamp(0, SENSOR.width - 1), v.round().long().clamp(0, SENSOR.height - 1)
    first = measured[0, 0][rows, columns][:, None]
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


SIZE, RATIO = 384, 2


def world(seed=0, count=14):
    """Return a photo, (3, H, W), and inverse depth, (H, W): discs and boxes of their own colours before a wall."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    depth, photo = np.full((SIZE, SIZE), 4.0), np.full((3, SIZE, SIZE), 0.5)
    for near in np.linspace(3.5, 1.0, count):
        v, u, radius = *rng.uniform(0.1, 0.9, 2), rng.uniform(0.05, 0.11)
        dv, du = rows - v * SIZE, columns - u * SIZE
        inside = np.hypot(dv, du) < radius * SIZE if rng.random() < 0.5 else np.fmax(abs(dv), abs(du)) < radius * SIZE
        depth[inside] = near
        photo[:, inside] = rng.uniform(0.1, 0.9, (3, 1))
    photo += 0.02 * rng.standard_normal(photo.shape)
    return torch.from_numpy(photo.clip(0, 1)).float(), 1 / depth


def displaced(inverse, right=0.0, down=0.0, scale=1.0, samples=4):
    """Return the map, (1, h, w), whose pixel p shows what the photo has at c + scale (p - c) + (right, down)."""
    count = SIZE // RATIO
    middle = (count - 1) / 2
    within = (np.arange(samples) + 0.5) / samples - 0.5
    places = (np.arange(count)[:, None] + within).ravel()
    rows, columns = (
        np.rint((scale * (places - middle) + middle + shift + 0.5) * RATIO - 0.5).clip(0, SIZE - 1).astype(int)
        for shift in (down, right)
    )
    means = inverse[rows][:, columns].reshape(count, samples, count, samples).mean((1, 3))
    return torch.from_numpy(1 / means)[None]


@pytest.fixture(scope="module")
def scene():
    return world()


@pytest.mark.parametrize(
    ("right", "down", "scale", "noisy"),
    [
        *((*shift, 1, noisy) for shift in ((0.5, 0), (-3, 2), (8, -6.5)) for noisy in (False, True)),
        *((*change, False) for change in ((0, 0, 1.015), (1, -1, 0.985), (2, 3, 1.02))),
    ],
)
def test_shift_and_scale_are_found_to_a_fraction_of_a_pixel(scene, right, down, scale, noisy):
    photo, inverse = scene
    depth_lr = displaced(inverse, right, down, scale)
    if noisy:
        depth_lr = Kinect()(depth_lr, torch.Generator().manual_seed(1))
    found = find_displacement(depth_lr, photo)
    assert found.certain or (noisy and abs(right) < 1)  # half a pixel of a noisy map is weak evidence
    assert np.hypot(found.right - right, found.down - down) < 0.4
    assert found.scale == pytest.approx(scale, abs=0.002 if scale == 1 else 0.004)  # 0.4 pixels at the border


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("noisy", [False, True])
def test_aligned_pairs_are_left_alone(seed, noisy):
    photo, inverse = world(seed)
    depth_lr = displaced(inverse)
    if noisy:
        depth_lr = Kinect()(depth_lr, torch.Generator().manual_seed(seed))
    found = find_displacement(depth_lr, photo)
    assert not found.certain
    assert not found.visible


@pytest.mark.parametrize("seed", [1, 2])
def test_photo_of_something_else_moves_nothing(scene, seed):
    assert not find_displacement(displaced(world(seed)[1]), scene[0]).certain


def test_shift_along_edges_stays_unknown():
    photo = torch.zeros(3, SIZE, SIZE)
    inverse = np.ones((SIZE, SIZE))
    for start in range(40, SIZE, 80):
        photo[:, :, start : start + 40] = 0.8
        inverse[:, start : start + 40] = 0.5
    photo += 0.02 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(0))
    found = find_displacement(displaced(inverse, 2.0, 3.0), photo.clamp(0, 1))
    assert found.down == 0


def test_map_without_edges_gives_none(scene):
    assert find_displacement(torch.full((1, 96, 96), 2.0), scene[0]) is None


def test_undone_shift_of_whole_pixels_is_exact():
    depth = 1 + torch.rand(1, 20, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth[:, 4:6, 7] = torch.nan
    moved = undo(depth, Displacement(3.0, -2.0))
    assert torch.allclose(moved[:, :18, 3:], depth[:, 2:, :27], equal_nan=True)
    assert bool(moved[:, 18:].isnan().all())
    assert bool(moved[:, :, :3].isnan().all())


def test_undone_displacement_keeps_planes_and_does_not_mix_surfaces():
    rows, columns = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    inverse = (0.5 + 0.002 * columns + 0.001 * rows).double()
    inverse[:, 25:] += 0.5
    moved = undo(inverse.reciprocal()[None], Displacement(0.3, 0.6, 1.01))[0].reciprocal()
    u, v = (columns - 24.5 - 0.3) / 1.01 + 24.5, (rows - 19.5 - 0.6) / 1.01 + 19.5
    plane = 0.5 + 0.002 * u + 0.001 * v
    known = moved.isfinite()
    assert float(known.double().mean()) > 0.95
    off = torch.minimum((moved - plane).abs(), (moved - plane - 0.5).abs())[known]
    assert float(off.max()) < 0.0025  # one pixel's slope, beside the step
    assert float(off.median()) < 1e-6
    left, right = moved[:, :-1][u[:, :-1] < 24.0], moved[:, 1:][u[:, 1:] > 25.0]
    assert float(left[left.isfinite()].max()) < 0.75
    assert float(right[right.isfinite()].min()) > 0.75
