"""Two-dimensional discrete cosine transforms of types II and III, each by one real Fourier transform.

Makhoul, *A fast cosine transform in one and two dimensions*, IEEE Transactions on Acoustics, Speech, and Signal
Processing 28(1), 1980. Along each axis, the values with even indices are put first and those with odd indices follow in
reverse order. With V the Fourier transform of the result, a(k) = exp(-i pi k / 2H) and b(l) = exp(-i pi l / 2W), the
cosine transform is 2 Re T for T(k, l) = b(l) (a(k) V(k, l) + conj(a(k)) V(-k, l)), and at W - l it is -2 Im T(k, l), so
half of the spectrum is enough. The transforms are not normalised, as those of ``scipy.fft`` by default.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def dct2(x: Tensor) -> Tensor:
    """Return the type II transform of the last two axes of a real tensor, (..., H, W).

    The coefficient (k, l) is 4 sum x(i, j) cos(pi k (2i + 1) / 2H) cos(pi l (2j + 1) / 2W).
    """
    height, width = x.shape[-2:]
    half = width // 2 + 1
    spectrum = torch.fft.rfft2(x[..., _order(height, x)[:, None], _order(width, x)])  # (..., H, W // 2 + 1)
    spectrum = spectrum * (2 * _phase(height, height, x)[:, None] * _phase(width, half, x))
    # conj(a(k)) V(-k, l), since a(H - k) = -i conj(a(k))
    mirrored = torch.cat((spectrum[..., :1, :], 1j * spectrum[..., 1:, :].flip(-2)), dim=-2)
    packed = spectrum + mirrored
    return torch.cat((packed.real, -packed.imag[..., 1 : (width + 1) // 2].flip(-1)), dim=-1)


def idct2(coefficients: Tensor) -> Tensor:
    """Return the inverse of :func:`dct2`, the type III transform divided by 4HW, for (..., H, W)."""
    height, width = coefficients.shape[-2:]
    half = width // 2 + 1
    reverse = -coefficients[..., width - half + 1 :].flip(-1)
    imaginary = torch.cat((torch.zeros_like(coefficients[..., :1]), reverse), dim=-1)
    packed = torch.complex(coefficients[..., :half], imaginary)
    # T(H - k, l) for k > 0; there is no such term for k = 0
    mirrored = torch.cat((torch.zeros_like(packed[..., :1, :]), packed[..., 1:, :].flip(-2)), dim=-2)
    phase = _phase(height, height, packed)[:, None] * _phase(width, half, packed)
    spectrum = (packed - 1j * mirrored) * (phase.conj() / 4)
    shuffled = torch.fft.irfft2(spectrum, s=(height, width))
    rows, columns = (_order(size, shuffled).argsort() for size in (height, width))
    return shuffled[..., rows[:, None], columns]


def laplacian_eigenvalues(height: int, width: int, like: Tensor) -> Tensor:
    """Return the eigenvalues, none positive, of the five-point Laplacian in the basis of :func:`dct2`, (H, W)."""
    rows, columns = (
        torch.cos(math.pi / size * torch.arange(size, dtype=torch.float64, device=like.device))
        for size in (height, width)
    )
    return (2 * (rows[:, None] + columns - 2)).to(like)


def _order(size: int, like: Tensor) -> Tensor:
    """Return the indices of an axis, the even ones first and then the odd ones in reverse order, (size,)."""
    indices = torch.arange(size, device=like.device)
    return torch.cat((indices[::2], indices[1::2].flip(0)))


def _phase(size: int, count: int, like: Tensor) -> Tensor:
    """Return exp(-i pi k / 2 size) for k < count, (count,), in the precision of ``like``."""
    angle = torch.arange(count, dtype=torch.float64, device=like.device) * (-math.pi / (2 * size))
    return torch.polar(torch.ones_like(angle), angle).to(like.dtype.to_complex())
