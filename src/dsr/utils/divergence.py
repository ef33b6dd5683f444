"""Trainings and optimisations that diverge: they stop, and nothing of the diverged network is kept.

A single batch can have a gradient that is not finite, such as one of a degenerate patch or of an unlucky rounding. A
training that leaves such a step out is not lost, so a few of them in a row are tolerated. Weights that are not finite,
or predictions without a finite depth, never become finite again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

PATIENCE = 10
"""Steps in a row without a finite loss and gradient after which a training that leaves them out has diverged."""
_LOSS, _NORM, _SCORE = "train/loss", "train/gradient_norm", "val/RMSE_d"


class DivergenceError(ValueError):
    """The network's numbers are no longer finite; the message says which, at which step and learning rate."""


class Divergence(Callback):
    """Ends a training whose loss, gradient, weights or predictions are not finite, before a checkpoint is written.

    Callbacks that keep something of a validation come after this one.

    Args:
        patience: steps in a row without a finite loss and gradient that end it; 1 for an optimisation that does not
            leave out such steps.

    """

    def __init__(self, patience: int = PATIENCE) -> None:
        self._patience, self._row = patience, 0

    @property
    def in_doubt(self) -> bool:
        """Whether the last step was without a finite loss and gradient."""
        return self._row > 0

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, *_: Any
    ) -> None:
        """Count the steps without a finite loss and gradient."""
        loss = outputs["loss"] if isinstance(outputs, Mapping) else outputs
        values = {"loss": loss, "norm of the gradient": trainer.callback_metrics.get(_NORM)}
        wrong = {name: float(value) for name, value in values.items() if value is not None and not _is_finite(value)}
        if not trainer.strategy.reduce_boolean_decision(bool(wrong), all=False):  # of any device
            self._row = 0
            return
        self._row += 1
        if self._row >= self._patience * trainer.accumulate_grad_batches:
            name, value = next(iter(wrong.items()), ("loss", math.nan))
            row = f" after {self._patience} steps in a row without finite numbers" if self._patience > 1 else ""
            raise _error(trainer, f"the {name} is {value:g}{row}")

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Check the validation's score of depth, which is NaN where a prediction has no finite depth.

        Before the first step it may be.
        """
        score = trainer.callback_metrics.get(_SCORE)
        if score is not None and not _is_finite(score) and trainer.global_step and not trainer.sanity_checking:
            raise _error(trainer, f"the validation's {_SCORE.partition('/')[2]} is {float(score):g}")

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Check the weights that are about to be kept."""
        for name, value in checkpoint["state_dict"].items():
            if torch.is_tensor(value) and value.is_floating_point() and not _is_finite(value):
                raise _error(trainer, f"the weights {name} are not finite")


def in_doubt(trainer: lightning.Trainer) -> bool:
    """Return whether the last step was without a finite loss and gradient, so that no checkpoint should replace one."""
    return any(isinstance(each, Divergence) and each.in_doubt for each in getattr(trainer, "callbacks", ()))


def _is_finite(value: Tensor) -> bool:
    return bool(torch.as_tensor(value).isfinite().all())


def _error(trainer: lightning.Trainer, what: str) -> DivergenceError:
    """Return the error of the current step."""
    rate = trainer.optimizers[0].param_groups[0]["lr"] if trainer.optimizers else math.nan
    return DivergenceError(f"diverged at step {trainer.global_step}: {what}, at a learning rate of {rate:.3g}")
