"""Lightning's trainer as ``train.py`` uses it: what is logged, kept and shown, and how a run is interrupted."""

from __future__ import annotations

import contextlib
import csv
import logging
import signal
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from rich.console import Console
from torch.utils.tensorboard.summary import hparams

from dsr.app.progress import TrainingBar
from dsr.app.schema import TrainerConfig
from dsr.atomic import replacing
from dsr.data.problem import Batch
from dsr.training import SuperResolution

MONITOR = "val/RMSE_v"
VALIDATION = "validation.csv"
_IN_TABLE = ("RMSE_v", "DSSIM_v", "LPIPS_v", "BadPix_v_5", "Bumpiness_d", "RMSE_d")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption(Callback):
    """Ends a training between two steps at Ctrl-C or SIGTERM, with a checkpoint of that very step.

    Args:
        path: of the checkpoint.

    """

    def __init__(self, path: Path) -> None:
        self._path, self._wanted = path, False
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Listen."""
        with contextlib.suppress(ValueError):  # not in the main thread
            self._before = {number: signal.signal(number, self._want) for number in _SIGNALS}

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Save and stop, if that is wanted and no gradient is being accumulated."""
        if self._wanted and trainer.fit_loop.batch_idx % trainer.accumulate_grad_batches == (
            trainer.accumulate_grad_batches - 1
        ):
            trainer.save_checkpoint(self._path)
            raise KeyboardInterrupt

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Listen no more."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}

    def _want(self, number: int, _: Any) -> None:
        """Remember the first time; the second time the default applies."""
        self._wanted = True
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


class Throughput(Callback):
    """Logs patches per second, without the time of validations."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def on_train_start(self, *_: Any) -> None:
        """Begin."""
        self._start = time.perf_counter()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Batch, *_: Any
    ) -> None:
        """Log the speed of the batch, the time that it took to load included."""
        now = time.perf_counter()
        pl_module.log("train/patches_per_second", len(batch["rgb"]) * trainer.world_size / (now - self._start))
        self._start = now

    def on_validation_end(self, *_: Any) -> None:
        """Leave the validation out."""
        self._start = time.perf_counter()


class ValidationTable(Callback):
    """Keeps the scores of all validations in a file, to the last digit: step, set, metric, value.

    Args:
        path: of the file.

    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Add a pass; rows of later steps, of before an interruption, are dropped."""
        if not isinstance(pl_module, SuperResolution) or trainer.sanity_checking or not trainer.is_global_zero:
            return
        step, before = trainer.global_step, []
        if self._path.is_file():
            with self._path.open(newline="", encoding="utf-8") as file:
                before = list(csv.reader(file))[1:]
        rows = [[str(step), kind, name, repr(value)]
                for kind, each in pl_module.validation_scores.items() for name, value in each.items()]  # fmt: skip
        with replacing(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            kept = (row for row in before if int(row[0]) < step)
            csv.writer(file, lineterminator="\n").writerows([("step", "set", "metric", "value"), *kept, *rows])


class LastValidation(Callback):
    """Has the last step validated where the interval does not divide the steps.

    Args:
        interval: between validations, in steps.

    """

    def __init__(self, interval: int) -> None:
        self._interval = interval

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Let Lightning stop by itself, which it does with a validation."""
        if trainer.global_step == trainer.max_steps and trainer.global_step % self._interval:
            trainer.should_stop = True


class Log(TensorBoardLogger):
    """TensorBoard's log without the number of the epoch, of which there is one."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log all but that."""
        super().log_metrics({name: value for name, value in metrics.items() if name != "epoch"}, step)

    @rank_zero_only
    def list_run(self, settings: Mapping[str, Any]) -> None:
        """Put the run into TensorBoard's table of runs, with its settings and the latest scores of its validations."""
        self.log_hyperparams(dict(settings))
        scores = dict.fromkeys((f"val/{name}" for name in _IN_TABLE), 0.0)  # the names count, values come from the log
        for part in hparams(dict(settings), scores):
            self.experiment.file_writer.add_summary(part)


def make_trainer(
    settings: TrainerConfig, folder: Path, device: torch.device, console: Console, table: Mapping[str, Any]
) -> tuple[lightning.Trainer, ModelCheckpoint]:
    """Return the trainer, and the callback that knows the best checkpoint."""
    checkpoints = folder / "checkpoints"
    best = ModelCheckpoint(checkpoints, "best", monitor=MONITOR, mode="min", save_on_train_epoch_end=False)
    latest = ModelCheckpoint(
        checkpoints, "last", enable_version_counter=False, save_on_train_epoch_end=False
    )  # save_last=True keeps the best's
    interval = min(settings.validate_every, settings.steps)
    callbacks = [
        Throughput(),
        LastValidation(interval),
        ValidationTable(folder / VALIDATION),
        best,
        latest,
        LearningRateMonitor("step"),
        TrainingBar(console),
        Interruption(checkpoints / "last.ckpt"),
    ]
    logger = Log(folder, name="", version="tensorboard", default_hp_metric=False)
    logger.list_run(table)
    with without_chatter():
        trainer = lightning.Trainer(
            accelerator="gpu" if device.type == "cuda" else device.type,
            devices=_devices(settings, device),
            max_steps=settings.steps,
            accumulate_grad_batches=settings.accumulate,
            val_check_interval=interval * settings.accumulate,
            check_val_every_n_epoch=None,
            log_every_n_steps=min(10, interval),
            logger=logger,
            callbacks=callbacks,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
        )
    return trainer, best


def fit(trainer: lightning.Trainer, module: SuperResolution, data: Any, resume: Path | None) -> None:
    """Train; an interruption comes out as the KeyboardInterrupt that it is."""
    try:
        with without_chatter():
            trainer.fit(module, data, ckpt_path=resume, weights_only=True)
    except SystemExit:  # Lightning turns an interruption into an exit with code 1
        if not trainer.interrupted:
            raise
    if trainer.interrupted:
        raise KeyboardInterrupt


def seconds_per_step(module: SuperResolution, batch: Batch) -> float:
    """Return how long a step takes, measured; the module is left as it was."""
    batch = {name: value.to(module.device) for name, value in batch.items()}
    taken = 0.0
    for _ in range(2):  # the first one warms up
        start = time.perf_counter()
        module.loss_terms(batch)["loss"].backward()
        taken = time.perf_counter() - start
    module.net.zero_grad(set_to_none=True)
    return taken


@contextlib.contextmanager
def without_chatter() -> Iterator[None]:
    """Keep Lightning's tips, and its warnings of what is meant to be so, off the terminal."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*does not have many workers.*")
            warnings.filterwarnings("ignore", ".*smaller than the logging interval.*")
            warnings.filterwarnings("ignore", ".*sync_dist=True.*")  # metrics are the same on every device
            for resumed in ("exists and is not empty", "that ended before the epoch ended"):
                warnings.filterwarnings("ignore", f".*{resumed}.*")
            warnings.filterwarnings("ignore", ".*LeafSpec.*", FutureWarning)
            warnings.filterwarnings("ignore", ".*LeafSpec.*", DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)


def _devices(settings: TrainerConfig, device: torch.device) -> Any:
    """Return what Lightning is to be told of the devices."""
    if device.type == "cpu" and settings.devices == "auto":
        return 1
    if device.type != "cpu" and settings.devices == 1 and device.index is not None:
        return [device.index]
    return settings.devices
