"""TGV upsampling, against another algorithm for the same minimum, and closed forms."""

import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.sparse.linalg import splu
from small_scenes import disparity_of, normal, plane, random_scene, sample_of, step

from dsr.geometry.camera import to_range
from dsr.methods.classical.tgv import TotalGeneralisedVariation


def _means(x, scale):
    height, width = x.shape
    return x.numpy().reshape(height // scale, scale, width // scale, scale).mean(axis=(1, 3))


def test_tensor_root_has_the_eigenvalues_of_the_paper():
    _, rgb = random_scene(6, 7)
    g = TotalGeneralisedVariation(sharpness=3.0, exponent=0.5).diffusion_tensors(rgb[None].double())
    matrices = torch.stack((g.uu, g.uv, g.uv, g.vv), dim=-1).reshape(-1, 2, 2)
    grey = (rgb.double() * torch.tensor([0.299, 0.587, 0.114]).double()[:, None, None]).sum(dim=0)
    slope = torch.zeros(2, 6, 7).double()
    slope[0, :, :-1], slope[1, :-1] = grey.diff(dim=1), grey.diff(dim=0)
    size = slope.norm(dim=0).flatten()
    torch.testing.assert_close(torch.linalg.eigvalsh(matrices)[:, 0], torch.exp(-3.0 * size.sqrt()))
    torch.testing.assert_close(torch.linalg.eigvalsh(matrices)[:, 1], torch.ones(42).double())


@pytest.mark.slow
@pytest.mark.parametrize(("data_weight", "holes"), [(None, True), (20.0, False)])
def test_objective_reaches_that_of_another_algorithm(data_weight, holes):
    """Within 1e-3, on 16 x 16 pixels with depth steps, slopes and noise: ADMM with exact solves."""
    rng = np.random.default_rng(3)
    truth = np.where(np.arange(16) > 6, 0.8, 0.2) + 0.02 * np.arange(16)[:, None] + rng.normal(0, 0.03, (16, 16))
    coarse = torch.from_numpy(_means(torch.from_numpy(truth), 2))[None, None]
    if holes:
        coarse[0, 0, 2:4, 3:5] = torch.nan
    rgb = torch.from_numpy(rng.uniform(0, 1, (1, 3, 16, 16)))
    method = TotalGeneralisedVariation(iterations=3000, tolerance=0.0, data_weight=data_weight, second=2.0)
    tensors = method.diffusion_tensors(rgb)
    reference, energy = _reference(coarse[0, 0].numpy(), tensors, method.first, method.second, data_weight)
    ours = energy(method.minimise(rgb, coarse, 2))
    assert ours == pytest.approx(reference, rel=1e-3)
    method.iterations = 20
    assert energy(method.minimise(rgb, coarse, 2)) > 1.01 * ours


def _reference(coarse, g, first, second, weight):
    """Return the least E for 2 x 2 blocks, and E: the alternating direction method of multipliers, sparse matrices."""
    height, width = (2 * n for n in coarse.shape)
    size = height * width
    du = sparse.csr_matrix(sparse.kron(sparse.eye(height), _difference(width)))
    dv = sparse.csr_matrix(sparse.kron(_difference(height), sparse.eye(width)))
    inside_u, inside_v = (sparse.diags((np.asarray(abs(d).sum(axis=1))[:, 0] > 0).astype(float)) for d in (du, dv))
    uu, uv, vv = (sparse.diags(each[0, 0].numpy().ravel()) for each in g)
    bent = sparse.bmat([[uu, uv], [uv, vv]]) @ sparse.bmat([[du, -inside_u, None], [dv, None, -inside_v]])
    none = sparse.csr_matrix((size, size))
    k = sparse.vstack((bent, sparse.bmat([[none, d, None] for d in (du, dv)] + [[none, None, d] for d in (du, dv)])))
    valid = np.isfinite(coarse).ravel()
    pair = sparse.csr_matrix(np.ones((1, 2)))
    means = sparse.kron(sparse.kron(sparse.eye(height // 2), pair), sparse.kron(sparse.eye(width // 2), pair))
    means = sparse.csr_matrix(means)[valid] / 4
    means = sparse.hstack((means, sparse.csr_matrix((means.shape[0], 2 * size))))
    d, heavy, rho = coarse.ravel()[valid], 1e7 if weight is None else weight, 20.0
    solve = splu((rho * k.T @ k + 4 * heavy * means.T @ means).tocsc()).solve
    z = w = np.zeros(k.shape[0])
    x = np.zeros(3 * size)
    for _ in range(1500):
        x = solve(rho * k.T @ (z - w) + 4 * heavy * means.T @ d)
        y = k @ x + w
        z = np.concatenate(
            (_shrunk(y[: 2 * size].reshape(2, -1), first / rho), _shrunk(y[2 * size :].reshape(4, -1), second / rho))
        )
        w = y - z

    def energy(x):
        y = k @ x
        lengths = [
            np.linalg.norm(part.reshape(n, -1), axis=0).sum() for part, n in ((y[: 2 * size], 2), (y[2 * size :], 4))
        ]
        return float(first * lengths[0] + second * lengths[1] + heavy / 2 * 4 * np.square(means @ x - d).sum())

    return energy(x), lambda found: energy(torch.cat((found.values, found.slopes), dim=1).numpy().ravel())


def _difference(count):
    matrix = sparse.diags([-np.ones(count), np.ones(count - 1)], [0, 1]).tolil()
    matrix[-1] = 0
    return matrix.tocsr()


def _shrunk(y, by):
    lengths = np.linalg.norm(y, axis=0)
    return (y * np.maximum(1 - by / np.maximum(lengths, 1e-300), 0)).ravel()


def test_tgv_fills_a_hole_in_a_plane_with_the_plane():
    disparity = plane()
    sample = sample_of(disparity)
    sample.depth_lr[:, 2:5, 4:7] = torch.nan
    fine = disparity_of(TotalGeneralisedVariation(iterations=2000, tolerance=1e-8)(sample), sample)
    assert (fine - disparity).abs().max() < 1e-3 * (disparity.max() - disparity.min())


def test_step_stays_sharp_along_a_photo_edge_and_is_smoother_without_one():
    disparity, rgb = step()
    sharp, smooth = (
        disparity_of(TotalGeneralisedVariation(iterations=600)(sample), sample)
        for sample in (sample_of(disparity, rgb), sample_of(disparity))
    )
    assert (sharp - disparity).abs().max() < 0.05
    assert (smooth - disparity).abs().max() > 0.5


@pytest.mark.parametrize(("scale", "size"), [(2, (10, 6)), (8, (8, 24)), (16, (16, 16))])
def test_block_means_are_the_input_without_a_data_weight(scale, size):
    sample = sample_of(*random_scene(*size), scale=scale)
    fine = disparity_of(TotalGeneralisedVariation(iterations=60)(sample), sample)
    coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity")[0].numpy() * scale
    np.testing.assert_allclose(_means(fine, scale), coarse, rtol=1e-9)


def test_automatic_weight_smooths_a_noisy_plane_and_reproduces_a_clean_one():
    flat = plane()
    means = torch.from_numpy(_means(flat, 4))
    noisy = means + 0.02 * (means.max() - means.min()) * normal(*means.shape)
    errors = []
    for weight in (None, "auto"):
        tgv = TotalGeneralisedVariation(iterations=300, data_weight=weight)
        errors.append(float((_upsampled(tgv, noisy) - flat).square().mean().sqrt()))
    assert errors[1] < 0.5 * errors[0]
    exact = TotalGeneralisedVariation(iterations=300, data_weight="auto")
    np.testing.assert_allclose(_means(_upsampled(exact, means), 4), means, atol=1e-6)


def _upsampled(tgv, lr):
    """Return the map of a grey photo that fits a low-resolution one."""
    height, width = lr.shape
    low, size = lr.min(), lr.max() - lr.min()
    rgb = torch.full((1, 3, 4 * height, 4 * width), 0.5, dtype=torch.float64)
    return tgv.minimise(rgb, ((lr - low) / size)[None, None], 4).values[0, 0] * size + low


def test_iteration_stops_at_convergence_and_reports_progress():
    reported = []
    sample = sample_of(plane())
    TotalGeneralisedVariation(iterations=5000)(sample, lambda done, most: reported.append((done, most)))
    assert reported == [(50, 5000), (5000, 5000)]
    coarse, photo = normal(1, 1, 4, 6).sigmoid(), normal(1, 3, 16, 24, seed=1).sigmoid()
    found = TotalGeneralisedVariation(iterations=5000, tolerance=2e-3).minimise(photo, coarse, 4)
    assert 50 * len(found.moved) == found.iterations < 5000
    assert found.moved[-1] < 2e-3 <= min(found.moved[:-1])
