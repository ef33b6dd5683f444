"""Training losses: the paper's Lap_1 + w MSE_v, and plain ones on depth. One value per image, masked, differentiable.

MSE_v is the metric's own kernel, :func:`dsr.metrics.functional.mse_v`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def l1(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute difference over known pixels, (B,), of two (B, 1, H, W) maps; NaN where none is known.

    Args:
        prediction: (B, 1, H, W).
        target: likewise; NaN is a hole.
        mask: (B, 1, H, W) bool, the pixels to look at; None for all.

    """
    difference, known = _difference(prediction, target, mask)
    return difference.abs().sum(dim=(-3, -2, -1)) / known.sum(dim=(-3, -2, -1))


def mse(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean squared difference over known pixels, (B,); arguments as for :func:`l1`."""
    difference, known = _difference(prediction, target, mask)
    return difference.square().sum(dim=(-3, -2, -1)) / known.sum(dim=(-3, -2, -1))


def lap1(prediction: Tensor, target: Tensor, mask: Tensor | None = None, *, levels: int = 3) -> Tensor:
    """Return the Laplacian pyramid loss Lap_1, (B,), divided by the number of pixels.

    Bojanowski et al., *Optimizing the Latent Space of Generative Networks*, ICML 2018, eq. 2: the sum over levels j of
    2^(2 j) |L^j(x) - L^j(y)|_1. As level j has 2^(2 j) times fewer pixels, the sum divided by the number of pixels is
    the plain sum of the levels' *mean* absolute differences, and that is what is returned. The last level is the
    pyramid's remaining low-pass. The pyramid is linear, so it is taken of the difference, which is 0 in holes; each
    level's mean weighs its pixels by the share of theirs that is known.

    Args:
        prediction: (B, 1, H, W).
        target: likewise; NaN is a hole.
        mask: (B, 1, H, W) bool, the pixels to look at; None for all.
        levels: of the pyramid, the low-pass included.

    Raises:
        ValueError: the maps are too small for that many levels.

    """
    if levels < 1 or min(target.shape[-2:]) < 3 * 2 ** (levels - 1):
        least, size = 3 * 2 ** max(levels - 1, 0), tuple(target.shape[-2:])
        raise ValueError(f"lap1: expected at least {least} pixels a side for {levels} levels, got {size}")
    difference, known = _difference(prediction, target, mask)
    weight = known.to(difference.dtype)
    total = difference.new_zeros(len(difference))
    for _ in range(levels - 1):
        coarse = _reduce(difference)
        detail = difference - _expand(coarse, difference.shape)
        total = total + _weighted_mean(detail.abs(), weight)
        difference, weight = coarse, _reduce(weight)
    return total + _weighted_mean(difference.abs(), weight)


def _difference(prediction: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return prediction - target, 0 where unknown, and where it is known."""
    known = prediction.isfinite() & target.isfinite()
    if mask is not None:
        known = known & mask
    return torch.where(known, prediction, 0) - torch.where(known, target, 0), known


def _weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum(dim=(-3, -2, -1)) / weight.sum(dim=(-3, -2, -1))


def _reduce(values: Tensor) -> Tensor:
    """Return the next coarser level, (B, 1, H, W) -> (B, 1, ceil(H / 2), ceil(W / 2)); edge pixels repeated."""
    return functional.conv2d(functional.pad(values, (2, 2, 2, 2), mode="replicate"), _kernel(values), stride=2)


def _expand(coarse: Tensor, shape: torch.Size) -> Tensor:
    """Return a level interpolated to the next finer one's shape: zeros between the pixels, blurred, normalised."""
    height, width = shape[-2:]
    extra = (height - 2 * (coarse.shape[-2] - 1) - 1, width - 2 * (coarse.shape[-1] - 1) - 1)

    def spread(values: Tensor) -> Tensor:
        kernel = _kernel(coarse)
        return functional.conv_transpose2d(values, kernel, stride=2, padding=2, output_padding=extra)

    return spread(coarse) / spread(torch.ones_like(coarse))


def _kernel(like: Tensor) -> Tensor:
    taps = torch.tensor(_BINOMIAL, dtype=like.dtype, device=like.device)
    return torch.outer(taps, taps)[None, None]
