"""The rendering equation: against the geometry's normals, derivatives, lighting."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.methods.classical.srfs_admm import (
    compute_area,
    compute_shading,
    compute_surface,
    conjugate_gradients,
    fit_lighting,
    linearise_photometry,
)

LIGHT = torch.tensor([[[0.3, -0.4, -0.6, 0.2], [0.2, -0.5, -0.5, 0.1], [0.4, -0.2, -0.4, 0.3]]]).double()


def _camera(size: int) -> Camera:
    return Camera(size, size, 1.1 * size, 1.2 * size, 0.4 * size - 0.5, 0.6 * size - 0.5)


def _theta(camera: Camera) -> tuple[Tensor, Tensor]:
    """Return a smooth surface's slopes and depth, (1, 3, H, W), from forward differences, and its depth."""
    rays = camera.rays()
    depth = 2 + 0.3 * torch.sin(3 * rays[0]) * torch.cos(2 * rays[1]) + 0.2 * rays[0]
    slopes = [
        focal * torch.cat((depth.diff(dim=dim), depth.diff(dim=dim).narrow(dim, -1, 1)), dim)
        for dim, focal in ((1, camera.fx), (0, camera.fy))
    ]
    return torch.stack((*slopes, depth))[None], depth[None, None]


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def _mixed_theta() -> tuple[Tensor, Tensor]:
    theta = _random(1, 3, 3, 4)
    theta[:, 2] = 2 + 0.2 * theta[:, 2]
    return theta, Camera(4, 3, 5.0, 6.0, 1.2, 0.9).rays()[None]


def test_rendering_converges_to_that_of_the_geometrys_normals() -> None:
    errors = []
    for size in (64, 128):
        camera = _camera(size)
        theta, depth = _theta(camera)
        rays = camera.rays()[None]
        normals = depth_to_normals(depth, rays)
        expected = torch.einsum("bck,bkhw->bchw", LIGHT, torch.cat((normals, torch.ones_like(normals[:, :1])), dim=1))
        errors.append(float((compute_shading(compute_surface(theta, rays).normals, LIGHT) - expected).abs().max()))
    assert errors[0] < 0.01
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.1)  # of differences taken to one side


def test_area_is_that_of_the_back_projected_pixels() -> None:
    camera = _camera(256)
    theta, depth = _theta(camera)
    rays = camera.rays()[None]
    points = (depth * rays)[0]
    along_u, along_v = points.diff(dim=2)[:, :-1], points.diff(dim=1)[:, :, :-1]
    expected = torch.linalg.cross(along_u, along_v, dim=0).norm(dim=0)
    ours = compute_area(theta, compute_surface(theta, rays))[0, 0, :-1, :-1] / (camera.fx * camera.fy)
    torch.testing.assert_close(ours, expected, rtol=0.02, atol=0)
    assert float(ours.sum()) == pytest.approx(float(expected.sum()), rel=2e-3)


def test_photometry_has_its_stated_derivatives() -> None:
    theta, rays = _mixed_theta()
    albedo, rgb = _random(1, 3, 3, 4, seed=1).abs(), _random(1, 3, 3, 4, seed=2)

    def residual(theta: Tensor) -> Tensor:
        return albedo * compute_shading(compute_surface(theta, rays).normals, LIGHT) - rgb

    theta.requires_grad_()
    assert torch.autograd.gradcheck(residual, (theta,))
    seen = linearise_photometry(rgb, albedo, LIGHT, compute_surface(theta, rays), rays)
    torch.testing.assert_close(seen.residual, residual(theta))
    for channel in range(3):
        (slope,) = torch.autograd.grad(residual(theta)[:, channel].sum(), theta)
        torch.testing.assert_close(seen.slopes[:, channel], slope)


def test_light_is_recovered_exactly_from_a_photo_without_noise() -> None:
    theta, rays = _mixed_theta()
    normals = compute_surface(theta, rays).normals
    albedo = _random(1, 3, 3, 4, seed=1).abs()
    rgb = albedo * compute_shading(normals, LIGHT)
    inside = torch.ones(1, 1, 3, 4).double()
    torch.testing.assert_close(fit_lighting(rgb, albedo, normals, inside), LIGHT)
    rgb[..., 1:3, 2] = 0.7
    inside[..., 1:3, 2] = 0
    torch.testing.assert_close(fit_lighting(rgb, albedo, normals, inside), LIGHT)


def test_light_on_a_flat_wall_is_the_smallest_that_explains_it() -> None:
    normals = torch.tensor([0.0, 0.0, -1.0]).double()[:, None, None].expand(1, 3, 4, 5)
    albedo = torch.ones(1, 1, 4, 5).double()
    light = fit_lighting(0.6 * albedo, albedo, normals, torch.ones_like(albedo))
    torch.testing.assert_close(light, torch.tensor([[[0.0, 0.0, -0.3, 0.3]]]).double())


def _systems(batch: int, size: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(0)
    root = torch.from_numpy(rng.normal(size=(batch, size, size)))
    return root @ root.mT + torch.eye(size).double(), torch.from_numpy(rng.normal(size=(batch, size)))


def _times(matrices: Tensor, x: Tensor) -> Tensor:
    return (matrices @ x[..., None])[..., 0]


def test_conjugate_gradients_equal_a_direct_solver_for_each_element_of_a_batch() -> None:
    matrices, right = _systems(3, 12)
    found = conjugate_gradients(
        lambda x: _times(matrices, x), right, torch.zeros_like(right), iterations=100, tolerance=1e-12
    )
    torch.testing.assert_close(found.values, torch.linalg.solve(matrices, right))
    assert found.residual <= 1e-12


def test_conjugate_gradients_need_at_most_one_step_per_distinct_eigenvalue() -> None:
    diagonal = torch.tensor([1.0, 1, 4, 4, 9, 9]).double()
    right = torch.arange(1.0, 7.0).double()[None]
    found = conjugate_gradients(lambda x: diagonal * x, right, torch.zeros_like(right), iterations=100, tolerance=1e-10)
    assert found.iterations == 3
    torch.testing.assert_close(found.values, right / diagonal)


def test_solved_element_is_unchanged_while_another_goes_on() -> None:
    matrices, right = _systems(2, 8)
    right[0] = 0
    found = conjugate_gradients(
        lambda x: _times(matrices, x), right, torch.zeros_like(right), iterations=50, tolerance=1e-12
    )
    assert torch.equal(found.values[0], torch.zeros(8).double())
    torch.testing.assert_close(found.values[1], torch.linalg.solve(matrices[1], right[1]))
