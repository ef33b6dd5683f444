"""Lightning's trainer as ``train.py`` uses it: what is logged, kept and shown."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint

from dsr.app.devices import Processes
from dsr.app.schema import TrainerConfig
from dsr.training.degradation import Batch
from dsr.training.module import SuperResolution
from dsr.utils.checkpoints import Interruption, Keep
from dsr.utils.divergence import Divergence
from dsr.utils.lightning import Log, StepProgress, ValidationTable, make_trainer
from dsr.utils.progress import Progress

MONITOR = "val/RMSE_v"
VALIDATION = "validation.csv"
_SECONDS_BETWEEN_CHECKPOINTS = 600.0


class Throughput(Callback):
    """Logs patches per second, without the time of validations."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def on_train_start(self, *_: Any) -> None:
        """Start the clock."""
        self._start = time.perf_counter()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Batch, *_: Any
    ) -> None:
        """Log the speed of the batch, including its loading time."""
        now = time.perf_counter()
        pl_module.log("train/patches_per_second", len(batch["rgb"]) * trainer.world_size / (now - self._start))
        self._start = now

    def on_validation_end(self, *_: Any) -> None:
        """Restart the clock, so that the validation is not counted."""
        self._start = time.perf_counter()


def training_trainer(
    settings: TrainerConfig,
    folder: Path,
    device: torch.device,
    progress: Progress,
    table: Mapping[str, Any],
    processes: Processes,
) -> tuple[lightning.Trainer, ModelCheckpoint]:
    """Return the trainer, and the callback that keeps the best checkpoint.

    Args:
        settings: of the training.
        folder: the run's directory.
        device: to train on.
        progress: shows the steps.
        table: the run's entries in TensorBoard's table of runs.
        processes: of the training.

    """
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(
        checkpoints, "best", monitor=MONITOR, mode="min", enable_version_counter=False, save_on_train_epoch_end=False
    )
    latest = ModelCheckpoint(
        checkpoints, "last", enable_version_counter=False, save_on_train_epoch_end=False
    )  # save_last=True keeps the best's
    callbacks = [
        Divergence(),
        Throughput(),
        ValidationTable(folder / VALIDATION),
        best,
        latest,
        LearningRateMonitor("step"),
        StepProgress(progress, "train"),
        Keep(checkpoints / "last.ckpt", _SECONDS_BETWEEN_CHECKPOINTS),
        Interruption(checkpoints / "last.ckpt"),
    ]
    logger = Log(folder, name="", version="tensorboard", default_hp_metric=False)
    logger.list_run(table)
    trainer = make_trainer(
        device,
        settings.steps,
        min(settings.validate_every, settings.steps),
        callbacks=callbacks,
        logger=logger,
        devices=processes.count,
        accumulate=settings.accumulate,
        environment=processes.environment,
        strategy="ddp" if processes.count > 1 else "auto",
    )
    return trainer, best


def seconds_per_step(module: SuperResolution, batch: Batch) -> float:
    """Measure the seconds of a step; the module is left unchanged."""
    batch = {name: value.to(module.device) for name, value in batch.items()}
    taken, buffers = 0.0, {name: value.clone() for name, value in module.net.named_buffers()}
    for _ in range(2):  # the first one warms up
        start = time.perf_counter()
        module.loss_terms(batch)["loss"].backward()
        taken = time.perf_counter() - start
    module.net.zero_grad(set_to_none=True)
    module.net.load_state_dict(buffers, strict=False)
    return taken
