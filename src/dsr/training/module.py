"""Training of super-resolution networks with Lightning."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import lightning
import torch
import torchmetrics
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from dsr.geometry.comparison import comparison
from dsr.methods.networks.base import DisparityNetwork
from dsr.metrics.classes import compute_means
from dsr.metrics.functional import SurfacePair
from dsr.sample import Unit
from dsr.training.degradation import Batch
from dsr.training.loggers import log_picture
from dsr.training.objective import Objective, SurfaceObjective, to_depth
from dsr.training.settings import Schedule

_RENDERED_SCENES = 4
"""Number of scenes of each validation set that are rendered for TensorBoard."""


class SuperResolution(lightning.LightningModule):
    """The training of a network of disparities.

    Args:
        net: the network.
        objective: the loss.
        schedule: settings of the optimisation.
        metrics: function that makes the metrics of a validation set, such as
            :func:`dsr.metrics.classes.visual_metrics`.
        validation_sets: names of the validation sets, in the order of the loaders.

    Raises:
        ValueError: the network does not cover the whole image.

    """

    def __init__(
        self,
        net: DisparityNetwork,
        objective: Objective | SurfaceObjective,
        schedule: Schedule,
        metrics: Callable[[], torchmetrics.MetricCollection],
        validation_sets: Sequence[str] = ("val",),
    ) -> None:
        super().__init__()
        if not net.covers:
            raise ValueError("model: expected a network that covers the whole image, its variant leaves out pixels")
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.net).requires_grad_(False)
        self.objective, self.schedule = objective, schedule
        self.sets = tuple(validation_sets)
        self.metrics = nn.ModuleList(metrics() for _ in self.sets)
        self.validation_scores: dict[str, dict[str, float]] = {}
        self._pictures: dict[str, Tensor] = {}

    def training_step(self, batch: Batch, _: int) -> Tensor:
        """Return the loss of a batch of patches."""
        terms = self.loss_terms(batch)
        self.log_dict({f"train/{name}": value.detach() for name, value in terms.items()}, logger=False)
        return terms["loss"]

    def loss_terms(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms."""
        if isinstance(self.objective, SurfaceObjective):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.schedule.mixed):
                inverse = batch["disparity_lr"] + batch["doffs"]
                answer = self.net.answer(batch["rgb"], inverse, batch["noise"], batch["facts"])
            return self.objective(answer, batch)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.schedule.mixed):
            stages = self.net.upsample_stages(batch["rgb"], batch["disparity_lr"], batch["min_max"])
        *intermediate, disparity = (stage.float() for stage in stages)
        return self.objective(disparity, batch, intermediate)

    def configure_gradient_clipping(self, optimizer: Any, *_: Any, **__: Any) -> None:
        """Clip the gradient and log its norm; drop a gradient that is not finite, so that the step changes nothing."""
        norm = nn.utils.clip_grad_norm_(self.net.parameters(), self.schedule.clip)
        self.log("train/gradient_norm", norm.detach(), logger=False)
        if not bool(norm.isfinite()):
            optimizer.zero_grad(set_to_none=True)

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """Do a step, then update the moving average of the weights."""
        super().optimizer_step(*arguments, **named)
        update = get_ema_multi_avg_fn(self.schedule.decay(self.global_step + 1))
        update(list(self.average.parameters()), list(self.net.parameters()), None)
        for average, current in zip(self.average.buffers(), self.net.buffers(), strict=True):
            average.copy_(current)  # such as the statistics of batch normalisation, which are averages already

    def validation_step(self, batch: Batch, index: int, dataloader_idx: int = 0) -> None:
        """Score a whole scene, if the batch has one; render the first few for TensorBoard."""
        if not batch:
            return
        offset = batch["doffs"] if self.average.of_inverse_depth else 0
        values = batch["disparity_lr"] + offset
        if isinstance(self.objective, SurfaceObjective):
            disparity = self.average.answer(batch["rgb"], values, batch.get("noise"), batch.get("facts")).disparity
        else:
            disparity = self.average.upsample(batch["rgb"], values)
        disparity = disparity - offset
        depth = to_depth(disparity.to(batch["depth"].dtype), batch)
        self.metrics[dataloader_idx].update(  # type: ignore[operator]
            SurfacePair(depth, batch["depth"], batch["rays"], unit=Unit(**batch["unit"]), image_dtype=torch.float32)
        )
        if self._trainer is None or not self._trainer.loggers:
            return
        number = index * self.trainer.world_size + self.trainer.global_rank  # of the scene
        if number < _RENDERED_SCENES:
            depth_lr = to_depth(batch["disparity_lr"].to(batch["depth"].dtype), batch)
            picture = comparison(depth, batch["depth"], batch["rays"], batch["rgb"], depth_lr)
            self._pictures[f"renderings/{self.sets[dataloader_idx]}_{number}"] = picture

    def on_validation_epoch_end(self) -> None:
        """Log the mean scores over the scenes, worst of four lights, of all sets and, if there are several, of each."""
        self._gather()
        for name in sorted(self._pictures):
            for logger in self.loggers:
                log_picture(logger, name, self._pictures[name], self.global_step)
        self._pictures = {}
        collections: Any = self.metrics
        scores = [{name: value.double() for name, value in compute_means(each).items()} for each in collections]
        names = dict.fromkeys(name for each in scores for name in each)
        means = {name: torch.stack([each[name] for each in scores if name in each]).nanmean() for name in names}
        named = {"val": means}
        if len(self.sets) > 1:
            named |= {f"val_{name}": each for name, each in zip(self.sets, scores, strict=True)}
        self.validation_scores = {
            kind: {name: float(value) for name, value in each.items()} for kind, each in named.items()
        }
        self.log_dict({f"{kind}/{name}": v for kind, each in named.items() for name, v in each.items()})
        for each in self.metrics:
            each.reset()  # type: ignore[operator]

    def _gather(self) -> None:
        """Gather what torchmetrics does not: which metrics apply to the scenes of any device, and the pictures."""
        if self.trainer.world_size == 1:
            return
        collections: Any = self.metrics
        metrics = [metric for each in collections for metric in each.values() if hasattr(metric, "applied")]
        all_devices: list[Any] = [None] * self.trainer.world_size
        torch.distributed.all_gather_object(all_devices, ([metric.applied for metric in metrics], self._pictures))
        for number, metric in enumerate(metrics):
            metric.applied = any(applied[number] for applied, _ in all_devices)
        self._pictures = {name: picture for _, pictures in all_devices for name, picture in pictures.items()}

    def configure_optimizers(self) -> Any:
        """Return AdamW and its learning-rate schedule, which is updated after every step."""
        schedule = self.schedule
        optimiser = torch.optim.AdamW(
            self.net.parameters(), lr=schedule.learning_rate, weight_decay=schedule.weight_decay
        )
        rates = torch.optim.lr_scheduler.LambdaLR(optimiser, schedule.factor)
        named = {"scheduler": rates, "interval": "step", "name": "train/learning_rate"}
        return {"optimizer": optimiser, "lr_scheduler": named}
