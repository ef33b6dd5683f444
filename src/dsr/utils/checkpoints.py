"""Lightning for trainings and per-image optimisations: the trainer, its checkpoints, progress and table of validations.

A single batch can have a gradient that is not finite, such as one of a degenerate patch. A training that leaves such a
step out is not lost, so a few of them in a row are tolerated. Weights that are not finite never become finite again.
"""

import contextlib
import csv
import logging
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import ClusterEnvironment, LightningEnvironment
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from dsr.utils import interruption
from dsr.utils.arrays import read_torch_file
from dsr.utils.configuration import ConfigError, Node, build
from dsr.utils.console import one_line
from dsr.utils.files import FullDiskError, replacing, space_for
from dsr.utils.progress import Progress, Task, ignore
from dsr.utils.runs_table import SCORES, list_scores

LOG_EVERY = 10  # steps between two values of a training in its log
_EVERY = 100  # steps between two looks at the numbers of a training, each of which waits for the device
_NORM, _SCORE = "train/gradient_norm", "val/RMSE_d"
_FILES = ("best_model_path", "kth_best_model_path", "last_model_path")  # as ModelCheckpoint calls them
_UNITS = {"RMSE_d": " mm", "RMSE_v": "", "DSSIM_v": "", "LPIPS_v": ""}  # of scores that are shown; "" for thousandths
_SECONDS_BETWEEN_LOSSES = 0.2  # between two losses that are shown, each of which waits for the device


class DivergenceError(ValueError):
    """The network's numbers are no longer finite; the message says which, at which step and learning rate."""


class Divergence(Callback):
    """Ends a training whose losses, weights or predictions are not finite, before a checkpoint is written.

    The numbers are read every 100 steps, after validations and before checkpoints. Callbacks that keep something of a
    validation come after this one. ``patience`` steps in a row without a finite loss and gradient end the training.
    """

    def __init__(self, patience: int = 10) -> None:
        self._patience, self._row = patience, torch.zeros(())

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, *_: Any
    ) -> None:
        """Count the batches in a row without a finite loss and gradient, on the device."""
        loss = outputs["loss"] if isinstance(outputs, Mapping) else outputs
        fine = loss.detach().isfinite().all()
        if _NORM in trainer.callback_metrics:
            fine = fine & trainer.callback_metrics[_NORM].isfinite()
        self._row = torch.where(fine, 0.0, self._row.to(fine.device) + 1)
        if trainer.global_step % _EVERY == 0:
            self._expect_finite_steps(trainer)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Check the steps and the validation's RMSE_d, which may be NaN before the first step."""
        if trainer.sanity_checking or not trainer.global_step:
            return
        self._expect_finite_steps(trainer)
        score = trainer.callback_metrics.get(_SCORE)
        if score is not None and not bool(score.isfinite()):
            raise _error(trainer, f"the validation's RMSE_d is {float(score):g}")

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Check the steps and the weights that are about to be kept."""
        self._expect_finite_steps(trainer)
        for name, value in checkpoint["state_dict"].items():
            if isinstance(value, Tensor) and not bool(value.isfinite().all()):
                raise _error(trainer, f"the weights {name} are not finite")

    def _expect_finite_steps(self, trainer: lightning.Trainer) -> None:
        """Raise DivergenceError if there were too many steps without a finite loss and gradient on any device."""
        row: Any = trainer.strategy.reduce(self._row, reduce_op="max")
        steps = int(row) // trainer.accumulate_grad_batches
        if steps >= self._patience:
            raise _error(trainer, "the loss or its gradient is not finite from there on", steps - 1)


def _error(trainer: lightning.Trainer, what: str, ago: int = 0) -> DivergenceError:
    rate = trainer.optimizers[0].param_groups[0]["lr"]
    return DivergenceError(f"diverged at step {trainer.global_step - ago}: {what}, at a learning rate of {rate:.3g}")


class BestCheckpoint(ModelCheckpoint):
    """Keeps ``best.ckpt``, of the lowest score; the first validation is that of the weights before the first step."""

    def __init__(self, folder: Path, monitor: str) -> None:
        super().__init__(folder, "best", monitor=monitor, enable_version_counter=False, save_on_train_epoch_end=False)
        # with 0, ModelCheckpoint._should_skip_saving_checkpoint would leave out the weights of step 0
        self._last_global_step_saved = -1

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Validate the initial weights without any effect on the steps; they may be the best ones."""
        super().on_train_start(trainer, pl_module)
        if not trainer.global_step:
            with isolate_rng():
                trainer.validating = True
                trainer.fit_loop.epoch_loop.val_loop.run()
                trainer.training = True

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the score; the file is the run's own, whatever a checkpoint says."""
        score = state_dict["best_model_score"]
        if score is not None:
            self.best_model_path = self.kth_best_model_path = self.format_checkpoint_name({})
            self.best_model_score = self.kth_value = score
            self.best_k_models = {self.best_model_path: score}


class Interruption(Checkpoint):
    """Saves a checkpoint after validations and every few minutes; at Ctrl-C or SIGTERM, of the step at hand, and ends.

    If a validation follows that step, it is done, too. All devices save and end together. Lightning calls checkpoint
    callbacks after all others, so that what those keep of the step is in the checkpoint.
    """

    def __init__(self, path: Path, seconds: float = 600.0) -> None:
        self._path, self._seconds, self._saved = path, seconds, time.monotonic()
        self._stack, self.signals = contextlib.ExitStack(), list[int]()

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Only note signals from now on."""
        self.signals = self._stack.enter_context(interruption.deferred())

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Act once a step is complete that no validation follows; Lightning would skip that after an interruption."""
        batches = trainer.fit_loop.total_batch_idx + 1
        validates = trainer.should_stop or batches % (trainer.val_check_batch or 1) == 0
        if ends_step(trainer) and not validates:
            self._act(trainer, due=time.monotonic() - self._saved > self._seconds)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save the step whose validation is complete."""
        if trainer.state.fn == TrainerFn.FITTING and trainer.global_step:
            self._act(trainer, due=True)

    def on_train_end(self, *_: Any) -> None:
        """Stop, if this was requested after the last step."""
        if self.signals:
            raise KeyboardInterrupt

    def teardown(self, *_: Any, **__: Any) -> None:
        """Let signals act as before."""
        self._stack.close()

    on_exception = teardown  # after which Lightning does not call ``teardown``

    def _act(self, trainer: lightning.Trainer, *, due: bool) -> None:
        agree = trainer.strategy.reduce_boolean_decision
        ends = agree(bool(self.signals), all=False)
        if (ends or agree(due, all=False)) and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            trainer.save_checkpoint(self._path)
            self._saved = time.monotonic()
        if ends:
            raise KeyboardInterrupt


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints by way of a temporary file beside them, and reads plain values and tensors alone."""

    def load_checkpoint(self, path: Any, *_: Any, **__: Any) -> dict[str, Any]:
        """Return a checkpoint; refuse one that names files outside its directory, as Lightning removes files."""
        content: dict[str, Any] = read_torch_file(Path(path))
        for state in content["callbacks"].values():
            files = [state.get(key) or "" for key in _FILES] if isinstance(state, Mapping) else []
            if any(".." in Path(each).parts for each in (*files, *(state.get("best_k_models") or () if files else ()))):
                raise ValueError("callbacks: expected files of the run's own, got others")
        return content

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint."""
        with replacing(Path(path)) as temporary:
            torch.save(checkpoint, temporary)


def ends_step(trainer: lightning.Trainer) -> bool:
    """Return whether the batch that was done is the last one of a step."""
    return trainer.fit_loop.batch_idx % trainer.accumulate_grad_batches == trainer.accumulate_grad_batches - 1


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
    """Shows the steps of a training with the latest loss, and validations, in lines that begin with a ``subject``."""

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
