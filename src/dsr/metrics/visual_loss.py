"""Losses on renderings: MSE_v, and DSSIM_v and LPIPS_v to compare it with. One value per image, masked, differentiable.

They are the metrics' own kernels. DSSIM_v and LPIPS_v as metrics are the worst of four lights; as losses they are the
mean over the lights, because the gradient of a maximum is that of one light alone and jumps where another one becomes
the worst. MSE_v has no lights: it is the same for any three orthonormal ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from dsr.metrics.functional import SSIM_WINDOW, SurfacePair, dssim_v, mse_v
from dsr.metrics.lpips import GET_TRUNK, LPIPS, MIN_SIZE, load_lpips, lpips_v
from dsr.utils.console import one_line

VisualLossName = Literal["mse_v", "dssim", "lpips"]
_TITLES = {"mse_v": "MSE_v", "dssim": "DSSIM_v", "lpips": "LPIPS_v"}
_MIN_SIZES = {"mse_v": 2, "dssim": SSIM_WINDOW, "lpips": MIN_SIZE}


@dataclass(frozen=True)
class VisualLoss:
    """A loss on renderings; :func:`make_visual_loss` loads the network of ``lpips``."""

    name: VisualLossName = "mse_v"
    network: LPIPS | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the values."""
        if self.name not in _TITLES:
            raise ValueError(f"visual: expected one of {', '.join(_TITLES)}, got {self.name!r}")
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
        return _TITLES[self.name]

    def check_size(self, height: int, width: int) -> None:
        """Raise a ValueError for maps that are smaller than the loss is defined for."""
        least = _MIN_SIZES[self.name]
        if min(height, width) < least:
            raise ValueError(
                f"visual: {self.name} expects maps of at least {least} x {least} pixels, got {height} x {width}"
            )


MSE_V = VisualLoss()


def make_visual_loss(name: VisualLossName, trunk: str | Path | None = None) -> VisualLoss:
    """Return a loss, with the network that ``lpips`` needs.

    Args:
        name: ``mse_v``, ``dssim`` or ``lpips``.
        trunk: file of AlexNet's weights; None to use torch's hub cache.

    """
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
