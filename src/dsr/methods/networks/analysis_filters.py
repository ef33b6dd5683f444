"""Learned analysis filters and their penalties, as in models of natural images and in unrolled networks.

A filter is a linear combination of basis filters, normalised to unit norm. Its penalty is a mixture of Lorentzians
(Student's t, as in Roth and Black, *Fields of Experts*, IJCV 2009) of fixed widths tau_j with ratios of 4,

    rho(z) = sum over j of a_j tau_j^2 / 2 log(1 + z^2 / tau_j^2).

An iteration applies its derivative, the *influence* rho'(z) = z sum over j of a_j / (1 + z^2 / tau_j^2). The a_j are
learned and can be negative: where rho decreases, responses are amplified, which sharpens edges.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

WIDTHS = tuple(1e-3 * 4**j for j in range(6))
"""tau_j, in the unit of the map: from 1/1000 to about 1."""


def plane_free_basis(size: int) -> Tensor:
    """Return an orthonormal basis of the filters with response 0 to planes, (size^2 - 3, size, size), float64.

    It consists of products of two discrete orthogonal (Gram) polynomials, one along v and one along u, ordered by
    degree, without 1, u and v.
    """
    return _products(size)[3:]


def zero_mean_basis(size: int) -> Tensor:
    """Return an orthonormal basis of the filters with response 0 to constants, (size^2 - 1, size, size), float64."""
    return _products(size)[1:]


def influence(z: Tensor, heights: Tensor) -> Tensor:
    """Return rho'(z).

    Args:
        z: (B, L, H, W) responses of L filters.
        heights: (L, 6) coefficients a_j of each filter's penalty.

    Returns:
        (B, L, H, W).

    """
    return z * _Mixture.apply(z, heights)


def penalty(z: Tensor, heights: Tensor) -> Tensor:
    """Return rho(z); see :func:`influence`."""
    total = torch.zeros_like(z)
    for j, width in enumerate(WIDTHS):
        total = total + heights[:, j, None, None] * (0.5 * width**2) * torch.log1p((z / width) ** 2)
    return total


class _Mixture(torch.autograd.Function):
    """The sum over j of a_j / (1 + z^2 / tau_j^2), (B, L, H, W); only z is kept for the backward pass."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, heights: Tensor) -> Tensor:
        """Return the sum."""
        ctx.save_for_backward(z, heights)
        squares, total = z * z, torch.zeros_like(z)
        for j, width in enumerate(WIDTHS):
            total.addcmul_((squares + width**2).reciprocal_(), heights[:, j, None, None], value=width**2)
        return total

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of the responses and of the a_j."""
        z, heights = ctx.saved_tensors
        squares, slope, sums = z * z, torch.zeros_like(z), []
        for j, width in enumerate(WIDTHS):
            inverse = (squares + width**2).reciprocal_()
            weighted = upstream[0] * inverse
            sums.append(width**2 * weighted.sum(dim=(0, 2, 3)))
            slope.addcmul_(weighted.mul_(inverse), heights[:, j, None, None], value=-2 * width**2)
        return slope.mul_(z), torch.stack(sums, dim=1)


@functools.cache
def _products(size: int) -> Tensor:
    """Return the products of orthonormal polynomials along v and u, by their degree, float64 (size^2, size, size)."""
    with torch.inference_mode(mode=False):  # the cached tensors may later be used with gradients
        x = torch.linspace(-1, 1, size, dtype=torch.float64)
        q, r = torch.linalg.qr(torch.stack([x**k for k in range(size)], dim=1))
        one = (q * r.diagonal().sign()).T  # (degree, size)
        pairs = sorted(((i, j) for i in range(size) for j in range(size)), key=lambda pair: (sum(pair), pair))
        return torch.stack([one[i][:, None] * one[j] for i, j in pairs])
