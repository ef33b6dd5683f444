"""The cosine transforms and DCTNet."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
import scipy.ndimage
import torch

from dsr.methods.networks.dct import dct2, idct2
from dsr.methods.networks.peers import dctnet
from dsr.methods.networks.peers.dctnet import DCTNet, laplacian, transfer_edges

SIZES = [(4, 6), (5, 7), (5, 4), (6, 5), (1, 3), (4, 1), (1, 2), (1, 1)]


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("size", SIZES)
def test_dct2_and_idct2_are_scipys_transforms(size) -> None:
    x = random(2, 3, *size)
    np.testing.assert_allclose(dct2(x).numpy(), scipy.fft.dctn(x.numpy(), axes=(-2, -1)), atol=1e-13)
    np.testing.assert_allclose(idct2(x).numpy(), scipy.fft.idctn(x.numpy(), axes=(-2, -1)), atol=1e-13)


def test_dct2_of_float32_is_float32_and_accurate() -> None:
    x = random(2, 48, 50, dtype=torch.float32)
    coefficients = dct2(x)
    assert coefficients.dtype == torch.float32
    expected = scipy.fft.dctn(x.double().numpy(), axes=(-2, -1))
    np.testing.assert_allclose(coefficients.numpy(), expected, atol=1e-6 * np.abs(expected).max())
    torch.testing.assert_close(idct2(coefficients), x, atol=2e-6, rtol=0)


@pytest.mark.parametrize("size", [(3, 4), (4, 3)])
def test_dct2_and_idct2_have_the_right_gradients(size) -> None:
    x = random(*size).requires_grad_()
    assert torch.autograd.gradcheck(dct2, (x,), fast_mode=True)
    assert torch.autograd.gradcheck(idct2, (x,), fast_mode=True)


def test_laplacian_is_scipys_convolution_with_a_mirrored_border() -> None:
    x = random(2, 3, 5, 4)
    kernel = np.ones((3, 3))
    kernel[1, 1] = -8
    expected = scipy.ndimage.convolve(x.numpy(), kernel[None, None] / 16, mode="mirror")
    np.testing.assert_allclose(laplacian(x).numpy(), expected, atol=1e-14)


def test_transfer_edges_solves_the_linear_system() -> None:
    height, width = 5, 6
    depth, guide, weight = (random(2, 3, height, width, seed=seed) for seed in range(3))
    strength = torch.tensor([0.1, 1.0, 30.0], dtype=torch.float64).view(1, 3, 1, 1)
    # the Laplacian of four neighbours, without those outside
    second = [np.diag(np.r_[-1, -2 * np.ones(n - 2), -1]) + np.eye(n, k=1) + np.eye(n, k=-1) for n in (height, width)]
    four = np.kron(second[0], np.eye(width)) + np.kron(np.eye(height), second[1])
    right = depth + strength * laplacian(weight * laplacian(guide))
    solved = transfer_edges(depth, guide, weight, strength)
    for channel, factor in enumerate(strength.flatten()):
        matrix = np.eye(height * width) + float(factor) * four @ four
        expected = np.linalg.solve(matrix, right[:, channel].reshape(2, -1).numpy().T).T
        np.testing.assert_allclose(solved[:, channel].reshape(2, -1).numpy(), expected, atol=1e-12)


def test_transfer_edges_has_the_right_gradients() -> None:
    inputs = [random(1, 2, 3, 4, seed=seed).requires_grad_() for seed in range(3)]
    strength = random(1, 2, 1, 1, seed=3).exp().requires_grad_()
    assert torch.autograd.gradcheck(transfer_edges, (*inputs, strength), fast_mode=True)


def test_transfer_edges_does_not_depend_on_the_chunks(monkeypatch) -> None:
    inputs = [random(2, 5, 4, 6, seed=seed) for seed in range(3)]
    strength = random(1, 5, 1, 1, seed=3).exp()
    whole = transfer_edges(*inputs, strength)
    monkeypatch.setattr(dctnet, "_CHUNK", 2 * 4 * 6)
    torch.testing.assert_close(transfer_edges(*inputs, strength), whole)


def test_dctnet_shares_half_of_the_kernels() -> None:
    assert sum(each.numel() for each in DCTNet(4).parameters()) == 482865 - 16 * 16 * 9 - 16  # the file's, less unused


@pytest.mark.parametrize("size", [(16, 23), (9, 12)])
def test_dctnet_trains(size) -> None:
    torch.manual_seed(0)
    net = DCTNet(4)
    rgb, values = torch.rand(2, 3, *size), torch.rand(2, 1, *size)
    refined = net(rgb, values)
    assert refined.shape == values.shape
    refined.sub(values).square().mean().backward()
    missing = [name for name, each in net.named_parameters() if each.grad is None or not each.grad.isfinite().all()]
    assert not missing
