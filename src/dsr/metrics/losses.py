"""Training losses: the paper's Lap_1 + w MSE_v, and L1 and MSE on depth. One value per image, masked, differentiable.

MSE_v is the metric's own kernel, :func:`dsr.metrics.functional.mse_v`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.utils.compute_device import in_own_precision

_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


@in_own_precision
def l1(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute difference over valid pixels, (B,), of two (B, 1, H, W) maps; NaN if none is valid.

    Args:
        prediction: (B, 1, H, W).
        target: (B, 1, H, W), NaN in holes.
        mask: (B, 1, H, W) bool, the pixels to compare; None for all.

    """
    difference, valid = _difference(prediction, target, mask)
    return difference.abs().sum(dim=(-3, -2, -1)) / valid.sum(dim=(-3, -2, -1))


@in_own_precision
def mse(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean squared difference over valid pixels, (B,); arguments as for :func:`l1`."""
    difference, valid = _difference(prediction, target, mask)
    return difference.square().sum(dim=(-3, -2, -1)) / valid.sum(dim=(-3, -2, -1))


@in_own_precision
def lap1(prediction: Tensor, target: Tensor, mask: Tensor | None = None, *, levels: int = 3) -> Tensor:
    """Return the Laplacian pyramid loss Lap_1, (B,), divided by the number of pixels.

    Bojanowski et al., *Optimizing the Latent Space of Generative Networks*, ICML 2018, eq. 2: the sum over levels j of
    2^(2 j) |L^j(x) - L^j(y)|_1. As level j has 2^(2 j) times fewer pixels, the sum divided by the number of pixels is
    the sum of the levels' *mean* absolute differences, which is returned. The last level is the
    pyramid's remaining low-pass. The pyramid is linear, so it is computed of the difference, which is 0 in holes; each
    level's mean weights a pixel by the fraction of its area that is valid.

    Args:
        prediction: (B, 1, H, W).
        target: (B, 1, H, W), NaN in holes.
        mask: (B, 1, H, W) bool, the pixels to compare; None for all.
        levels: number of levels, including the low-pass.

    Raises:
        ValueError: the maps are too small for that many levels.

    """
    if levels < 1 or min(target.shape[-2:]) < 3 * 2 ** (levels - 1):
        least, size = 3 * 2 ** max(levels - 1, 0), tuple(target.shape[-2:])
        raise ValueError(f"lap1: expected at least {least} pixels a side for {levels} levels, got {size}")
    difference, valid = _difference(prediction, target, mask)
    weight = valid.to(difference.dtype)
    total = difference.new_zeros(len(difference))
    for _ in range(levels - 1):
        level = _reduce(difference)
        detail = difference - _expand(level, difference.shape)
        total = total + _weighted_mean(detail.abs(), weight)
        difference, weight = level, _reduce(weight)
    return total + _weighted_mean(difference.abs(), weight)


def _difference(prediction: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return prediction - target, 0 where missing, and the valid mask."""
    valid = prediction.isfinite() & target.isfinite()
    if mask is not None:
        valid = valid & mask
    return torch.where(valid, prediction, 0) - torch.where(valid, target, 0), valid


def _weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum(dim=(-3, -2, -1)) / weight.sum(dim=(-3, -2, -1))


def _reduce(values: Tensor) -> Tensor:
    """Return the next, smaller level, (B, 1, H, W) -> (B, 1, ceil(H / 2), ceil(W / 2)); edge pixels are repeated."""
    return functional.conv2d(functional.pad(values, (2, 2, 2, 2), mode="replicate"), _kernel(values), stride=2)


def _expand(level: Tensor, shape: torch.Size) -> Tensor:
    """Interpolate a level to the shape of the one before: insert zeros between the pixels, blur, normalise."""
    height, width = shape[-2:]
    extra = (height - 2 * (level.shape[-2] - 1) - 1, width - 2 * (level.shape[-1] - 1) - 1)

    def blur(values: Tensor) -> Tensor:
        kernel = _kernel(level)
        return functional.conv_transpose2d(values, kernel, stride=2, padding=2, output_padding=extra)

    return blur(level) / blur(torch.ones_like(level))


def _kernel(like: Tensor) -> Tensor:
    taps = torch.tensor(_BINOMIAL, dtype=like.dtype, device=like.device)
    return torch.outer(taps, taps)[None, None]
