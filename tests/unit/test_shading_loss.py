"""The shading loss: light and albedo against least squares of numpy and scipy, and its zero at the truth."""

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.sparse import linalg
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.metrics.functional import SurfacePair
from dsr.training.objective import estimate_albedo, estimate_light, harmonics, integrate, shading_loss

CAMERA = Camera(width=18, height=16, fx=20.0, fy=22.0, cx=8.0, cy=7.0)
LIGHT = torch.tensor([0.5, -0.1, -0.2, 0.1, 0.03, 0.02, 0.01, -0.03, 0.02], dtype=torch.float64)


def _bumps(amplitude=0.1, phase=0.0):
    """Return a bumpy surface, (1, 1, 16, 18)."""
    v, u = torch.meshgrid(torch.arange(16).double(), torch.arange(18).double(), indexing="ij")
    return (2 + amplitude * torch.sin(0.4 * u + phase) * torch.cos(0.3 * v))[None, None]


def _normals(depth):
    return depth_to_normals(depth, CAMERA.rays()[None])


def _photo(depth):
    """Return the grey photo of a surface with albedo 1 under ``LIGHT``."""
    return torch.einsum("b,nbhw->nhw", LIGHT, harmonics(_normals(depth)))[:, None].expand(-1, 3, -1, -1)


def test_harmonics_are_orthogonal_over_the_sphere():
    random = np.random.default_rng(0)
    z, azimuth = random.uniform(-1, 1, 400_000), random.uniform(0, 2 * np.pi, 400_000)
    side = np.sqrt(1 - z**2)
    normals = torch.from_numpy(np.stack((side * np.cos(azimuth), side * np.sin(azimuth), z)))[None, :, None]
    basis = functional.normalize(harmonics(normals)[0, :, 0], dim=1)
    torch.testing.assert_close(basis @ basis.T, torch.eye(9).double(), rtol=0, atol=0.01)


def test_light_is_the_least_squares_solution_over_valid_pixels():
    random = np.random.default_rng(1)
    normals = _normals(_bumps())
    intensity, albedo = (torch.from_numpy(random.uniform(0.2, 1, (1, 1, 16, 18))) for _ in range(2))
    valid = torch.from_numpy(random.uniform(size=(1, 1, 16, 18)) > 0.3)
    x, y, z = (each.numpy() for each in normals[0])
    basis = np.stack((np.ones_like(x), y, z, x, x * y, y * z, 2 * z**2 - x**2 - y**2, z * x, x**2 - y**2), axis=-1)
    kept = valid[0, 0].numpy()
    rows = np.vstack((albedo[0, 0].numpy()[kept][:, None] * basis[kept], 1e-2 * np.eye(9)))
    values = np.concatenate((intensity[0, 0].numpy()[kept], np.zeros(9)))
    expected = np.linalg.lstsq(rows, values, rcond=None)[0]
    found = estimate_light(normals, intensity, albedo, valid)[0]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=1e-7)


def test_loss_is_zero_for_the_surface_and_light_of_the_photo():
    truth, rays = _bumps(), CAMERA.rays()[None]
    photo = _photo(truth)
    assert 0 < float(photo.min()) < float(photo.max()) < 1
    assert float(photo.std()) > 0.02
    assert float(shading_loss(SurfacePair(truth, truth, rays), photo)) < 1e-7
    assert float(shading_loss(SurfacePair(_bumps(phase=2), truth, rays), photo)) > 1e-3


def test_loss_leaves_out_holes_and_is_nan_without_a_valid_normal():
    truth, rays = _bumps(), CAMERA.rays()[None]
    photo, pierced = _photo(truth), truth.clone()
    pierced[..., 5:8, 3:9] = torch.nan
    assert float(shading_loss(SurfacePair(truth, pierced, rays), photo)) < 1e-7
    assert bool(shading_loss(SurfacePair(truth, torch.full_like(truth, torch.nan), rays), photo).isnan())


def test_gradient_agrees_with_finite_differences():
    camera = Camera(width=5, height=4, fx=6.0, fy=6.0, cx=2.0, cy=1.5)
    generator = torch.Generator().manual_seed(2)
    truth, depth = (2 + 0.2 * torch.rand((1, 1, 4, 5), generator=generator, dtype=torch.float64) for _ in range(2))
    photo = 0.3 + 0.4 * torch.rand((1, 3, 4, 5), generator=generator, dtype=torch.float64)
    depth.requires_grad_()

    def loss(depth):
        return shading_loss(SurfacePair(depth, truth, camera.rays()[None]), photo)

    assert torch.autograd.gradcheck(loss, (depth,), eps=1e-7, atol=1e-5)


def test_integration_of_contradicting_differences_is_the_least_squares_solution():
    height, width = 4, 5
    random = np.random.default_rng(4)
    along_u, along_v = random.normal(size=(height, width - 1)), random.normal(size=(height - 1, width))
    d_u, d_v = (sparse.diags([-1.0, 1.0], [0, 1], shape=(n - 1, n)) for n in (width, height))
    differences = sparse.vstack((sparse.kron(sparse.eye(height), d_u), sparse.kron(d_v, sparse.eye(width))))
    expected = linalg.lsqr(differences, np.concatenate((along_u.ravel(), along_v.ravel())), atol=1e-14, btol=1e-14)[0]
    found = integrate(torch.from_numpy(along_u)[None, None], torch.from_numpy(along_v)[None, None])
    np.testing.assert_allclose(found[0, 0].numpy(), (expected - expected.mean()).reshape(height, width), atol=1e-9)


@pytest.mark.parametrize("colour", [(0.4, 0.4, 0.4), (0.8, 0.5, 0.2)])
def test_albedo_has_the_edges_of_the_photo_and_none_of_its_slopes(colour):
    paint = torch.ones(1, 3, 24, 24, dtype=torch.float64)
    paint[..., 6:18, 8:20] = torch.tensor(colour, dtype=torch.float64).view(3, 1, 1)
    shading = torch.linspace(0.3, 0.9, 24, dtype=torch.float64)
    albedo = estimate_albedo(paint * shading)
    inside, outside = albedo[..., 7:17, 9:19], albedo[..., :5, :]
    luma = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    assert float(inside.mean() / outside.mean()) == pytest.approx(luma, rel=0.1)
    assert float(inside.std() / inside.mean()) < 0.05
    assert float(albedo.mean()) == pytest.approx(1, rel=1e-6)
