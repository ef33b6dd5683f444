"""Checkpoints with Lightning: atomic, at an interruption and every few minutes; and trainings that diverge.

Nothing of a diverged network is kept. A single batch can have a gradient that is not finite, such as one of a
degenerate patch or of an unlucky rounding. A training that leaves such a step out is not lost, so a few of them in a
row are tolerated. Weights that are not finite, or predictions without a finite depth, never become finite again.
"""

from __future__ import annotations

import contextlib
import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePath
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, EarlyStopping, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from dsr.utils import interruption
from dsr.utils.configuration import ConfigError
from dsr.utils.console import one_line
from dsr.utils.files import replacing
from dsr.utils.torch_files import read_torch_file

PATIENCE = 10
"""Steps in a row without a finite loss and gradient after which a training that leaves them out has diverged."""
_LOSS, _NORM, _SCORE = "train/loss", "train/gradient_norm", "val/RMSE_d"

_LIGHTNINGS = (ModelCheckpoint, EarlyStopping)
"""Callbacks that do not check what they restore."""
_FILES = ("best_model_path", "kth_best_model_path", "last_model_path")
"""What Lightning's callback that keeps checkpoints says of files, beside ``best_k_models``."""


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


class CheckpointError(ConfigError):
    """A checkpoint that a training cannot go on from.

    Args:
        path: the file.
        error: what reading or restoring it raised.

    """

    def __init__(self, path: Path, error: Exception) -> None:
        what = one_line(error).removeprefix(f"{path}: ")
        what = what if type(error) is ValueError else f"{type(error).__name__}: {what}"
        text = f"expected a checkpoint of this training, got a damaged or foreign one ({what:.200})"
        super().__init__(f"{path}: {text}; overwrite=true starts again")
        self._made_of = (path, error)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how a worker's is made anew in another process."""
        return type(self), self._made_of


_STEPS = (
    "loops", "fit_loop", "epoch_loop.automatic_optimization.optim_progress", "optimizer", "step", "total", "completed",
)  # fmt: skip
"""Where Lightning counts the steps that are done."""


class Resumed(Callback):
    """Lets a training go on from a state of its own kind alone; it is the last of the callbacks.

    Lightning and torch take over what a checkpoint has as attributes of their objects. Of what a new training has, a
    checkpoint may have other numbers, and nothing else: what is unknown is left out. Kernels that update some tensors
    at once do not check sizes: they would write beyond averages that are smaller than their weights. An optimiser and
    a schedule of their own then try a step with the state, so that a training does not fail at it later.

    Attributes:
        restoring: whether what is raised now is about the checkpoint, and not about the training.

    """

    def __init__(self) -> None:
        self.restoring = False

    def setup(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Record the structure of this training's optimiser and schedule states."""
        made: Any = pl_module.configure_optimizers()
        self._optimizer, node = (made["optimizer"], made["lr_scheduler"]) if isinstance(made, Mapping) else (made, None)
        self._schedules = [] if node is None else [node["scheduler"]]
        self._new = [each.state_dict() for each in self._schedules]
        with _tried(self._optimizer):
            self._own = copy.deepcopy(self._optimizer.state_dict())
        self.restoring = True

    def on_load_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Check the states of callbacks, loops, optimisers and schedules, before any is restored.

        Raises:
            ValueError: one is not of the training's kind.

        """
        states = _at(checkpoint, "optimizer_states")
        if not isinstance(states, list) or len(states) != 1:
            raise ValueError(f"optimizer_states: expected a list of 1, got {_kind(states)}")
        checkpoint["optimizer_states"] = [_fitting_optimizer(states[0], self._own, "optimizer_states.0")]
        schedules = _fitting(_at(checkpoint, "lr_schedulers"), self._new, "lr_schedulers")
        checkpoint["lr_schedulers"] = schedules
        _try_step(self._optimizer, checkpoint["optimizer_states"][0], self._schedules, schedules)
        loop = trainer.fit_loop.state_dict()
        progress = _fitting(_at(checkpoint, "loops", "fit_loop"), loop, "loops.fit_loop")
        _expect_counts(progress, loop, "loops.fit_loop")
        checkpoint["loops"] = {"fit_loop": progress}
        done = _at(checkpoint, *_STEPS)
        if 0 <= trainer.max_steps < done:  # which would end at once, as if complete
            raise ValueError(f"{'.'.join(_STEPS)}: expected at most {trainer.max_steps} steps, got {done}")
        states = checkpoint["callbacks"]
        own = {each.state_key: each for each in trainer.callbacks if each.state_key in states}  # type: ignore[attr-defined]
        checkpoint["callbacks"] = {
            key: _fitting(states[key], each.state_dict(), f"callbacks.{key}")
            if isinstance(each, _LIGHTNINGS)
            else states[key]
            for key, each in own.items()
        }
        checkpoint["callbacks"][self.state_key] = {"restoring": False}  # is loaded after the others
        del self._optimizer, self._schedules, self._new, self._own  # which take several times the weights' memory

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Note that the restoration is complete, apart from the values that were tried."""
        self.restoring = False


def _at(state: Any, *keys: str) -> Any:
    """Return an entry; ValueError where there is none."""
    for done, key in enumerate(keys, 1):
        if not isinstance(state, Mapping) or key not in state:
            raise ValueError(f"{'.'.join(keys[:done])}: missing")
        state = state[key]
    return state


def _fitting(value: Any, own: Any, place: str) -> Any:
    """Return of a state what a training's own one has, too; ValueError where that is of another kind or size."""
    if isinstance(own, Mapping) and isinstance(value, Mapping):
        known = own or dict.fromkeys(value)  # of what is empty at first, there may be any numbers
        return {key: _fitting(each, known[key], f"{place}.{key}") for key, each in value.items() if key in known}
    if isinstance(own, list | tuple) and isinstance(value, list | tuple) and len(value) == len(own):
        pairs = enumerate(zip(value, own, strict=True))
        return type(own)(_fitting(*each, f"{place}.{index}") for index, each in pairs)
    number = isinstance(value, float) or _is_whole(value) or (isinstance(value, Tensor) and not value.dim())
    if isinstance(own, Tensor) and own.dim():
        fits = isinstance(value, Tensor) and value.shape == own.shape
        fits = fits and value.is_floating_point() == own.is_floating_point()
    elif isinstance(own, bool | str):
        fits = isinstance(value, type(own)) or value is None
    else:
        fits = number if isinstance(own, Tensor | float | int) else own is None and (number or value is None)
        fits = fits or (own is None and isinstance(value, str))
    if not fits:
        raise ValueError(f"{place}: expected {_kind(own)}, got {_kind(value)}")
    if isinstance(own, Tensor) and isinstance(value, Tensor):  # as in memory, which such kernels take for granted, too
        return torch.empty_like(own, dtype=value.dtype).copy_(value)
    return value


def _kind(value: Any) -> str:
    """Return what a value is, for a message."""
    if isinstance(value, Tensor):
        return f"a tensor of {tuple(value.shape)}, {value.dtype}"
    size = f" of {len(value)}" if isinstance(value, list | tuple) else ""
    return f"{'a number' if value is None else type(value).__name__}{size}"


def _fitting_optimizer(value: Any, own: Any, place: str) -> dict[str, Any]:
    """Return an optimiser's state in an own one's form: its groups' settings but for the numbers, and their parameters.

    A parameter without a state has not had a gradient. Those of the history of LBFGS are as many as there are.
    """
    groups = _at(value, "param_groups")
    if not isinstance(groups, list) or len(groups) != len(own["param_groups"]):
        raise ValueError(f"{place}.param_groups: expected {_kind(own['param_groups'])}, got {_kind(groups)}")
    pairs = zip(groups, own["param_groups"], strict=True)
    fitting = [_settings(group, new, f"{place}.param_groups.{number}") for number, (group, new) in enumerate(pairs)]
    states, kept = _at(value, "state"), {}
    if not isinstance(states, Mapping):
        raise ValueError(f"{place}.state: expected dict, got {_kind(states)}")
    for key in (key for key in states if key in own["state"]):
        saved, new = states[key], own["state"][key]
        if "old_dirs" in new and isinstance(saved, Mapping):
            past = saved.get("old_dirs")
            history = len(past) if isinstance(past, list) else 0
            flat = {name: [new["d"]] * history for name in ("old_dirs", "old_stps")}
            new = {**new, **flat, "ro": [0.0] * history, "al": [None] * own["param_groups"][0]["history_size"]}
        kept[key] = _fitting(saved, new, f"{place}.state.{key}")
        step = float(kept[key].get("step", 0)) if isinstance(kept[key], Mapping) else 0
        if not 0 <= step < math.inf:
            raise ValueError(f"{place}.state.{key}.step: expected a number of steps, got {step:g}")
    return {"state": kept, "param_groups": fitting}


def _settings(group: Any, own: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return the settings of a group of parameters, with the numbers, which schedules change, of a saved one."""

    def taken(key: str, value: Any, new: Any) -> Any:
        if isinstance(new, list | tuple) and new:
            saved = _fitting(value, new, f"{place}.{key}")
            return type(new)(taken(key, *pair) for pair in zip(saved, new, strict=True))
        if not isinstance(new, Tensor | float) and not (_is_whole(new) and isinstance(value, float)):
            return new
        value = _fitting(value, new, f"{place}.{key}")
        if not math.isfinite(float(value)):
            raise ValueError(f"{place}.{key}: expected a finite number, got {float(value):g}")
        return value

    if not isinstance(group, Mapping) or group.get("params") != own["params"]:
        raise ValueError(f"{place}.params: expected those of this training, in their order")
    return {key: taken(key, group[key], new) if key in group else new for key, new in own.items()}


def _expect_counts(progress: Any, own: Any, place: str) -> None:
    """Check that what a loop counts is a whole number, 0 or more."""
    for key, value in progress.items():
        if isinstance(own.get(key), Mapping):
            _expect_counts(value, own[key], f"{place}.{key}")
        elif not isinstance(own.get(key, ""), bool | str) and not (_is_whole(value) and value >= 0):
            raise ValueError(f"{place}.{key}: expected a count, got {value!r:.40}")


@contextlib.contextmanager
def _tried(optimizer: torch.optim.Optimizer) -> Iterator[None]:
    """Do a step of an optimiser, with gradients of one; its weights are then as before."""
    weights = [each for group in optimizer.param_groups for each in group["params"]]
    before = [each.detach().clone() for each in weights]
    for each in weights:
        each.grad = torch.ones_like(each)
    try:
        optimizer.step(lambda: 0.0)
        yield
    finally:
        with torch.no_grad():
            for each, values in zip(weights, before, strict=True):
                each.copy_(values)
                each.grad = None


def _try_step(optimizer: torch.optim.Optimizer, state: Any, schedules: Any, states: Any) -> None:
    """Do a step from saved states; ValueError where that fails."""
    try:
        optimizer.load_state_dict(copy.deepcopy(state))
        for schedule, saved in zip(schedules, copy.deepcopy(states), strict=True):
            schedule.load_state_dict(saved)
        with _tried(optimizer):
            for schedule in schedules:
                if not isinstance(schedule, torch.optim.lr_scheduler.ReduceLROnPlateau):
                    schedule.step()
    except MemoryError:
        raise
    except Exception as error:  # the same step without them was done
        what = f"{type(error).__name__}: {one_line(error)}"
        raise ValueError(f"optimizer_states, lr_schedulers: expected those of a next step, got {what}") from error
    rates = [float(group["lr"]) for group in optimizer.param_groups if "lr" in group]
    if not all(map(math.isfinite, rates)):
        raise ValueError(f"lr_schedulers: expected finite learning rates of the next step, got {rates[0]:g}")


def _is_whole(value: Any) -> bool:
    """Return whether a value is a whole number that 64 bits hold."""
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


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


class Interruption(Checkpoint):
    """Saves a checkpoint every few minutes, and ends a training at Ctrl-C or SIGTERM with one of the step it is at.

    If a validation follows that step, it is done, too. Lightning calls checkpoint callbacks after all others, so that
    what those keep of the step is in the checkpoint. All devices save and end together.

    Args:
        path: the checkpoint's path.
        seconds: between two checkpoints.

    """

    def __init__(self, path: Path, seconds: float) -> None:
        self._path, self._seconds, self._saved = path, seconds, time.monotonic()
        self._stack = contextlib.ExitStack()
        self._signal: interruption.Deferred | None = None

    @property
    def requested(self) -> bool:
        """Whether this process was asked to end."""
        return self._signal is not None and self._signal.requested

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Only note signals from now on."""
        self._signal = self._stack.enter_context(interruption.deferred(self._message))

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Act once a step is complete that no validation follows; Lightning would skip that after an interruption."""
        batches = trainer.fit_loop.total_batch_idx + 1
        validates = trainer.should_stop or batches % (trainer.val_check_batch or 1) == 0
        if ends_step(trainer) and not validates:
            self._act(trainer)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Act once the validation of a step is complete."""
        if trainer.state.fn == TrainerFn.FITTING and trainer.global_step:
            self._act(trainer)

    def on_train_end(self, *_: Any) -> None:
        """Stop, if this was requested after the last step."""
        if self.requested:
            raise KeyboardInterrupt

    def on_exception(self, *_: Any) -> None:
        """Let signals act as before; Lightning does not call ``teardown`` after an exception."""
        self._stack.close()

    def teardown(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Let signals act as before."""
        self._stack.close()

    def _act(self, trainer: lightning.Trainer) -> None:
        """Save if it is time or if any process was asked to end, and in that case end."""
        due = time.monotonic() - self._saved > self._seconds
        agree = trainer.strategy.reduce_boolean_decision
        if not agree(due or self.requested, all=False):
            return
        ends = agree(self.requested, all=False)
        if not in_doubt(trainer):
            trainer.save_checkpoint(self._path)
        self._saved = time.monotonic()
        if ends:
            raise KeyboardInterrupt

    def _message(self) -> str:
        """Return the line of a process that ends in the middle of a step."""
        if self._path.is_file():
            return f"interrupted; {self._path} is the latest checkpoint, the same command continues from there"
        return "interrupted before the first checkpoint; the same command begins this again, what is finished is kept"


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints atomically, so that none is truncated, and reads plain values and tensors alone."""

    def load_checkpoint(self, path: Any, *_: Any, **__: Any) -> dict[str, Any]:
        """Return a training's checkpoint, on the CPU.

        Raises:
            ValueError: the file is damaged, holds other Python objects, or is none of a training.

        """
        content = read_torch_file(Path(path))
        if not isinstance(content, dict) or not isinstance(content.get("callbacks"), dict):
            raise ValueError(f"{path}: expected a checkpoint of a training")
        return content

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint."""
        with replacing(Path(path)) as temporary, temporary.open("wb") as file:
            torch.save(checkpoint, file)


def ends_step(trainer: lightning.Trainer) -> bool:
    """Return whether the batch that was done is the last one of a step."""
    return trainer.fit_loop.batch_idx % trainer.accumulate_grad_batches == trainer.accumulate_grad_batches - 1
