"""Checkpoints of trainings and optimisations with Lightning: atomic, at an interruption, and every few minutes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.plugins.io import TorchCheckpointIO

from dsr.utils import interruption
from dsr.utils.builder import ConfigError
from dsr.utils.console import one_line
from dsr.utils.divergence import in_doubt
from dsr.utils.files import replacing

_FILES = ("best_model_path", "kth_best_model_path", "last_model_path")
"""What Lightning's callback that keeps checkpoints says of files, beside ``best_k_models``."""


class CheckpointError(ConfigError):
    """A checkpoint that a training cannot go on from.

    Args:
        path: the file.
        error: what reading it raised.

    """

    def __init__(self, path: Path, error: Exception) -> None:
        text = f"expected a checkpoint of this training, got a damaged or foreign one ({type(error).__name__})"
        super().__init__(f"{path}: {text}; overwrite=true begins anew")


class Resumed(Callback):
    """Tells whether a training has begun, that is, whether what it goes on from has been read."""

    def __init__(self) -> None:
        self.begun = False

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Note that it begins."""
        self.begun = True


class OwnFiles(Callback):
    """Lets a checkpoint name only files of the run's own directory of checkpoints, as Lightning removes what it names.

    Files are taken by their names alone, so that a run goes on wherever it has been moved to. What a checkpoint says of
    any other path, of a link or of a directory is dropped with all that the same callback has kept.

    Args:
        folder: the run's directory of checkpoints.
        say: shows a line.

    """

    def __init__(self, folder: Path, say: Callable[[str], None]) -> None:
        self._folder, self._say = folder, say

    def on_load_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Replace the paths, before any callback restores its state."""
        states = checkpoint["callbacks"]
        for key, state in list(states.items()):
            if not isinstance(state, Mapping) or not {*_FILES, "best_k_models"} & state.keys():
                continue
            try:
                states[key] = self._with_own_files(state)
            except ValueError as error:
                del states[key]
                self._say(f"note: {one_line(error)} is not taken from the checkpoint, only files in {self._folder} are")

    def _with_own_files(self, state: Mapping[str, Any]) -> dict[str, Any]:
        """Return the state of a callback that keeps checkpoints with the paths that its files have in this run."""
        folder = self._folder.resolve()

        def own(path: Any) -> str:
            given = PurePath(str(path))
            place = folder / given.name
            if str(given.parent) != str(state.get("dirpath", folder)) or place.is_symlink() or place.is_dir():
                raise ValueError(str(path))
            return str(place)

        files = {key: own(state[key]) if state[key] else "" for key in _FILES if key in state}
        kept = {own(path): score for path, score in state.get("best_k_models", {}).items()}
        if kept and files.get("kth_best_model_path") not in kept:
            raise ValueError("a list of files without the worst of them")
        return {**state, **files, "best_k_models": kept, "dirpath": str(folder)}


class Interruption(Callback):
    """Ends a training at Ctrl-C or SIGTERM with a checkpoint of the step that it is at, once that is complete.

    If a validation follows that step, it ends between two scenes of the validation, which is done again later. Only the
    validation after the last step is waited for, as nothing would be left to do again.

    Of several processes, the states of which are the same, the first one acts upon the signal, and the others end with
    it.

    Args:
        path: the checkpoint's path.

    Attributes:
        requested: whether this process was asked to end, also if it does not act upon that.

    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack = contextlib.ExitStack()
        self._interruption: interruption.Deferred | None = None
        self.requested, self._acts = False, True
        self._checkpoint: dict[str, Any] | None = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Only note signals from now on."""
        self._acts = trainer.is_global_zero
        self._interruption = self._stack.enter_context(interruption.deferred(self._message))

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Save and stop, if an interruption was requested, a step is complete and no validation follows."""
        batches = trainer.fit_loop.total_batch_idx + 1
        validates = trainer.should_stop or batches % (trainer.val_check_batch or 1) == 0
        if self._requested and ends_step(trainer) and not validates:
            if not in_doubt(trainer):
                save_alone(trainer, self._path)
            raise KeyboardInterrupt

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Do not count the batch twice that was begun before an interruption; Lightning would skip a later one."""
        loop = trainer.fit_loop.epoch_loop.val_loop
        if loop.restarted_mid_evaluation:
            total: Any = loop.batch_progress.total
            total.ready, total.started = total.ready - 1, total.started - 1

    def on_validation_batch_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, batch: Any, batch_idx: int, *_: Any
    ) -> None:
        """Save the state at the beginning of the validation and stop, if an interruption was requested.

        Before the first step there is nothing to save.
        """
        if trainer.should_stop or trainer.global_step >= trainer.max_steps:
            return
        if self._checkpoint is None and trainer.global_step:
            self._checkpoint = _of_begun_validation(trainer)
        if self._requested:
            if self._checkpoint is not None and not in_doubt(trainer):
                trainer.strategy.save_checkpoint(self._checkpoint, self._path)
            raise KeyboardInterrupt

    def on_validation_end(self, *_: Any) -> None:
        """Forget the beginning of the validation."""
        self._checkpoint = None

    def on_train_end(self, *_: Any) -> None:
        """Stop, if an interruption was requested during the last validation."""
        if self._requested:
            raise KeyboardInterrupt

    def on_exception(self, *_: Any) -> None:
        """Let signals act as before; Lightning does not call ``teardown`` after an exception."""
        self._close()

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Let signals act as before."""
        self._close()

    def _message(self) -> str:
        """Return the line of a process that ends in the middle of a step."""
        if self._path.is_file():
            return f"interrupted; {self._path} is the latest checkpoint, the same command goes on from there"
        return "interrupted before the first checkpoint; the same command begins this again, what is finished is kept"

    def _close(self) -> None:
        if self._interruption is not None:
            self.requested = self._interruption.requested
        self._stack.close()
        self._interruption = self._checkpoint = None

    @property
    def _requested(self) -> bool:
        """Whether a signal came that this process acts upon."""
        return self._acts and self._interruption is not None and self._interruption.requested


def _of_begun_validation(trainer: lightning.Trainer) -> dict[str, Any]:
    """Return the checkpoint of a validation that is about to do its first batch; its values are not copied.

    Lightning goes on with a validation if a batch of it was started, beginning with the first that is not complete.
    """
    checkpoint = trainer._checkpoint_connector.dump_checkpoint(weights_only=False)
    checkpoint["loops"]["fit_loop"]["epoch_loop.val_loop.batch_progress"]["total"]["started"] += 1
    return checkpoint


class Keep(Callback):
    """Saves a checkpoint every few minutes, for when the process is killed.

    Args:
        path: the checkpoint's path.
        seconds: between two checkpoints.

    """

    def __init__(self, path: Path, seconds: float) -> None:
        self._path, self._seconds, self._last = path, seconds, time.monotonic()

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Save a checkpoint if it is time, and no gradient is being accumulated."""
        now = time.monotonic()
        if now - self._last > self._seconds and ends_step(trainer) and not in_doubt(trainer):
            self._last = now
            save_alone(trainer, self._path)


def save_alone(trainer: lightning.Trainer, path: Path) -> None:
    """Save a checkpoint from the first process; the others, which do not know of it, are not waited for."""
    if trainer.is_global_zero:
        trainer.strategy.save_checkpoint(trainer._checkpoint_connector.dump_checkpoint(weights_only=False), path)


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints atomically, so that none is truncated."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint."""
        with replacing(Path(path)) as temporary, temporary.open("wb") as file:
            torch.save(checkpoint, file)


def ends_step(trainer: lightning.Trainer) -> bool:
    """Return whether the batch that was done is the last one of a step."""
    return trainer.fit_loop.batch_idx % trainer.accumulate_grad_batches == trainer.accumulate_grad_batches - 1
