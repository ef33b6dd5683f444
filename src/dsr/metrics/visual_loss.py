"""Losses on renderings: MSE_v, and DSSIM_v and LPIPS_v to compare it with. One value per image, masked, differentiable.

They are the metrics' own kernels. DSSIM_v and LPIPS_v as metrics are the worst of four lights; as losses they are the
mean over the lights, because the gradient of a maximum is that of one light alone and jumps where another one becomes
the worst. MSE_v has no lights: it is the same for any three orthonormal ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

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
    """A loss on renderings.

    Args:
        name: ``mse_v``, ``dssim`` or ``lpips``.
        network: of ``lpips``; see :func:`make_visual_loss`.

    Raises:
        ValueError: there is no such loss, or no network for it.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.functional import SurfacePair
        >>> from dsr.metrics.visual_loss import VisualLoss
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth = torch.full((1, 1, 24, 32), 2.0)
        >>> prediction = truth.clone().requires_grad_()
        >>> loss = VisualLoss("mse_v")(SurfacePair(prediction, truth, camera.rays()[None]))
        >>> loss.shape, loss.requires_grad
        (torch.Size([1]), True)

    """

    name: VisualLossName = "mse_v"
    network: LPIPS | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the values."""
        if self.name not in get_args(VisualLossName):
            raise ValueError(f"visual: expected one of {', '.join(get_args(VisualLossName))}, got {self.name!r}")
        if self.name == "lpips" and self.network is None:
            raise ValueError("visual: expected a network for lpips, got none")

    def __call__(self, pair: SurfacePair) -> Tensor:
        """Return the loss, (B,); NaN for an image without a valid normal."""
        if self.name == "mse_v":
            return mse_v(pair)
        if self.network is None:
            return dssim_v(pair).mean(dim=1)
        return lpips_v(pair, self.network).mean(dim=1)

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
        name: see :class:`VisualLoss`.
        trunk: file of AlexNet's weights; None to use torch's hub cache.

    Raises:
        ValueError: there is no such loss, or the weights are not there.

    """
    if name != "lpips":
        return VisualLoss(name)
    try:
        return VisualLoss(name, load_lpips(None if trunk is None else Path(trunk).expanduser()))
    except (OSError, ValueError) as error:
        raise ValueError(f"visual: lpips needs AlexNet's weights: {one_line(error)}; {GET_TRUNK}") from error


@torch.no_grad()
def match_weight(visual: VisualLoss, pairs: Iterable[SurfacePair]) -> float:
    """Return the weight for which a loss is as large as MSE_v: the median of their ratio over typical pairs.

    Args:
        visual: the loss.
        pairs: typical errors, one image each. Pairs without an error do not count; if none does, the weight is 1.

    """
    ratios = torch.cat([torch.ones(0), *(mse_v(pair).cpu() / visual(pair).cpu() for pair in pairs)])
    ratios = ratios[ratios.isfinite() & (ratios > 0)]
    return float(ratios.median()) if len(ratios) else 1.0
