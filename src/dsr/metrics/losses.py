"""Training losses: the paper's Lap_1 + w MSE_v, and L1 and MSE on depth. One value per image, masked, differentiable.

The visual losses are the metrics' own kernels, see :mod:`dsr.metrics.visual_loss`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from dsr.utils.compute_device import in_own_precision, known_true

_PIXELS = (-3, -2, -1)


@in_own_precision
def l1(prediction: Tensor, target: Tensor, *, complete: bool | None = None) -> Tensor:
    """Return the mean absolute difference over valid pixels of (B, 1, H, W) maps, (B,); NaN if none is valid.

    Args:
        prediction, target: NaN in holes.
        complete: whether neither has a hole; None if not known.

    """
    difference, valid = _difference(prediction, target, complete)
    return _mean(difference.abs(), valid)


@in_own_precision
def mse(prediction: Tensor, target: Tensor, *, complete: bool | None = None) -> Tensor:
    """Return the mean squared difference over valid pixels, (B,), as :func:`l1`."""
    difference, valid = _difference(prediction, target, complete)
    return _mean(difference.square(), valid)


@in_own_precision
def lap1(prediction: Tensor, target: Tensor, *, levels: int = 3, complete: bool | None = None) -> Tensor:
    """Return the Laplacian pyramid loss Lap_1 per pixel, (B,), as :func:`l1`.

    Bojanowski et al., *Optimizing the Latent Space of Generative Networks*, ICML 2018, eq. 2: the sum over levels j of
    2^(2 j) |L^j(x) - L^j(y)|_1. As level j has 2^(2 j) times fewer pixels, this per pixel is the sum of the levels'
    mean absolute differences; the last level is the low-pass. The pyramid is linear, so it is built of the difference,
    which is 0 in holes; each level weights a pixel by the valid fraction of its area. The shorter side has at least
    3 * 2^(levels - 1) pixels.
    """
    difference, valid = _difference(prediction, target, complete)
    weight = None if valid is None else valid.to(difference.dtype)
    terms = []
    for _ in range(levels - 1):
        level = _reduce(difference)
        detail = difference - _blur(level, difference.shape[-2:]) / _blurred_ones(
            level.shape[-2:], difference.shape[-2:], level.dtype, level.device
        )
        terms.append(_mean(detail.abs(), weight))
        difference, weight = level, None if weight is None else _reduce(weight)
    return functools.reduce(torch.add, [*terms, _mean(difference.abs(), weight)])


def _difference(prediction: Tensor, target: Tensor, complete: bool | None) -> tuple[Tensor, Tensor | None]:
    """Return prediction - target, 0 in holes, and the valid mask, None without holes."""
    if complete:
        return prediction - target, None
    valid = prediction.isfinite() & target.isfinite()
    if complete is None and known_true(valid):
        return prediction - target, None
    return torch.where(valid, prediction, 0) - torch.where(valid, target, 0), valid


def _mean(values: Tensor, weight: Tensor | None) -> Tensor:
    """Return the weighted mean of each image; values are 0 where a bool weight is False."""
    if weight is None:
        return values.mean(dim=_PIXELS)
    values = values if weight.dtype == torch.bool else values * weight
    return values.sum(dim=_PIXELS) / weight.sum(dim=_PIXELS)


def _reduce(values: Tensor) -> Tensor:
    """Return the next, smaller level, (B, 1, H, W) -> (B, 1, ceil(H / 2), ceil(W / 2)); edge pixels are repeated."""
    padded = functional.pad(values, (2, 2, 2, 2), mode="replicate")
    return functional.conv2d(padded, _kernel(values.dtype, values.device), stride=2)


def _blur(level: Tensor, size: Sequence[int]) -> Tensor:
    """Insert zeros between the pixels of a level up to the size of the level before, and blur."""
    extra = [full - 2 * half + 1 for full, half in zip(size, level.shape[-2:], strict=True)]
    kernel = _kernel(level.dtype, level.device)
    return functional.conv_transpose2d(level, kernel, stride=2, padding=2, output_padding=extra)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(mode=False)  # so that gradients can be computed with them
def _blurred_ones(size: Sequence[int], larger: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return what normalises :func:`_blur`, (1, 1, *larger)."""
    return _blur(torch.ones(1, 1, *size, dtype=dtype, device=device), larger)


@functools.cache
@torch.inference_mode(mode=False)
def _kernel(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the binomial kernel, (1, 1, 5, 5)."""
    taps = torch.tensor((1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16), dtype=dtype, device=device)
    return torch.outer(taps, taps)[None, None]
