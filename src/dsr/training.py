"""Training of super-resolution networks with Lightning: the loss, the module, the schedule."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import lightning
import torch
import torchmetrics
from torch import Tensor

from dsr.data.patches import Batch
from dsr.geometry.shading import render
from dsr.geometry.surface import normals_of
from dsr.methods.msg_net import MSGNet, upsample_disparity
from dsr.quality import losses
from dsr.quality.functional import SurfacePair, mse_v

DepthLoss = Literal["lap1", "l1", "mse"]
_DRAWN = 4
_TILT = math.radians(10)
_DEPTH_LOSSES = {"lap1": losses.lap1, "l1": losses.l1, "mse": losses.mse}


@dataclass(frozen=True)
class Objective:
    """The loss: depth_loss + w MSE_v (Voynov et al. 2019, eq. 4: Lap_1 + w MSE_v).

    The depth loss is taken of disparities over the range of the coarse ones, so that it does not depend on the scene's
    size.

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
            raise ValueError(f"model.depth_loss: expected one of {', '.join(_DEPTH_LOSSES)}, got {self.depth_loss!r}")

    def __call__(self, disparity: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms, means over the batch's images with anything to compare.

        Args:
            disparity: (B, 1, H, W) the network's, in pixels.
            batch: see :func:`dsr.data.patches.tensors_of`.

        """
        target = batch["stereo"] / batch["depth"] - batch["doffs"]
        span = _span(batch["disparity_lr"])
        loss = _DEPTH_LOSSES[self.depth_loss](disparity / span, target / span).nanmean()
        terms: dict[str, Tensor] = {self.depth_loss: loss}
        if self.w:
            pair = SurfacePair(depth_of(disparity, batch), batch["depth"], batch["rays"])
            terms["mse_v"] = mse_v(pair).nanmean()
            loss = loss + self.w * terms["mse_v"]
        return {"loss": loss, **terms}


def depth_of(disparity: Tensor, batch: Batch) -> Tensor:
    """Return orthogonal depth in metres, (B, 1, H, W); NaN where the disparity lies at or beyond infinity."""
    shifted = disparity + batch["doffs"]
    return torch.where(shifted > 0, batch["stereo"] / torch.where(shifted > 0, shifted, 1), torch.nan)


def balanced_weight(patches: Iterable[Batch]) -> float:
    """Return the w that gives both terms of the loss the same size for one and the same error.

    A depth error of tan(a) z / f metres between two neighbouring pixels, z / f metres apart, tilts the normal by a. As
    a share of the coarse disparities' range the depth term sees stereo tan(a) / (f z range), and MSE_v sees
    (2 - 2 cos a) / 3. w is their ratio for a tilt of 10 degrees, plain to see in a rendering, at the median over the
    patches.

    Args:
        patches: single training patches, without a batch axis; see :func:`dsr.data.patches.tensors_of`.

    Raises:
        ValueError: there is no patch.

    """
    ratios = []
    for patch in patches:
        x = patch["rays"][0, 0].double()
        focal = (x.numel() - 1) / float(x[-1] - x[0])
        depth = float(patch["depth"][patch["depth"].isfinite()].median())
        span = float(_span(patch["disparity_lr"][None]))
        ratios.append(float(patch["stereo"]) * math.tan(_TILT) / (focal * depth * span))
    if not ratios:
        raise ValueError("loss.w=auto: expected patches to compute it from, there is none")
    return float(torch.tensor(ratios, dtype=torch.float64).median()) / ((2 - 2 * math.cos(_TILT)) / 3)


def _span(disparity: Tensor) -> Tensor:
    """Return the range of known disparities per image, (B, 1, 1, 1); a thousandth of the largest where it is less."""
    known, dims = disparity.isfinite(), (-3, -2, -1)
    low = disparity.masked_fill(~known, torch.inf).amin(dim=dims, keepdim=True)
    high = disparity.masked_fill(~known, -torch.inf).amax(dim=dims, keepdim=True)
    return (high - low).clamp(min=1e-3 * high.abs().clamp(min=1e-3))


@dataclass(frozen=True)
class Schedule:
    """The optimiser's settings: AdamW, linear warm-up, cosine to zero.

    Args:
        steps: of the whole training.
        learning_rate: at its highest.
        warmup: steps until it gets there.
        weight_decay: of AdamW.

    Raises:
        ValueError: a value is out of range.

    """

    steps: int
    learning_rate: float = 1e-3
    warmup: int = 100
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        """Check what may be 0."""
        for name in ("warmup", "weight_decay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"trainer.{name}: expected 0 or more, got {getattr(self, name)}")

    def factor(self, step: int) -> float:
        """Return the learning rate at a step as a fraction of the highest."""
        if step < self.warmup:
            return (step + 1) / self.warmup
        done = min((step - self.warmup) / max(self.steps - self.warmup, 1), 1.0)
        return 0.5 * (1 + math.cos(math.pi * done))


class SuperResolution(lightning.LightningModule):
    """A network on disparities under training.

    Args:
        net: the network.
        objective: the loss.
        schedule: the optimiser's.
        metrics: logged on every validation pass, from :func:`dsr.quality.metrics.visual_metrics`.

    Raises:
        ValueError: the network's variant leaves out pixels.

    """

    def __init__(
        self, net: MSGNet, objective: Objective, schedule: Schedule, metrics: torchmetrics.MetricCollection
    ) -> None:
        super().__init__()
        if not net.variant.same_size:
            raise ValueError(f"model.variant: expected one that covers the whole image, got {net.variant.name}")
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.objective, self.schedule, self.metrics = objective, schedule, metrics

    def forward(self, batch: Batch) -> Tensor:
        """Return the fine disparity, (B, 1, H, W) in pixels."""
        return upsample_disparity(self.net, batch["rgb"], batch["disparity_lr"])

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """Return the loss of a batch of patches."""
        disparity = self(batch)
        with torch.autocast(self.device.type, enabled=False):  # a mixed precision is the network's alone
            terms = self.objective(disparity, batch)
        self.log_dict({f"train/{name}": value.detach() for name, value in terms.items()}, prog_bar=True)
        return terms["loss"]

    def validation_step(self, batch: Batch, index: int) -> None:
        """Score a whole scene, and draw the first few."""
        depth = depth_of(self(batch).to(batch["depth"].dtype), batch)
        with torch.autocast(self.device.type, enabled=False):
            self.metrics.update(SurfacePair(depth, batch["depth"], batch["rays"], image_dtype=torch.float32))
            writer: Any = getattr(self.logger, "experiment", None)
            if hasattr(writer, "add_image") and index < _DRAWN:
                writer.add_image(f"renderings/{index}", _comparison(depth, batch), self.global_step)

    def on_validation_epoch_end(self) -> None:
        """Log the means over the scenes, worst of four lights."""
        self.log_dict({f"val/{name}": value.float() for name, value in self.metrics.compute().items()})
        self.metrics.reset()

    def configure_optimizers(self) -> Any:
        """Return AdamW and the schedule of its learning rate, step by step."""
        schedule = self.schedule
        optimiser = torch.optim.AdamW(
            self.net.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay
        )
        rates = torch.optim.lr_scheduler.LambdaLR(optimiser, schedule.factor)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": rates, "interval": "step"}}


def _comparison(depth: Tensor, batch: Batch) -> Tensor:
    """Return the renderings of the result above those of the truth, (1, 2 H, 4 W) in [0, 1], holes black."""
    rows = [render(normals_of(each, batch["rays"]))[0] for each in (depth, batch["depth"])]  # 2 x (4, H, W)
    return torch.cat([torch.cat(list(row), dim=-1) for row in rows], dim=-2)[None].nan_to_num(0).float().cpu()
