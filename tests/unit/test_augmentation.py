"""Augmentation of scenes: what is turned or mirrored is another view of the same surface, or of its mirror image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals, lights, render
from dsr.sample import Scene
from dsr.training.patches import augment, mirror, rotate90
from dsr.training.settings import PatchSettings

CAMERA = Camera(width=31, height=23, fx=30.0, fy=27.0, cx=13.3, cy=9.9, baseline=0.1, doffs=0.7)


def _scene() -> Scene:
    random = np.random.default_rng(0)
    v, u = np.mgrid[:23, :31]
    depth = torch.from_numpy(2 + 0.03 * u + 0.2 * np.sin(u / 3) * np.cos(v / 4))[None]
    depth[0, 5, 7] = torch.nan
    rgb = torch.from_numpy(random.random((3, 23, 31))).float()
    return Scene("set", "waves", rgb, CAMERA, depth, {1: depth})


def _normals(scene: Scene) -> Tensor:
    assert scene.depth is not None
    return depth_to_normals(scene.depth[None], scene.camera.rays()[None])[0]


def _quarter(vectors: Tensor) -> Tensor:
    """Return vectors turned counterclockwise about the axis, as a picture with y down shows it."""
    x, y, z = vectors
    return torch.stack((y, -x, z))


def _points(scene: Scene) -> Tensor:
    assert scene.depth is not None
    return scene.depth * scene.camera.rays()


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_scene_has_the_turned_points(turns: int) -> None:
    expected = _points(_scene()).rot90(turns, (-2, -1))
    for _ in range(turns):
        expected = _quarter(expected)
    torch.testing.assert_close(_points(rotate90(_scene(), turns)), expected, rtol=0, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_plane_has_the_turned_normal_and_is_lit_by_it(turns: int) -> None:
    normal = torch.tensor([0.3, -0.4, -1.0], dtype=torch.float64)[:, None, None]
    depth = -2.0 / (normal * CAMERA.rays()).sum(dim=0, keepdim=True)
    shown = _normals(rotate90(Scene("set", "plane", torch.rand(3, 23, 31), CAMERA, depth), turns))
    expected = normal / normal.norm()
    for _ in range(turns):
        expected = _quarter(expected)
    lit = (lights() @ expected.flatten()).clamp(0, 1)[:, None, None]
    known = shown[0].isfinite()
    assert known.float().mean() > 0.8
    assert float((shown - expected).abs()[:, known].max()) < 1e-9
    assert float((render(shown[None])[0] - lit).abs()[:, known].max()) < 1e-9


def test_four_quarter_turns_and_two_mirrors_restore_the_scene() -> None:
    scene = _scene()
    there = rotate90(rotate90(rotate90(rotate90(scene, 1), 1), 1), 1)
    twice = mirror(mirror(scene, vertical=True), vertical=True)
    for other in (there, twice):
        assert torch.equal(other.rgb, scene.rgb)
        torch.testing.assert_close(_points(other), _points(scene), rtol=0, atol=1e-12, equal_nan=True)
        assert not other.measured  # which would have to be turned, too
    assert rotate90(scene, 4) is scene
    both = mirror(mirror(scene), vertical=True)
    half = rotate90(scene, 2)
    assert torch.equal(both.rgb, half.rgb)
    assert both.camera == half.camera


@pytest.mark.parametrize("vertical", [False, True])
def test_mirrored_scene_has_the_mirrored_points(vertical: bool) -> None:
    sign = torch.tensor([1.0, -1.0, 1.0] if vertical else [-1.0, 1.0, 1.0], dtype=torch.float64)[:, None, None]
    expected = sign * _points(_scene()).flip(-2 if vertical else -1)
    shown = _points(mirror(_scene(), vertical=vertical))
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-12, equal_nan=True)


def test_factor_of_a_varied_scene_is_that_of_its_depth() -> None:
    settings = PatchSettings(flip=False, rotate=False, depth_scale=0.5, colour=0.0)
    random, factors = np.random.default_rng(0), []
    for _ in range(200):
        scene, factor = augment(_scene(), settings, random)
        torch.testing.assert_close(_points(scene), factor * _points(_scene()), rtol=1e-13, atol=0, equal_nan=True)
        assert scene.camera == CAMERA
        factors.append(np.log(factor))
    assert -0.5 <= min(factors) < -0.45
    assert 0.45 < max(factors) <= 0.5
    assert np.mean(factors) == pytest.approx(0, abs=0.07)


def test_scene_without_variation_is_unchanged() -> None:
    settings = PatchSettings(flip=False, rotate=False, depth_scale=0.0, colour=0.0)
    scene, factor = augment(_scene(), settings, np.random.default_rng(0))
    assert factor == 1
    assert torch.equal(scene.rgb, _scene().rgb)
    torch.testing.assert_close(_points(scene), _points(_scene()), rtol=0, atol=0, equal_nan=True)
