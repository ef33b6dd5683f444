"""The training loss, a loss on disparity plus w MSE_v, and the weight w that balances the two."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from dsr.methods.networks.maps import compute_min_max
from dsr.metrics import losses
from dsr.metrics.functional import SurfacePair, mse_v
from dsr.training.degradation import Batch

DepthLoss = Literal["lap1", "l1", "mse"]
_TILT = math.asin(5 / 255)
"""1.1 degrees: it changes the rendering of a surface lit from the side by 5 of 255, the threshold of BadPix_v(5)."""
_DEPTH_LOSSES = {"lap1": losses.lap1, "l1": losses.l1, "mse": losses.mse}


@dataclass(frozen=True)
class Objective:
    """The loss: depth_loss + w MSE_v (Voynov et al. 2019, eq. 4: Lap_1 + w MSE_v).

    The depth loss compares disparities divided by the range of the low-resolution ones, so that it does not depend on
    the scale of the scene.

    Args:
        depth_loss: ``lap1``, ``l1`` or ``mse``.
        w: weight of MSE_v; 0 for the depth loss alone.

    Raises:
        ValueError: there is no such depth loss.

    """

    depth_loss: DepthLoss = "lap1"
    w: float = 0.0

    def __post_init__(self) -> None:
        """Check the name."""
        if self.depth_loss not in _DEPTH_LOSSES:
            raise ValueError(f"depth_loss: expected one of {', '.join(_DEPTH_LOSSES)}, got {self.depth_loss!r}")

    def __call__(self, disparity: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms, means over the images of the batch that have valid depth.

        Args:
            disparity: (B, 1, H, W) the network's disparity in pixels.
            batch: tensors of :func:`dsr.training.degradation.to_tensors`.

        """
        target = batch["bf"] / batch["depth"] - batch["doffs"]
        extent = _range(batch["disparity_lr"])
        loss = _DEPTH_LOSSES[self.depth_loss](disparity / extent, target / extent).nanmean()
        terms: dict[str, Tensor] = {self.depth_loss: loss}
        if self.w:
            pair = SurfacePair(to_depth(disparity, batch), batch["depth"], batch["rays"])
            terms["mse_v"] = mse_v(pair).nanmean()
            loss = loss + self.w * terms["mse_v"]
        return {"loss": loss, **terms}


def to_depth(disparity: Tensor, batch: Batch) -> Tensor:
    """Return orthogonal depth in metres, (B, 1, H, W); NaN where it would be infinite or negative."""
    shifted = disparity + batch["doffs"]
    return torch.where(shifted > 0, batch["bf"] / torch.where(shifted > 0, shifted, 1), torch.nan)


def balance_weight(patches: Iterable[Batch]) -> float:
    """Return the weight w for which one depth error gives both terms of the loss the same size.

    A depth error of tan(a) z / f metres between two neighbouring pixels, z / f metres apart, tilts the normal by a. The
    depth term of this error is bf tan(a) / (f z range), where bf is the baseline times the focal length and range that
    of the low-resolution disparities; MSE_v is (2 - 2 cos a) / 3. w is the median over the patches of their ratio for a
    tilt of 1.1 degrees, which changes a rendering by 5 of 255.

    Args:
        patches: single training patches, without a batch axis, as from :func:`dsr.training.degradation.to_tensors`.

    Raises:
        ValueError: there is no patch.

    """
    ratios = []
    for patch in patches:
        x = patch["rays"][0, 0].double()
        focal = (x.numel() - 1) / float(x[-1] - x[0])
        depth = float(patch["depth"][patch["depth"].isfinite()].median())
        extent = float(_range(patch["disparity_lr"][None]))
        ratios.append(float(patch["bf"]) * math.tan(_TILT) / (focal * depth * extent))
    if not ratios:
        raise ValueError("patches: expected one or more to compute w from, got none")
    return float(torch.tensor(ratios, dtype=torch.float64).median()) / ((2 - 2 * math.cos(_TILT)) / 3)


def _range(disparity: Tensor) -> Tensor:
    """Return the range of valid disparities per image, (B, 1, 1, 1), at least a thousandth of the largest."""
    low, high = compute_min_max(disparity).chunk(2, dim=1)
    return (high - low).clamp(min=1e-3 * high.abs().clamp(min=1e-3))
