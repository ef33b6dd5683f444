"""What trainings log besides validation scores, through Lightning's loggers."""

import re
import time
from collections.abc import Mapping
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger
from torch import Tensor

from dsr.metrics.formats import looks_and_depth
from dsr.training.degradation import Batch
from dsr.utils.checkpoints import ends_step


class Curves(Callback):
    """Logs the losses and the gradient's norm, means over steps and devices, the learning rate and the speed.

    There is a value every ``log_every_n_steps`` of the trainer, or one after its last step if it has fewer. Values that
    are not finite are left out.
    """

    def __init__(self) -> None:
        self._start, self._patches, self._rate = time.perf_counter(), 0, 0.0
        self._sums: dict[str, Tensor] = {}  # of the values that are finite, and their number

    def state_dict(self) -> dict[str, Any]:
        """Return the sums since the last values, so that a training that goes on logs the same ones."""
        return {"sums": self._sums}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the sums since the last values."""
        self._sums = dict(state_dict["sums"])

    def on_train_start(self, *_: Any) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_train_batch_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Note the learning rate, before the step sets the next one's."""
        self._rate = float(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Batch, *_: Any
    ) -> None:
        """Add the values of a batch, and log their means when it is time."""
        self._patches += len(batch["rgb"]) * trainer.world_size
        logged = {name: value for name, value in trainer.callback_metrics.items() if name.startswith("train/")}
        values = torch.stack([value.detach().to(pl_module.device) for value in logged.values()])
        entries = torch.stack((values, torch.ones_like(values)), 1) * values.isfinite()[:, None]
        for name, entry in zip(logged, entries.nan_to_num(), strict=True):
            self._sums[name] = self._sums.get(name, 0) + entry
        every: int = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if trainer.max_steps > 0:
            every = min(every, trainer.max_steps)
        if trainer.global_step % every or not ends_step(trainer):
            return
        totals = trainer.strategy.reduce(torch.stack(list(self._sums.values())), reduce_op="sum")
        means = {name: float(total / count) for name, (total, count) in zip(self._sums, totals.cpu(), strict=True)}
        now = time.perf_counter()
        means |= {"train/learning_rate": self._rate, "train/patches_per_second": self._patches / (now - self._start)}
        for logger in trainer.loggers:
            logger.log_metrics(means, trainer.global_step)
        self._sums, self._start, self._patches = {}, now, 0

    def on_validation_start(self, *_: Any) -> None:
        """Stop the clock."""
        self._start -= time.perf_counter()

    def on_validation_end(self, *_: Any) -> None:
        """Start the clock again."""
        self._start += time.perf_counter()


def log_layout(logger: TensorBoardLogger, titles: Mapping[str, str]) -> None:
    """Lay out TensorBoard's *Custom scalars*: metrics of renderings first, then those of depth, then losses."""
    groups = {
        **{title: {titles[name]: rf"(val|bicubic)(_[^/]*)?/{re.escape(name)}$" for name in names}
           for title, names in looks_and_depth(titles).items()},
        "Training": {name: f"train/{name}$" for name in ("loss", "gradient_norm")},
    }  # fmt: skip
    layout = {title: {name: ["Multiline", [tag]] for name, tag in charts.items()} for title, charts in groups.items()}
    logger.experiment.add_custom_scalars({title: charts for title, charts in layout.items() if charts})


def log_picture(logger: Any, tag: str, picture: Tensor, step: int) -> None:
    """Log a picture, (3, H, W) uint8, if the logger shows pictures."""
    array = picture.permute(1, 2, 0).numpy()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(tag, picture, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(tag, [array], caption=[f"step {step}"])
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_image(logger.run_id, array, artifact_file=f"{tag}/{step:06}.png")
