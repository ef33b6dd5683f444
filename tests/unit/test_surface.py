"""Normals, against closed forms and against cross products of differences of points."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals, normal_mask
from dsr.metrics.functional import SurfacePair, mse_v

CAMERA = Camera(width=11, height=7, fx=9.0, fy=12.0, cx=4.3, cy=3.9)
PLANES = [(0.0, 0.0, -1.0), (0.3, -0.2, -1.0), (-0.5, 0.1, -0.8), (0.2, 0.6, -1.0)]


def _plane(camera: Camera, normal: tuple[float, float, float], offset: float = -2.0) -> Tensor:
    """Return the depth of the plane n . P = offset, (1, 1, H, W)."""
    facing = torch.einsum("c,chw->hw", torch.tensor(normal, dtype=torch.float64), camera.rays())
    return (offset / facing)[None, None]


def _random(camera: Camera, seed: int = 0) -> Tensor:
    shape = (1, 1, camera.height, camera.width)
    return torch.from_numpy(np.random.default_rng(seed).uniform(1.0, 1.3, shape))


def _cross_product_normals(z: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the protocol's normals, (H, W, 3), straight from its words; NaN where a point that they need is."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    points = np.stack((z * (u - camera.cx) / camera.fx, z * (v - camera.cy) / camera.fy, z), axis=-1)
    along_u = np.diff(points, axis=1)
    along_u = np.concatenate((along_u, along_u[:, -1:]), axis=1)
    along_v = np.diff(points, axis=0)
    along_v = np.concatenate((along_v, along_v[-1:]), axis=0)
    normals = np.cross(along_v, along_u)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _sphere_error(camera: Camera) -> float:
    """Return the largest error of the normals of a sphere that fills the picture."""
    centre, radius = torch.tensor([0.1, -0.05, 3.0], dtype=torch.float64)[:, None, None], 1.0
    rays = camera.rays()
    a, b, c = (rays * rays).sum(0), (rays * centre).sum(0), (centre * centre).sum() - radius**2
    depth = ((b - (b * b - a * c).sqrt()) / a)[None]
    truth = (depth * rays - centre) / radius
    return float((depth_to_normals(depth[None], rays[None])[0] - truth).abs().max())


@pytest.mark.parametrize("normal", PLANES)
def test_depth_to_normals_gives_the_plane_normal_at_every_pixel(normal: tuple[float, float, float]) -> None:
    normals = depth_to_normals(_plane(CAMERA, normal), CAMERA.rays()[None])
    expected = torch.tensor(normal, dtype=torch.float64)
    expected = (expected / expected.norm())[None, :, None, None].expand_as(normals)
    torch.testing.assert_close(normals, expected, rtol=0, atol=1e-9)


def test_depth_to_normals_converges_on_a_sphere_with_first_order() -> None:
    errors = [_sphere_error(Camera(32, 32, 160.0, 160.0, 15.5, 15.5).rescale(n, n)) for n in (32, 64, 128)]
    assert errors[0] < 0.05
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.15)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize("size", [(7, 11), (2, 2), (2, 5), (6, 2)])
def test_depth_to_normals_equals_the_cross_product_of_forward_differences(size: tuple[int, int]) -> None:
    camera = CAMERA.crop(0, 0, *size)
    depth = _random(camera)
    expected = torch.from_numpy(_cross_product_normals(depth[0, 0].numpy(), camera)).permute(2, 0, 1)[None]
    torch.testing.assert_close(depth_to_normals(depth, camera.rays()[None]), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("hole", [(3, 4), (0, 0), (6, 10), (6, 0), (0, 10), (5, 10), (6, 9)])
def test_normal_is_missing_exactly_where_one_of_its_pixels_is(hole: tuple[int, int]) -> None:
    depth = _random(CAMERA)
    depth[0, 0, hole[0], hole[1]] = torch.nan
    known = np.isfinite(_cross_product_normals(depth[0, 0].numpy(), CAMERA)).all(axis=-1)
    assert not known.all()
    assert np.array_equal(normal_mask(depth.isfinite())[0, 0].numpy(), known)
    normals = depth_to_normals(depth, CAMERA.rays()[None])
    assert np.array_equal(normals.isfinite().all(dim=1)[0].numpy(), known)


def test_float32_normals_keep_the_digits_of_tiny_differences() -> None:
    camera = Camera(11, 7, 1e5, 1e5, 5.0, 3.0)
    depth = 1 + 1e-6 * (_random(camera) - 1)  # float32 depths would differ by 0 or 1.2e-7
    exact = depth_to_normals(depth, camera.rays()[None])
    narrow = depth_to_normals(depth, camera.rays()[None], torch.float32)
    assert narrow.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), exact, rtol=0, atol=5e-7)


@pytest.mark.parametrize("size", [(1, 5), (5, 1)])
def test_map_of_one_row_or_column_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"at least 2 x 2 pixels, got \\({size[0]}, {size[1]}\\)"):
        depth_to_normals(torch.ones(1, 1, *size), torch.ones(1, 3, *size))


@pytest.mark.parametrize("where", ["mask", "target", "prediction"])
def test_gradient_is_zero_at_holes_and_finite_everywhere(where: str) -> None:
    camera = Camera(6, 5, 5.0, 6.0, 1.2, 0.9)
    target, depth = _random(camera, 3), _random(camera, 4)
    mask = torch.ones(1, 1, 5, 6, dtype=torch.bool)
    if where == "mask":
        mask[0, 0, 2, 3] = False
    else:
        (target if where == "target" else depth)[0, 0, 2, 3] = torch.nan
    depth.requires_grad_()
    mse_v(SurfacePair(depth, target, camera.rays()[None], mask)).sum().backward()
    assert depth.grad is not None
    assert bool(depth.grad.isfinite().all())
    assert depth.grad[0, 0, 2, 3] == 0
    assert depth.grad[0, 0, 1, 1] != 0
