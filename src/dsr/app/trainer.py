"""Lightning's trainer as ``train.py`` uses it: what is logged, kept and shown."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import Callback, DeviceStatsMonitor, LearningRateMonitor, ModelCheckpoint, ProgressBar
from lightning.pytorch.utilities.seed import isolate_rng

from dsr.app.devices import Processes
from dsr.app.schema import TrainConfig
from dsr.data.scene_source import SceneSource, prepare_scenes, unprepared
from dsr.training.data_module import PatchData
from dsr.training.degradation import Batch
from dsr.training.module import SuperResolution
from dsr.utils.checkpoints import Interruption, OwnFiles
from dsr.utils.configuration import ConfigError, build
from dsr.utils.lightning import ListedScores, StepProgress, ValidationTable, make_trainer, without_chatter
from dsr.utils.progress import SILENT, Progress
from dsr.utils.spelling import did_you_mean

MONITOR = "val/RMSE_v"
VALIDATION = "validation.csv"
_SECONDS_BETWEEN_CHECKPOINTS = 600.0
_PROBES = 3
"""Scenes that are prepared to measure how long it takes."""


class FirstValidation(Callback):
    """Validates before the first step, without any effect on the steps; these initial weights may be the best ones.

    Args:
        best: keeps the best checkpoint; by itself only after steps.

    """

    def __init__(self, best: ModelCheckpoint) -> None:
        self._best = best

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Validate, unless the training goes on."""
        if trainer.global_step:
            return
        with isolate_rng():
            trainer.validating = True
            trainer.fit_loop.epoch_loop.val_loop.run()
            trainer.training = True
        score = trainer.callback_metrics[MONITOR].clone()
        if not score.isfinite():
            return
        path = str(Path(str(self._best.dirpath), f"{self._best.filename}.ckpt"))
        trainer.save_checkpoint(path)
        kept = {"best_model_path": path, "kth_best_model_path": path, "best_k_models": {path: score}}
        self._best.load_state_dict(self._best.state_dict() | kept | {"best_model_score": score, "kth_value": score})


def training_trainer(
    config: TrainConfig,
    folder: Path,
    device: torch.device,
    progress: Progress,
    processes: Processes,
    *,
    known: Sequence[str] = (),
    idle: bool = False,
) -> tuple[lightning.Trainer, ModelCheckpoint, Mapping[str, Callback]]:
    """Return the trainer, the callback that keeps the best checkpoint, and those of the configuration by name.

    Args:
        config: of the training.
        folder: the run's directory.
        device: to train on.
        progress: shows the steps.
        processes: of the training.
        known: names of the metrics of a validation, ``val/NAME``.
        idle: whether some layers have no part in some steps, see :func:`has_idle_layers`; several devices have to
            know.

    Raises:
        ConfigError: the log cannot be written, such as without an optional package, or a callback is set wrongly.

    """
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(
        checkpoints, "best", monitor=MONITOR, mode="min", enable_version_counter=False, save_on_train_epoch_end=False
    )
    latest = ModelCheckpoint(
        checkpoints, "last", enable_version_counter=False, save_on_train_epoch_end=False
    )  # save_last=True keeps the best's
    own = {name: build(f"callbacks.{name}", node) for name, node in config.callbacks.items()}
    for name, each in own.items():
        monitor = str(getattr(each, "monitor", None))
        if monitor.startswith("val/") and monitor not in known:
            near = did_you_mean(monitor, known)
            raise ConfigError(f"callbacks.{name}.monitor: expected one of {', '.join(known)}, got {monitor}{near}")
        if isinstance(each, LearningRateMonitor | DeviceStatsMonitor) and not config.logger:
            raise ConfigError(f"callbacks.{name}: expected a logger to write to, such as logger=csv, got none")
        if isinstance(each, ProgressBar):
            raise ConfigError(f"callbacks.{name}: expected none that shows progress, dsr does it itself; leave it out")
        if isinstance(each, ModelCheckpoint):  # whose keys would be alike
            each.__class__ = type(type(each).__name__, (type(each),), {"state_key": f"callbacks.{name}"})
    callbacks = [
        OwnFiles(checkpoints, progress.say),
        *own.values(),
        ValidationTable(folder / VALIDATION),
        ListedScores(best),
        best,
        latest,
        StepProgress(progress, "train"),
        Interruption(checkpoints / "last.ckpt", _SECONDS_BETWEEN_CHECKPOINTS),
        FirstValidation(best),
    ]
    with without_chatter():
        loggers = [build(f"logger.{name}", {"save_dir": str(folder), **node}) for name, node in config.logger.items()]
    varying = "_find_unused_parameters_true" if idle or config.degradation.get("scales") else ""  # layers of one factor
    node = config.more_of_trainer
    trainer = make_trainer(
        device,
        config.steps,
        config.interval,
        callbacks=callbacks,
        logger=loggers,
        devices=processes.count,
        accumulate=config.accumulate,
        environment=processes.environment,
        strategy=f"ddp{varying}" if processes.count > 1 else "auto",
        precision="bf16-mixed" if config.precision == "bfloat16" else "32-true",
        default_root_dir=folder,
        make=lambda **given: build("trainer", node, {key: value for key, value in given.items() if key not in node}),
    )
    return trainer, best, own


def seconds_per_step(module: SuperResolution, batch: Batch, precision: str = "float32") -> float:
    """Measure the seconds of a step; the module is left unchanged."""
    return _try_steps(module, batch, 2, precision)[0]  # the first one warms up


def seconds_per_validation(module: SuperResolution, data: PatchData) -> float:
    """Measure the seconds of a validation with the first scene of each set; the module is left unchanged."""
    total = 0.0
    module.average.eval()
    for index, (kind, (_, names)) in enumerate(data.validation_scenes().items()):
        batch = {
            name: value.to(module.device) if torch.is_tensor(value) else value
            for name, value in data.example_scene(kind).items()
        }
        start = time.perf_counter()
        with torch.no_grad():
            module.validation_step(batch, 0, index)
        total += (time.perf_counter() - start) * len(names)
        module.metrics[index].reset()  # type: ignore[operator]
    module.average.train()
    return total


def seconds_to_prepare(source: SceneSource, names: Sequence[str], progress: Progress) -> tuple[float, int]:
    """Prepare a few of the scenes that are not ready; return the seconds for the others and their number.

    All cores will work on them. The first one, which may have to compile, does not count.
    """
    missing = unprepared(source, names)
    taken = []
    for name in progress.track(missing[:_PROBES], "measure"):
        start = time.perf_counter()
        prepare_scenes(source, [name], SILENT)
        taken.append(time.perf_counter() - start)
    rest = len(missing) - len(taken)
    return sum(taken[1:]) / (_PROBES - 1) * rest / (os.cpu_count() or 1), rest


def has_idle_layers(module: SuperResolution, batch: Batch) -> bool:
    """Return whether a step gives some parameters no gradient; the module is left unchanged."""
    return _try_steps(module, batch, 1)[1]


def _try_steps(module: SuperResolution, batch: Batch, count: int, precision: str = "float32") -> tuple[float, bool]:
    """Return the seconds of the last of some steps, and whether it left parameters without a gradient."""
    batch = {name: value.to(module.device) for name, value in batch.items()}
    taken, buffers = 0.0, {name: value.clone() for name, value in module.net.named_buffers()}
    for _ in range(count):
        start = time.perf_counter()
        with torch.autocast(module.device.type, torch.bfloat16, enabled=precision == "bfloat16"):
            loss = module.loss_terms(batch)["loss"]
        loss.backward()
        taken = time.perf_counter() - start
    idle = any(each.grad is None for each in module.net.parameters() if each.requires_grad)
    module.net.zero_grad(set_to_none=True)
    module.net.load_state_dict(buffers, strict=False)
    return taken, idle
