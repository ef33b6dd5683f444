"""Lights and renderings, against the protocol's literal values."""

from __future__ import annotations

import numpy as np
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import comparison, depth_to_normals, lights, render, render_for_viewing, shade

PROTOCOL = -np.array(
    [
        [0, np.sqrt(2 / 3), 1 / np.sqrt(3)],
        [1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [-1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [0, 0, 1],
    ]
)


def _normals(seed: int, shape: tuple[int, ...] = (2, 3, 5, 4)) -> torch.Tensor:
    vectors = torch.from_numpy(np.random.default_rng(seed).normal(size=shape))
    return vectors / vectors.norm(dim=1, keepdim=True)


def test_lights_are_those_of_the_protocol() -> None:
    assert LIGHT_NAMES == ("e1", "e2", "e3", "e4")
    np.testing.assert_allclose(lights().numpy(), PROTOCOL, rtol=0, atol=1e-15)


def test_first_three_lights_are_orthonormal_and_the_fourth_is_frontal() -> None:
    basis = lights()[:3].numpy()
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), rtol=0, atol=1e-15)
    assert lights()[3].tolist() == [0, 0, -1]


def test_shading_is_the_cosine_to_each_light() -> None:
    normals = _normals(0)
    shaded = shade(normals, lights()).numpy()
    assert shaded.shape == (2, 4, 5, 4)
    for light in range(4):
        expected = (normals.numpy() * PROTOCOL[light][None, :, None, None]).sum(axis=1)
        np.testing.assert_allclose(shaded[:, light], expected, rtol=0, atol=1e-14)


def test_difference_of_three_shadings_is_that_of_the_normal_maps() -> None:
    first, second = _normals(1), _normals(2)
    basis = lights()[:3]
    shaded = (shade(first, basis) - shade(second, basis)).square().mean()
    assert abs(shaded - (first - second).square().mean()) < 1e-14


def test_floor_is_lit_from_above_and_a_wall_on_the_right_from_the_left() -> None:
    floor, right_wall = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([-1.0, 0.0, 0.0])
    both = torch.stack((floor, right_wall))[:, :, None, None]
    floor_light, wall_light = render(both)[:, :, 0, 0].tolist()
    np.testing.assert_allclose(floor_light, [np.sqrt(2 / 3), 0, 0, 0], atol=1e-7)
    np.testing.assert_allclose(wall_light, [0, 1 / np.sqrt(2), 0, 0], atol=1e-7)


FLOOR, CEILING, WALL, FROM_LEFT, FROM_RIGHT = (0, -1, 0), (0, 1, 0), (0, 0, -1), (1, 0, 0), (-1, 0, 0)


def _brightness(*normals: tuple[float, float, float]) -> np.ndarray:
    vectors = torch.tensor(normals, dtype=torch.float64).T[None, :, None]
    return render_for_viewing(vectors / vectors.norm(dim=1, keepdim=True))[0, 0, 0].numpy()


def test_rendering_for_viewing_keeps_floor_walls_and_ceiling_apart_from_each_other_and_from_black_and_white() -> None:
    shades = _brightness(FLOOR, WALL, FROM_RIGHT, FROM_LEFT, CEILING)
    assert shades.max() < 0.9
    assert shades.min() > 0.1
    assert (np.diff(shades) < -0.04).all()  # floors are the brightest: the light is above


def test_rendering_for_viewing_shows_a_tilt_of_two_degrees_on_floors_walls_and_ceilings() -> None:
    tilt = np.tan(np.deg2rad(2))
    for normal in (FLOOR, CEILING, WALL, FROM_LEFT, FROM_RIGHT):
        tilted = [np.array(normal) + tilt * np.eye(3)[axis] for axis in range(3) if not normal[axis]]
        steps = _brightness(normal, *map(tuple, tilted))
        assert np.abs(steps[1:] - steps[0]).max() > 1.5 / 255


CAMERA = Camera(width=160, height=144, fx=200.0, fy=200.0, cx=79.5, cy=71.5)
RAYS = CAMERA.rays()[None]
RANDOM = torch.Generator().manual_seed(1)
DEPTH = 2 + torch.rand(1, 1, 144, 160, dtype=torch.float64, generator=RANDOM)
RGB = torch.rand(1, 3, 144, 160, generator=RANDOM)
LOW = DEPTH[..., ::4, ::4]


def _panel(picture: torch.Tensor, row: int, column: int) -> torch.Tensor:
    """Return a panel, (3, 144, 160), without the line of 16 pixels above it."""
    top = row * 160 + 16
    return picture[:, top : top + 144, column * 160 : (column + 1) * 160].int()


def test_comparison_shows_photo_input_result_and_truth_and_all_four_lights() -> None:
    other = 1.1 * DEPTH
    other = other + 0.05 * torch.rand(other.shape, generator=RANDOM)
    picture = comparison(other, DEPTH, RAYS, RGB, LOW)
    assert (picture.shape, picture.dtype) == ((3, 4 * 160, 4 * 160), torch.uint8)
    torch.testing.assert_close(_panel(picture, 0, 0), (255 * RGB[0]).round().int())
    coarse, truth = _panel(picture, 0, 1), _panel(picture, 0, 3)
    torch.testing.assert_close(coarse[:, 2::4, 2::4], truth[:, ::4, ::4])  # the truth's colours
    near = (truth[0].float() - (255 * (1 - 0.9 * (DEPTH[0, 0] - DEPTH.min()) / (DEPTH.max() - DEPTH.min())))).abs()
    assert float(near.max()) <= 1
    result, lit = (render(depth_to_normals(each, RAYS))[0].float() for each in (other, DEPTH))
    for light in range(4):
        assert (_panel(picture, 1, light)[0] - 255 * result[light]).abs().max() <= 1
        assert (_panel(picture, 2, light)[0] - 255 * lit[light]).abs().max() <= 1
        difference = (2 * (result[light] - lit[light]).abs()).clamp(max=1)
        assert (_panel(picture, 3, light)[0] - 255 * difference).abs().max() <= 1


def test_comparison_without_truth_shows_the_result_alone_and_holes_black() -> None:
    depth = DEPTH.clone()
    depth[..., 5:9, 5:9] = torch.nan
    picture = comparison(depth, None, RAYS, RGB, LOW)
    assert picture.shape == (3, 320, 640)
    assert int(_panel(picture, 0, 2)[:, 5:9, 5:9].max()) == 0
    assert int(_panel(picture, 0, 3).max()) == 0
    assert int(_panel(picture, 1, 3)[:, 5:8, 5:8].max()) == 0
