"""Checkpoints with Lightning: of the best validation, and of the latest step; and trainings that diverge.

A single batch can have a gradient that is not finite, such as one of a degenerate patch. A training that leaves such a
step out is not lost, so a few of them in a row are tolerated. Weights that are not finite never become finite again.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from dsr.utils import interruption
from dsr.utils.arrays import read_torch_file
from dsr.utils.files import replacing

_EVERY = 100  # steps between two looks at the numbers of a training, each of which waits for the device
_NORM, _SCORE = "train/gradient_norm", "val/RMSE_d"
_FILES = ("best_model_path", "kth_best_model_path", "last_model_path")  # as ModelCheckpoint calls them


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
    """Return the error of the latest step, or of one some steps ago."""
    rate = trainer.optimizers[0].param_groups[0]["lr"]
    return DivergenceError(f"diverged at step {trainer.global_step - ago}: {what}, at a learning rate of {rate:.3g}")


class BestCheckpoint(ModelCheckpoint):
    """Keeps ``best.ckpt``, of the lowest score; the first validation is that of the weights before the first step.

    A run goes on wherever it has been moved to.
    """

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
        """Save if it is time or if any process was asked to end, and in that case end."""
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
