"""What surrounds the optimisation of one image: what it shows, what it keeps, what it will cost."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from dsr.methods.dip.optimisation import PriorOptimisation
from dsr.utils.lightning import save_checkpoint, scores_line
from dsr.utils.progress import Steps

_SECONDS_BETWEEN_CHECKPOINTS = 60.0
_SECONDS_BETWEEN_LOOKS = 0.2
_TEMPORARY = 1.6
"""What a step needs at its peak, relative to what the forward pass keeps for the backward pass; measured."""


class Display(Protocol):
    """Where an optimisation says what it is about to do and how far it is."""

    def say(self, line: str) -> None:
        """Show a line."""
        ...

    def steps(self, name: str, total: int, done: int) -> AbstractContextManager[Callable[[int, str], None]]:
        """Return a context whose value takes the number of steps done and a remark."""
        ...


class Silent:
    """Shows nothing, and calls ``progress``, if given, with the steps done and their total."""

    def __init__(self, progress: Steps | None = None) -> None:
        self._progress = progress

    def say(self, line: str) -> None:
        """Show nothing."""

    @contextlib.contextmanager
    def steps(self, name: str, total: int, done: int) -> Iterator[Callable[[int, str], None]]:
        """Report the steps; the last one, too, when all are done."""

        def update(now: int, _: str) -> None:
            if self._progress is not None:
                self._progress(now, total)

        yield update
        update(total, "")


class Provenance(Callback):
    """Keeps in each checkpoint what it came from."""

    def __init__(self, origin: str) -> None:
        self._origin = origin

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Write it down."""
        checkpoint["origin"] = self._origin


class Keep(Callback):
    """Saves a checkpoint once a minute."""

    def __init__(self, path: Path) -> None:
        self._path, self._last = path, time.monotonic()

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Save if it is time."""
        now = time.monotonic()
        if now - self._last > _SECONDS_BETWEEN_CHECKPOINTS:
            self._last = now
            save_checkpoint(trainer, self._path)


class Advance(Callback):
    """Shows the steps with their loss."""

    def __init__(self, display: Display, scene: str, total: int) -> None:
        self._display, self._scene, self._total = display, scene, total
        self._shown, self._stack = 0.0, contextlib.ExitStack()
        self._update: Callable[[int, str], None] = lambda _, __: None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin at the step that the optimisation begins with."""
        self._update = self._stack.enter_context(self._display.steps(self._scene, self._total, trainer.global_step))

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Move on; the loss is fetched from the device a few times a second."""
        now = time.monotonic()
        if now - self._shown > _SECONDS_BETWEEN_LOOKS:
            self._shown = now
            loss = trainer.callback_metrics.get("train/loss")
            self._update(trainer.global_step, "" if loss is None else f"{self._scene}, loss {float(loss):.4f}")

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Say the scores of the pass."""
        text = scores_line(trainer)
        if text:
            self._display.say(f"{self._scene}: step {trainer.global_step:>6}  {text}")

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Take the bar away."""
        self._stack.close()


def cost_of_step(module: PriorOptimisation) -> tuple[float, float]:
    """Return the seconds of a step, and the bytes that it and the optimiser need; the module is left as it was."""
    state, taken = module.generator.get_state(), 0.0
    kept: dict[int, int] = {}

    def pack(x: Tensor) -> Tensor:
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    for _ in range(2):  # the first one warms up
        kept.clear()
        start = time.perf_counter()
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            loss = module.objective(*module.answer(), module.problem)["loss"]
        loss.backward()
        loss.item()
        taken = time.perf_counter() - start
    module.zero_grad(set_to_none=True)
    module.generator.set_state(state)
    parameters = sum(each.numel() * each.element_size() for each in module.parameters())
    return taken, int(_TEMPORARY * sum(kept.values())) + 3 * parameters


def checkpoint_of(path: Path, origin: str) -> Path | None:
    """Return the checkpoint if there is one that came from the same problem and settings."""
    if not path.is_file():
        return None
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True).get("origin")
    except Exception:
        return None
    return path if stored == origin else None
