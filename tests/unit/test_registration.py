"""Displacements that a test put between photo and depth are found, and undone without mixing surfaces."""

import numpy as np
import pytest
import torch

from dsr.degradation.noise import Kinect
from dsr.geometry.registration import Displacement, find_displacement, undo

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


@pytest.mark.parametrize("shift", [(0.5, 0.0), (0.0, -1.0), (1.5, 1.0), (-3.0, 2.0), (8.0, -6.5)])
@pytest.mark.parametrize("noisy", [False, True])
def test_shift_is_found_to_a_fraction_of_a_pixel(scene, shift, noisy):
    photo, inverse = scene
    depth_lr = displaced(inverse, *shift)
    if noisy:
        depth_lr = Kinect()(depth_lr, torch.Generator().manual_seed(1))
    found = find_displacement(depth_lr, photo)
    assert found.certain or (noisy and max(map(abs, shift)) < 1)  # half a pixel of a noisy map is weak evidence
    assert np.hypot(found.right - shift[0], found.down - shift[1]) < 0.4
    assert abs(found.scale - 1) < 0.002


@pytest.mark.parametrize(("right", "down", "scale"), [(0.0, 0.0, 1.015), (1.0, -1.0, 0.985), (2.0, 3.0, 1.02)])
def test_scale_is_found(scene, right, down, scale):
    photo, inverse = scene
    found = find_displacement(displaced(inverse, right, down, scale), photo)
    assert found.certain
    assert found.scale == pytest.approx(scale, abs=0.004)  # 0.4 pixels at the border
    assert np.hypot(found.right - right, found.down - down) < 0.4


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noisy", [False, True])
def test_aligned_pairs_are_left_alone(seed, noisy):
    photo, inverse = world(seed)
    depth_lr = displaced(inverse)
    if noisy:
        depth_lr = Kinect()(depth_lr, torch.Generator().manual_seed(seed))
    found = find_displacement(depth_lr, photo)
    assert not found.certain
    assert not found.visible


@pytest.mark.parametrize("seed", range(1, 5))
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
