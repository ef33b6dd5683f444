"""Losses on depth maps and on renderings: one value per image, masked, differentiable.

On depth: Lap_1 of Bojanowski et al., *Optimizing the Latent Space of Generative Networks*, ICML 2018, L1 and MSE. On
renderings, with the metrics' own kernels: MSE_v (Voynov et al. 2019), and DSSIM_v and LPIPS_v to compare it with, as
means over the lights in place of the worst, because the gradient of a maximum is that of one light alone.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from dsr.metrics.functional import SSIM_WINDOW, SurfacePair, dssim_v, mse_v
from dsr.metrics.lpips import GET_TRUNK, LPIPS, MIN_SIZE, load_lpips, lpips_v
from dsr.utils.compute_device import in_own_precision, known_true, made_once
from dsr.utils.console import one_line

VisualLossName = Literal["mse_v", "dssim", "lpips"]
_PIXELS = (-3, -2, -1)
# titles of the visual losses, and the smallest height and width in pixels that they are defined for
_VISUAL = {"mse_v": ("MSE_v", 2), "dssim": ("DSSIM_v", SSIM_WINDOW), "lpips": ("LPIPS_v", MIN_SIZE)}


@in_own_precision
def l1(prediction: Tensor, target: Tensor, *, complete: bool | None = None) -> Tensor:
    """Return the mean absolute difference over valid pixels of (B, 1, H, W) maps, (B,); NaN if none is valid.

    ``complete`` says whether neither has a hole, NaN; None if not known.
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
    """Return the Laplacian pyramid loss Lap_1 per pixel, (B,), as :func:`l1`: the sum of the levels' means.

    This is eq. 2 per pixel: the weight of a level, 2^(2 j), cancels with its number of pixels. The pyramid is built of
    the difference, 0 in holes, and weights a pixel by the valid fraction of its area. The shorter side has at least
    3 * 2^(levels - 1) pixels.
    """
    difference, valid = _difference(prediction, target, complete)
    weight = None if valid is None else valid.to(difference.dtype)
    terms = []
    for _ in range(levels - 1):
        lower, size = _reduce(difference), difference.shape[-2:]
        detail = difference - _blur(lower, size) / _blurred_ones(lower.shape[-2:], size, lower.dtype, lower.device)
        terms.append(_mean(detail.abs(), weight))
        difference, weight = lower, None if weight is None else _reduce(weight)
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
    """Blur (B, 1, H, W) and keep every second row and column."""
    kernel = _kernel(values.dtype, values.device)
    return functional.conv2d(functional.pad(values, (2, 2, 2, 2), mode="replicate"), kernel, stride=2)


def _blur(level: Tensor, size: Sequence[int]) -> Tensor:
    """Insert zeros between the pixels of a level up to the size of the level before, and blur."""
    extra = [full - 2 * half + 1 for full, half in zip(size, level.shape[-2:], strict=True)]
    kernel = _kernel(level.dtype, level.device)
    return functional.conv_transpose2d(level, kernel, stride=2, padding=2, output_padding=extra)


@made_once
def _blurred_ones(size: Sequence[int], larger: Sequence[int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return what normalises :func:`_blur`, (1, 1, *larger)."""
    return _blur(torch.ones(1, 1, *size, dtype=dtype, device=device), larger)


@made_once
def _kernel(dtype: torch.dtype, device: torch.device) -> Tensor:
    taps = torch.tensor((1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16), dtype=dtype, device=device)
    return torch.outer(taps, taps)[None, None]


@dataclass(frozen=True)
class VisualLoss:
    """A loss on renderings; :func:`make_visual_loss` loads the network of ``lpips``."""

    name: VisualLossName = "mse_v"
    network: LPIPS | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.name not in _VISUAL:
            raise ValueError(f"visual: expected one of {', '.join(_VISUAL)}, got {self.name!r}")
        if self.name == "lpips" and self.network is None:
            raise ValueError("visual: expected a network for lpips, got none")

    def __call__(self, pair: SurfacePair) -> Tensor:
        """Return the loss, (B,); NaN for an image without a valid normal."""
        if self.name == "mse_v":
            return mse_v(pair)
        values = dssim_v(pair) if self.network is None else lpips_v(pair, self.network)
        return values.mean(dim=1)

    @property
    def title(self) -> str:
        """Name of the metric."""
        return _VISUAL[self.name][0]

    def check_size(self, height: int, width: int) -> None:
        """Raise a ValueError for maps that are smaller than the loss is defined for."""
        least, came = _VISUAL[self.name][1], f"got {height} x {width}"
        if min(height, width) < least:
            raise ValueError(f"visual: {self.name} expects maps of at least {least} x {least} pixels, {came}")


MSE_V = VisualLoss()


def make_visual_loss(name: VisualLossName, trunk: str | Path | None = None) -> VisualLoss:
    """Return a loss; ``trunk`` is the file of AlexNet's weights for ``lpips``, None to use torch's hub cache."""
    if name != "lpips":
        return VisualLoss(name)
    try:
        return VisualLoss(name, load_lpips(None if trunk is None else Path(trunk).expanduser()))
    except (OSError, ValueError) as error:
        raise ValueError(f"visual: lpips needs AlexNet's weights: {one_line(error)}; {GET_TRUNK}") from error


@torch.no_grad()
def match_weight(visual: VisualLoss, pairs: Iterable[SurfacePair]) -> float:
    """Return the weight that makes a loss as large as MSE_v: the median of their ratios, 1 if no pair has an error."""
    ratios = torch.cat([torch.ones(0), *(mse_v(pair).cpu() / visual(pair).cpu() for pair in pairs)])
    ratios = ratios[ratios.isfinite() & (ratios > 0)]
    return float(ratios.median()) if len(ratios) else 1.0
