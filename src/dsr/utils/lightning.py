"""Lightning for trainings and per-image optimisations: the trainer, its progress and its table of validations."""

from __future__ import annotations

import contextlib
import csv
import logging
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import ClusterEnvironment, LightningEnvironment

from dsr.utils.checkpoints import AtomicCheckpoints, Interruption
from dsr.utils.configuration import ConfigError, Node, build
from dsr.utils.console import one_line
from dsr.utils.files import FullDiskError, replacing, space_for
from dsr.utils.progress import Progress, Task, ignore
from dsr.utils.runs_table import SCORES, list_scores

LOG_EVERY = 10  # steps between two values of a training in its log
_UNITS = {"RMSE_d": " mm", "RMSE_v": "", "DSSIM_v": "", "LPIPS_v": ""}  # of scores that are shown; "" for thousandths
_SECONDS_BETWEEN_LOSSES = 0.2  # between two losses that are shown, each of which waits for the device


class ScoreTables(Callback):
    """Keeps the scores of validations: all of them in a file, the best in TensorBoard's table of runs.

    The file has the raw values to the last digit: step, set, metric and value. The module's ``validation_scores`` are
    in metres and fractions, ``shown_scores``, which are logged, in the units of tables; both by set and by metric.
    ``best`` has not yet seen the validation at hand; without it the last one is listed.
    """

    def __init__(self, path: Path, best: ModelCheckpoint | None = None) -> None:
        self._path, self._best = path, best

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Add the scores of a validation; rows of later steps, from before an interruption, are dropped."""
        if trainer.sanity_checking or not trainer.is_global_zero:
            return
        scored: Any = pl_module
        step, kept = trainer.global_step, []
        if self._path.is_file():
            with self._path.open(newline="", encoding="utf-8") as before:
                kept = [row for row in list(csv.reader(before))[1:] if int(row[0]) < step]
        for kind, scores in scored.validation_scores.items():
            kept += [[str(step), kind, name, repr(value)] for name, value in scores.items()]
        with replacing(self._path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([("step", "set", "metric", "value"), *kept])
        best = None if self._best is None else self._best.best_model_score
        if best is not None and trainer.callback_metrics[str(self._best.monitor)] >= best:  # type: ignore[union-attr]
            return
        scores = {name: value for name, value in scored.shown_scores.get("val", {}).items() if name in SCORES}
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                list_scores(logger.experiment, scores, step)


class StepProgress(Callback):
    """Shows the steps of a training with the latest loss, the scenes of a validation, and its scores.

    Lines about validations begin with the ``subject``, such as a scene's name.
    """

    def __init__(self, progress: Progress, name: str, subject: str = "") -> None:
        self._progress, self._name, self._subject = progress, name, f"{subject}: " if subject else ""
        self._stack, self._validation = contextlib.ExitStack(), contextlib.ExitStack()
        self._steps: Task = ignore
        self._scenes: Task = ignore
        self._fetched, self._validated = 0.0, 0

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Show the steps, beginning with the training's first one."""
        task = self._progress.task(self._name, int(trainer.max_steps), done=trainer.global_step)
        self._steps = self._stack.enter_context(task)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Show a step; the loss is fetched from the device a few times a second."""
        now, remark = time.monotonic(), None
        if now - self._fetched > _SECONDS_BETWEEN_LOSSES:
            self._fetched, remark = now, _loss_text(trainer)
        self._steps(trainer.global_step, remark=remark)

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin to show the scenes of a validation."""
        self._validated, total = 0, sum(int(count) for count in trainer.num_val_batches)
        self._scenes = self._validation.enter_context(self._progress.task("validate", total))

    def on_validation_batch_end(self, *_: Any) -> None:
        """Show a scene."""
        self._validated += 1
        self._scenes(self._validated)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Print the scores of the validation, and first those of bicubic interpolation."""
        self._validation.close()
        scored: Any = pl_module
        scores, bicubic = (
            "  ".join(f"{name} {each[name]:.1f}{unit}" for name, unit in _UNITS.items() if name in each)
            for each in (scored.shown_scores.get(kind, {}) for kind in ("val", "bicubic"))
        )
        if scores:
            parts = (f"{self._subject}step {trainer.global_step:>6}", _loss_text(trainer), f"validation: {scores}")
            self._progress.say("  ".join(filter(None, parts)))
        if bicubic and not trainer.global_step:
            self._progress.say(f"             bicubic:    {bicubic}")

    def on_train_end(self, *_: Any, **__: Any) -> None:
        """Stop showing anything."""
        self._validation.close()
        self._stack.close()

    on_exception = on_train_end


class LastValidation(Callback):
    """Validates after the last step if the interval in steps does not divide their number; the first callback."""

    def __init__(self, interval: int) -> None:
        self._interval = interval
        self.started = False  # and so what was to be restored is restored

    def on_train_start(self, *_: Any) -> None:
        """Note that the training starts."""
        self.started = True

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Let Lightning stop, which runs a validation."""
        if trainer.global_step == trainer.max_steps and trainer.global_step % self._interval:
            trainer.should_stop = True


def make_trainer(
    device: torch.device,
    steps: int,
    interval: int,
    *,
    callbacks: Sequence[Callback],
    node: Node | None = None,
    devices: int = 1,
    accumulate: int = 1,
    environment: ClusterEnvironment | None = None,
    **named: Any,
) -> lightning.Trainer:
    """Return a trainer for a number of steps, with a validation after every ``interval`` of them.

    The arguments of a ``node`` of the configuration go before those that are given here. Without an ``environment``
    Lightning starts the processes of several devices, whatever Slurm or MPI say.
    """
    given = {
        "accelerator": "gpu" if device.type == "cuda" else device.type,
        "devices": devices if device.type == "cpu" or device.index is None else [device.index],
        "max_steps": steps,
        "accumulate_grad_batches": accumulate,
        "val_check_interval": interval * accumulate,
        "check_val_every_n_epoch": None,
        "callbacks": [LastValidation(interval), *callbacks],
        "plugins": [AtomicCheckpoints(), environment or LightningEnvironment()],
        "use_distributed_sampler": False,
        "log_every_n_steps": min(LOG_EVERY, interval),
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "num_sanity_val_steps": 0,
        **named,
    }
    with without_chatter():
        if node is None:
            return lightning.Trainer(**given)
        return build("trainer", node, {key: value for key, value in given.items() if key not in node})


def fit(
    trainer: lightning.Trainer,
    module: lightning.LightningModule,
    data: Any,
    resume: Path | None = None,
    **named: Any,
) -> None:
    """Train; KeyboardInterrupt if it is interrupted, ConfigError if the checkpoint to go on from is none of it."""
    saving = next((each for each in trainer.checkpoint_callbacks if isinstance(each, Interruption)), None)
    before = signal.getsignal(signal.SIGINT)
    try:
        with without_chatter(), space_for(Path(trainer.log_dir or trainer.default_root_dir)):
            trainer.fit(module, data, ckpt_path=resume, weights_only=True, **named)
    except SystemExit:  # Lightning turns an interruption into an exit with code 1
        if not trainer.interrupted:
            raise
    except (OSError, FullDiskError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        if resume is None or any(isinstance(each, LastValidation) and each.started for each in callbacks):
            raise
        what = one_line(error).removeprefix(f"{resume}: ")
        raise ConfigError(
            f"{resume}: expected a checkpoint of this training, got a damaged or foreign one ({what:.200}); "
            "overwrite=true starts again"
        ) from error
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)  # which Lightning ignores after an interruption
    if trainer.interrupted:
        number = saving.signals[0] if saving is not None and saving.signals else signal.SIGINT
        if saving is not None and callable(signal.getsignal(number)):
            signal.raise_signal(number)  # to who else waits for it, such as submitit
        raise KeyboardInterrupt


def _loss_text(trainer: lightning.Trainer) -> str:
    """Return the loss of the last step; empty if there is none."""
    loss = trainer.callback_metrics.get("train/loss")
    return "" if loss is None else f"loss {float(loss):.4f}"


@contextlib.contextmanager
def without_chatter() -> Iterator[None]:
    """Keep Lightning's tips, and its warnings of what is intended, off the terminal."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"(lightning|torchmetrics)\.")
            warnings.filterwarnings("ignore", ".*LeafSpec.*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
