"""Normals and renderings, against closed forms, cross products of differences, and the protocol's literal values."""

import numpy as np
import pytest
import torch
from reference_metrics import LIGHTS as PROTOCOL_LIGHTS
from reference_metrics import Intrinsics, normals_of

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import comparison, depth_to_normals, lights, normal_mask, render, render_for_viewing

CAMERA = Camera(width=11, height=7, fx=9.0, fy=12.0, cx=4.3, cy=3.9)
PLANES = [(0.0, 0.0, -1.0), (0.3, -0.2, -1.0), (-0.5, 0.1, -0.8), (0.2, 0.6, -1.0)]


def _random(camera, seed=0):
    shape = (1, 1, camera.height, camera.width)
    return torch.from_numpy(np.random.default_rng(seed).uniform(1.0, 1.3, shape))


def _cross_product_normals(z):
    """Return the protocol's normals, (H, W, 3); NaN where a point that they need is."""
    rays = Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy).rays(*z.shape)
    return normals_of(z[..., None] * rays)


@pytest.mark.parametrize("normal", PLANES)
def test_depth_to_normals_gives_the_plane_normal_at_every_pixel(normal):
    expected = torch.tensor(normal, dtype=torch.float64)
    depth = -2 / torch.einsum("c,chw->hw", expected, CAMERA.rays())
    normals = depth_to_normals(depth[None, None], CAMERA.rays()[None])
    expected = (expected / expected.norm())[None, :, None, None].expand_as(normals)
    torch.testing.assert_close(normals, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [(7, 11), (2, 2), (2, 5), (6, 2)])
def test_depth_to_normals_equals_the_cross_product_of_forward_differences(size):
    camera = CAMERA.crop(0, 0, *size)
    depth = _random(camera)
    expected = torch.from_numpy(_cross_product_normals(depth[0, 0].numpy())).permute(2, 0, 1)[None]
    torch.testing.assert_close(depth_to_normals(depth, camera.rays()[None]), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("hole", [(3, 4), (0, 0), (6, 10), (6, 0), (0, 10), (5, 10), (6, 9)])
def test_normal_is_missing_exactly_where_one_of_its_pixels_is(hole):
    depth = _random(CAMERA)
    depth[0, 0, hole[0], hole[1]] = torch.nan
    known = np.isfinite(_cross_product_normals(depth[0, 0].numpy())).all(axis=-1)
    assert not known.all()
    assert np.array_equal(normal_mask(depth.isfinite())[0, 0].numpy(), known)
    normals = depth_to_normals(depth, CAMERA.rays()[None])
    assert np.array_equal(normals.isfinite().all(dim=1)[0].numpy(), known)


def test_float32_normals_keep_the_digits_of_tiny_differences():
    camera = Camera(11, 7, 1e5, 1e5, 5.0, 3.0)
    depth = 1 + 1e-6 * (_random(camera) - 1)  # float32 depths would differ by 0 or 1.2e-7
    exact = depth_to_normals(depth, camera.rays()[None])
    narrow = depth_to_normals(depth, camera.rays()[None], torch.float32)
    assert narrow.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), exact, rtol=0, atol=5e-7)


@pytest.mark.parametrize("size", [(1, 5), (5, 1)])
def test_map_of_one_row_or_column_is_refused(size):
    with pytest.raises(ValueError, match=f"at least 2 x 2 pixels, got \\({size[0]}, {size[1]}\\)"):
        depth_to_normals(torch.ones(1, 1, *size), torch.ones(1, 3, *size))


def test_lights_are_those_of_the_protocol():
    assert LIGHT_NAMES == ("e1", "e2", "e3", "e4")
    np.testing.assert_allclose(lights().numpy(), PROTOCOL_LIGHTS, rtol=0, atol=1e-15)
    np.testing.assert_allclose(PROTOCOL_LIGHTS[:3] @ PROTOCOL_LIGHTS[:3].T, np.eye(3), rtol=0, atol=1e-15)


def test_floor_is_lit_from_above_and_a_wall_on_the_right_from_the_left():
    floor, right_wall = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([-1.0, 0.0, 0.0])
    both = torch.stack((floor, right_wall))[:, :, None, None]
    floor_light, wall_light = render(both)[:, :, 0, 0].tolist()
    np.testing.assert_allclose(floor_light, [np.sqrt(2 / 3), 0, 0, 0], atol=1e-7)
    np.testing.assert_allclose(wall_light, [0, 1 / np.sqrt(2), 0, 0], atol=1e-7)


FLOOR, CEILING, WALL, FROM_LEFT, FROM_RIGHT = (0, -1, 0), (0, 1, 0), (0, 0, -1), (1, 0, 0), (-1, 0, 0)


def _brightness(*normals):
    vectors = torch.tensor(normals, dtype=torch.float64).T[None, :, None]
    return render_for_viewing(vectors / vectors.norm(dim=1, keepdim=True))[0, 0, 0].numpy()


def test_rendering_for_viewing_shows_a_tilt_of_two_degrees_on_floors_walls_and_ceilings():
    tilt = np.tan(np.deg2rad(2))
    for normal in (FLOOR, CEILING, WALL, FROM_LEFT, FROM_RIGHT):
        tilted = [np.array(normal) + tilt * np.eye(3)[axis] for axis in range(3) if not normal[axis]]
        steps = _brightness(normal, *map(tuple, tilted))
        assert np.abs(steps[1:] - steps[0]).max() > 1.5 / 255
    shades = _brightness(FLOOR, WALL, FROM_RIGHT, FROM_LEFT, CEILING)
    assert 0.1 < shades.min() < shades.max() < 0.9
    assert (np.diff(shades) < -0.04).all()  # floors are the brightest: the light is above


LARGE = Camera(width=160, height=144, fx=200.0, fy=200.0, cx=79.5, cy=71.5)
RAYS = LARGE.rays()[None]
RANDOM = torch.Generator().manual_seed(1)
DEPTH = 2 + torch.rand(1, 1, 144, 160, dtype=torch.float64, generator=RANDOM)
RGB = torch.rand(1, 3, 144, 160, generator=RANDOM)
LOW = DEPTH[..., ::4, ::4]


def _panel(picture, row, column):
    """Return a panel, (3, 144, 160), without the line of 16 pixels above it."""
    top = row * 160 + 16
    return picture[:, top : top + 144, column * 160 : (column + 1) * 160].int()


def test_comparison_shows_photo_input_result_and_truth_and_all_four_lights():
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
    alone = comparison(other.masked_fill(other == other[..., 5:6, 5:6], torch.nan), None, RAYS, RGB, LOW)
    assert alone.shape == (3, 320, 640)
    assert int(_panel(alone, 0, 2)[:, 5, 5].max()) == int(_panel(alone, 0, 3).max()) == 0  # holes, and no truth
