"""Learned dynamic guidance: an energy with learned filters, minimised for a few steps, each with its own parameters.

Gu, Zuo, Guo, Chen, Chen and Zhang, *Learning Dynamic Guidance for Depth Image Enhancement*, CVPR 2017, and TPAMI 2020.
A *stage* moves the map x towards the low-resolution map d, with block means A and bicubic upsampling U, and then down
the gradient of sum over l of w_l(g) rho_l(k_l y), the weighted responses of filters k_l, whose adjoint is k_l':

    y = x - fidelity * U(A x - d),    x = y - sum over l of k_l' (w_l(g) rho_l'(k_l y)),
    w_l(g) = exp(-sum over m of c_lm (b_m * g)^2),    rho_l(z) = sum over j of a_j tau_j^2 / 2 log(1 + z^2 / tau_j^2).

What differs, besides what docs/measurements/methods.md says: the k_l have unit norm; rho_l is a mixture of Lorentzians
(Roth and Black, IJCV 2009), the data step iterative back-projection (Irani and Peleg 1991), the form of w_l is ours.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.images import box_mean, upsample_linear_border
from dsr.methods.networks.network import NormalisedNetwork
from dsr.utils.compute_device import made_once

WIDTHS = tuple(1e-3 * 4**j for j in range(6))  # tau_j, in the unit of the map: from 1/1000 to about 1

# initial height of penalties; scale of the b_m; c_lm for m other than l; size of the data step
_HEIGHT, _CONTRAST, _SHARED, _FIDELITY = 0.05, 2.0, 0.02, 0.5
_BICUBIC = 2  # half width of the bicubic kernel in low-resolution pixels


@made_once
def polynomial_filters(size: int) -> Tensor:
    """Return an orthonormal basis of filters, ordered by degree: 1, u, v, ...; float64 (size^2, size, size).

    They are products of two discrete orthogonal (Gram) polynomials; those after the third have response 0 to planes.
    """
    x = torch.linspace(-1, 1, size, dtype=torch.float64)
    q, r = torch.linalg.qr(torch.stack([x**k for k in range(size)], dim=1))
    one = (q * r.diagonal().sign()).T  # (degree, size)
    pairs = sorted(((i, j) for i in range(size) for j in range(size)), key=lambda pair: (sum(pair), pair))
    return torch.stack([one[i][:, None] * one[j] for i, j in pairs])


def influence(z: Tensor, heights: Tensor) -> Tensor:
    """Return rho'(z) of the responses of L filters, (B, L, H, W), for the a_j of their penalties, (L, 6)."""
    return z * _Mixture.apply(z, heights)


class _Mixture(torch.autograd.Function):
    """The sum over j of a_j / (1 + z^2 / tau_j^2), (B, L, H, W); only z is kept for the backward pass."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, heights: Tensor) -> Tensor:
        ctx.save_for_backward(z, heights)
        squares, total = z * z, torch.zeros_like(z)
        for j, width in enumerate(WIDTHS):
            total.addcmul_((squares + width**2).reciprocal_(), heights[:, j, None, None], value=width**2)
        return total

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor]:
        z, heights = ctx.saved_tensors
        squares, slope, sums = z * z, torch.zeros_like(z), []
        for j, width in enumerate(WIDTHS):
            inverse = (squares + width**2).reciprocal_()
            weighted = upstream[0] * inverse
            sums.append(width**2 * weighted.sum(dim=(0, 2, 3)))
            slope.addcmul_(weighted.mul_(inverse), heights[:, j, None, None], value=-2 * width**2)
        return slope.mul_(z), torch.stack(sums, dim=1)


class Stage(nn.Module):
    """One step from a map to a better one, with as many filters k_l as b_m, of ``size`` pixels."""

    def __init__(self, filters: int, size: int) -> None:
        super().__init__()
        self.size = size
        self.analysis = nn.Parameter(torch.eye(filters, size**2 - 3))
        self.heights = nn.Parameter(torch.full((filters, len(WIDTHS)), _HEIGHT))
        first = torch.eye(filters, size**2 - 1)[:, None].expand(-1, 3, -1)
        self.guidance = nn.Parameter(_CONTRAST / 3 * first)
        self.mixing = nn.Parameter(torch.eye(filters) + _SHARED)
        self.fidelity = nn.Parameter(torch.tensor(_FIDELITY))

    def weights(self, rgb: Tensor) -> Tensor:
        """Return the w_l of photos (B, 3, H, W), (B, L, H - size + 1, W - size + 1)."""
        filters = torch.einsum("lcb,bij->lcij", self.guidance.to(rgb), polynomial_filters(self.size)[1:].to(rgb))
        squares = functional.conv2d(rgb, filters).square()
        return torch.exp(-functional.conv2d(squares, self.mixing.to(rgb).abs()[..., None, None]))

    def forward(self, x: Tensor, lr: Tensor, rgb: Tensor) -> Tensor:
        """Return the next map, (B, 1, H, W): a step towards the block means ``lr``, then one down the gradient of E."""
        scale = x.shape[-1] // lr.shape[-1]
        x = x - self.fidelity.to(x) * upsample_linear_border(box_mean(x, scale) - lr, scale)
        if min(x.shape[-2:]) < self.size:
            return x
        unit = functional.normalize(self.analysis.to(x), dim=1)
        filters = torch.einsum("lb,bij->lij", unit, polynomial_filters(self.size)[3:].to(x))[:, None]  # the k_l
        heights = self.heights.to(x) / len(self.heights)  # for a step size of 1
        forces = self.weights(rgb) * influence(functional.conv2d(x, filters), heights)
        return x - functional.conv_transpose2d(forces, filters)


class DynamicGuidance(NormalisedNetwork):
    """The network, which computes in float32, or in float64 where the weights are."""

    def __init__(self, scale: int, stages: int = 5, filters: int = 24, size: int = 7) -> None:
        super().__init__()
        check_scale(scale)
        if stages < 1 or size < 3:
            raise ValueError(f"model: expected stages of at least 1 and a size of at least 3, got {stages} and {size}")
        if not 1 <= filters <= size**2 - 3:
            raise ValueError(f"filters: expected 1 to {size**2 - 3} of size {size}, got {filters}")
        self.scale, self.filters, self.size = scale, filters, size
        self.stages = nn.ModuleList(Stage(filters, size) for _ in range(stages))
        # of the initial upsampling and, for each stage, of an upsampling, a filter and its adjoint
        self.receptive_field_radius = _BICUBIC + stages * (_BICUBIC + math.ceil((size - 1) / scale))

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"scale": self.scale, "stages": len(self.stages), "filters": self.filters, "size": self.size}

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Return normalised disparity (B, 1, H, W) for (B, 3, H, W) and (B, 1, h, w); see the base class."""
        dtype = torch.promote_types(next(self.parameters()).dtype, torch.float32)
        with torch.autocast(rgb.device.type, enabled=False):
            guide, lr = rgb.to(dtype), values.to(dtype)
            x = upsample_linear_border(lr, self.scale)
            for stage in self.stages:
                x = stage(x, lr, guide)
        return x.to(values.dtype)
