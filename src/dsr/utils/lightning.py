"""Lightning for trainings and per-image optimisations: the trainer, progress, interruption, logs."""

from __future__ import annotations

import contextlib
import csv
import logging
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import ClusterEnvironment, LightningEnvironment

from dsr.utils import interruption
from dsr.utils.checkpoints import AtomicCheckpoints, CheckpointError, DivergenceError, Interruption, Resumed
from dsr.utils.configuration import ConfigError
from dsr.utils.files import FullDiskError, replacing, space_for
from dsr.utils.guards import MOST_TABLE, read_limited
from dsr.utils.progress import Progress, Task
from dsr.utils.runs_table import SCORES, list_scores

_COLUMNS = 4
"""Columns of a table of validations."""
LOG_EVERY = 10
"""Steps between two values of a training in its log."""
_SECONDS_BETWEEN_LOSSES = 0.2
"""Between two losses that are fetched from the device to be shown, each of which waits for it."""


NOT_OF_A_CALLBACK = (OSError, FullDiskError, ConfigError, DivergenceError, MemoryError, torch.OutOfMemoryError)
"""Errors of a training that neither its checkpoint nor its callbacks have a part in."""
_LOST = ("Connection closed", "Connection reset", "Broken pipe")
"""What gloo says when another process is gone."""


class LostProcessError(ConfigError):
    """Another process of a training on several devices has ended.

    Args:
        error: what a communication with it raised.

    """

    def __init__(self, error: Exception) -> None:
        text = str(error).partition("]")[2] or str(error)
        reason = text.strip().partition("\n")[0].partition(". ")[0]
        super().__init__(
            f"another process of the training ended ({reason}); the same command continues from the latest checkpoint"
        )


class Scored(Protocol):
    """A module that keeps the scores of its last validation, and those that it is compared with: by set, by metric.

    ``validation_scores`` are in metres and fractions, ``shown_scores``, which are logged, in the units of tables.
    """

    validation_scores: dict[str, dict[str, float]]
    shown_scores: dict[str, dict[str, float]]


class ValidationTable(Callback):
    """Keeps the raw scores of all validations of a :class:`Scored` module in a file, to the last digit.

    Its columns are step, set, metric and value.

    Args:
        path: the file's path.

    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Add the scores of a validation; rows of later steps, from before an interruption, are dropped."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        scored: Any = pl_module
        step, before = trainer.global_step, self._read()
        rows = [[str(step), kind, name, repr(value)]
                for kind, each in scored.validation_scores.items() for name, value in each.items()]  # fmt: skip
        with replacing(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            kept = (row for row in before if int(row[0]) < step)
            csv.writer(file, lineterminator="\n").writerows([("step", "set", "metric", "value"), *kept, *rows])

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Check the rows from before an interruption."""
        self._read()

    def _read(self) -> list[list[str]]:
        """Return the rows without their names; ConfigError where they are none."""
        if not self._path.is_file():
            return []
        try:
            rows = list(csv.reader(read_limited(self._path, MOST_TABLE).decode().splitlines()))[1:]
            if all(len(row) == _COLUMNS and int(row[0]) >= 0 for row in rows):
                return rows
        except (ValueError, OSError, csv.Error):
            pass
        raise ConfigError(f"{self._path}: expected the scores of a training's validations, got a damaged file")


class ListedScores(Callback):
    """Keeps the scores in TensorBoard's table of runs up to date: those of the validation that the result is from.

    Args:
        best: keeps the best checkpoint, whose validation it is; None for the last one.

    """

    def __init__(self, best: ModelCheckpoint | None = None) -> None:
        self._best = best

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the scores, unless those of an earlier validation are better."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        scored: Any = pl_module
        scores = {name: value for name, value in scored.shown_scores.get("val", {}).items() if name in SCORES}
        best = None if self._best is None else self._best.best_model_score  # so far: checkpoints are the last callbacks
        if best is not None and trainer.callback_metrics[str(self._best.monitor)] >= best:  # type: ignore[union-attr]
            return
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                list_scores(logger.experiment, scores, trainer.global_step)


class LastValidation(Callback):
    """Validates after the last step if the interval does not divide the number of steps.

    Args:
        interval: between validations, in steps.

    """

    def __init__(self, interval: int) -> None:
        self._interval = interval

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Let Lightning stop, which runs a validation."""
        if trainer.global_step == trainer.max_steps and trainer.global_step % self._interval:
            trainer.should_stop = True


class StepProgress(Callback):
    """Shows the steps of a training with the latest loss, the scenes of a validation, and its scores.

    Args:
        progress: where they are shown.
        name: the name of the steps, such as ``train``.
        subject: the beginning of lines about validations, such as a scene's name; empty for none.

    """

    def __init__(self, progress: Progress, name: str, subject: str = "") -> None:
        self._progress, self._name, self._subject = progress, name, subject
        self._stack = contextlib.ExitStack()
        self._validation = contextlib.ExitStack()
        self._steps: Task | None = None
        self._scenes: Task | None = None
        self._fetched, self._validated = 0.0, 0

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Show the steps, beginning with the training's first one."""
        task = self._progress.task(self._name, int(trainer.max_steps), done=trainer.global_step)
        self._steps = self._stack.enter_context(task)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Show a step; the loss is fetched from the device a few times a second."""
        if self._steps is None:
            return
        now, remark = time.monotonic(), None
        if now - self._fetched > _SECONDS_BETWEEN_LOSSES:
            self._fetched, remark = now, _loss_text(trainer)
        self._steps(trainer.global_step, remark=remark)

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin to show the scenes of a validation."""
        total = sum(int(count) for count in trainer.num_val_batches)
        self._validated = 0
        self._scenes = self._validation.enter_context(self._progress.task("validate", total))

    def on_validation_batch_end(self, *_: Any) -> None:
        """Show a scene."""
        self._validated += 1
        if self._scenes is not None:
            self._scenes(self._validated)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Print the scores of the validation."""
        self._validation.close()
        scored: Any = pl_module
        scores = scores_line(scored.shown_scores.get("val", {}))
        if scores:
            subject = f"{self._subject}: " if self._subject else ""
            parts = (f"{subject}step {trainer.global_step:>6}", _loss_text(trainer), f"validation: {scores}")
            self._progress.say("  ".join(filter(None, parts)))
        bicubic = scores_line(scored.shown_scores.get("bicubic", {}))
        if bicubic and not trainer.global_step:
            self._progress.say(f"             bicubic:    {bicubic}")

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Stop showing steps."""
        self._close()

    def on_exception(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, _: BaseException) -> None:
        """Stop showing progress."""
        self._close()

    def _close(self) -> None:
        """Stop showing anything."""
        self._validation.close()
        self._stack.close()


def make_trainer(
    device: torch.device,
    steps: int,
    interval: int,
    *,
    callbacks: Sequence[Callback],
    devices: int = 1,
    accumulate: int = 1,
    environment: ClusterEnvironment | None = None,
    make: Callable[..., lightning.Trainer] | None = None,
    **named: Any,
) -> lightning.Trainer:
    """Return a trainer for a number of steps, with a validation after every few and after the last one.

    Args:
        device: to train on.
        steps: of the training.
        interval: steps between two validations.
        callbacks: of Lightning.
        devices: how many devices of that kind to train on.
        accumulate: batches of a step.
        environment: what Lightning learns of the processes of several devices from; None where it starts them itself,
            whatever Slurm or MPI say.
        make: function that makes the trainer; None for :class:`lightning.Trainer`.
        **named: its other arguments.

    """
    with without_chatter():
        defaults = {
            "log_every_n_steps": min(LOG_EVERY, interval), "enable_progress_bar": False, "enable_model_summary": False,
            "num_sanity_val_steps": 0,
        }  # fmt: skip
        return (make or lightning.Trainer)(
            accelerator="gpu" if device.type == "cuda" else device.type,
            devices=_lightning_devices(device, devices),
            max_steps=steps,
            accumulate_grad_batches=accumulate,
            val_check_interval=interval * accumulate,
            check_val_every_n_epoch=None,
            callbacks=[LastValidation(interval), *callbacks],
            plugins=[AtomicCheckpoints(), environment or LightningEnvironment()],
            use_distributed_sampler=False,
            **{**defaults, **named},
        )


def fit(
    trainer: lightning.Trainer,
    module: lightning.LightningModule,
    data: Any,
    resume: Path | None = None,
    **named: Any,
) -> None:
    """Train.

    Raises:
        KeyboardInterrupt: the training was interrupted.
        FullDiskError: there is no space for its log or a checkpoint.
        CheckpointError: the checkpoint to go on from is damaged, or one of another training.
        LostProcessError: another process of it has ended, and this one has not been interrupted.

    """
    resumed = Resumed()
    if resume is not None:
        trainer.callbacks.append(resumed)  # type: ignore[attr-defined]
    try:
        with without_chatter(), space_for(Path(trainer.log_dir or trainer.default_root_dir)):
            trainer.fit(module, data, ckpt_path=resume, weights_only=True, **named)
    except SystemExit:  # Lightning turns an interruption into an exit with code 1
        if not trainer.interrupted:
            raise
    except Exception as error:
        if _follows_interruption(error):  # Lightning's teardown fails if the interruption met its setup
            raise KeyboardInterrupt from error
        if _is_lost(error):
            if any(each.requested for each in trainer.callbacks if isinstance(each, Interruption)):  # type: ignore[attr-defined]
                raise KeyboardInterrupt from error  # the first process has saved the step
            raise LostProcessError(error) from error
        if resume is None or not resumed.restoring or isinstance(error, NOT_OF_A_CALLBACK):
            raise
        raise CheckpointError(resume, error) from error
    finally:
        interruption.reinstall()  # Lightning ignores SIGINT after an interruption
    if trainer.interrupted:
        raise KeyboardInterrupt


def _follows_interruption(error: BaseException | None) -> bool:
    """Return whether an error arose while an interruption was handled."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _is_lost(error: Exception) -> bool:
    """Return whether an error says that another process of the training is gone."""
    if not torch.distributed.is_available():
        return False
    gone = isinstance(error, RuntimeError) and "gloo" in str(error) and any(text in str(error) for text in _LOST)
    return gone or isinstance(error, torch.distributed.DistError)


def _lightning_devices(device: torch.device, count: int) -> Any:
    """Return the devices for Lightning: their number, or a list of one."""
    if device.type != "cpu" and count == 1 and device.index is not None:
        return [device.index]
    return count


def _loss_text(trainer: lightning.Trainer) -> str:
    """Return the loss of the last step; empty if there is none."""
    loss = trainer.callback_metrics.get("train/loss")
    return "" if loss is None else f"loss {float(loss):.4f}"


def scores_line(scores: Mapping[str, float]) -> str:
    """Return the main ones of scores in the units of tables, mm and 1/1000, for a reader; empty if there are none."""
    units = {"RMSE_d": " mm", "RMSE_v": "", "DSSIM_v": "", "LPIPS_v": ""}
    return "  ".join(f"{name} {scores[name]:.1f}{unit}" for name, unit in units.items() if name in scores)


@contextlib.contextmanager
def without_chatter() -> Iterator[None]:
    """Keep Lightning's tips, and its warnings of what is intended, off the terminal."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*does not have many workers.*")
            warnings.filterwarnings("ignore", ".*smaller than the logging interval.*")
            warnings.filterwarnings("ignore", ".*sync_dist=True.*")  # metrics are the same on every device
            warnings.filterwarnings("ignore", ".*was called before the ``update``.*")  # devices may have no scene
            for resumed in ("exists and is not empty", "that ended before the epoch ended", "dirpath has changed"):
                warnings.filterwarnings("ignore", f".*{resumed}.*")
            warnings.filterwarnings("ignore", ".*`srun` command is available.*")  # a sweep's or a login node's Slurm
            warnings.filterwarnings("ignore", ".*callbacks used to create the checkpoint.*")  # shows a stranger's names
            warnings.filterwarnings("ignore", ".*LeafSpec.*", FutureWarning)
            warnings.filterwarnings("ignore", ".*LeafSpec.*", DeprecationWarning)
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
