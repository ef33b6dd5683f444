"""Training of super-resolution networks with Lightning."""

import copy
import functools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import lightning
import torch
import torchmetrics
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR, LRScheduler
from torch.optim.swa_utils import get_ema_multi_avg_fn

from dsr.geometry.surface import comparison
from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.networks.weight_files import make_network
from dsr.metrics.classes import compute_means, in_table_units, visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import Unit
from dsr.training.callbacks import Curves, log_picture
from dsr.training.degradation import Batch
from dsr.training.objective import Objective, to_depth
from dsr.utils.arrays import read_torch_file
from dsr.utils.configuration import load_object
from dsr.utils.guards import refusing

ADAMW = functools.partial(torch.optim.AdamW, lr=1e-3, weight_decay=1e-4)
_RENDERED_SCENES = 4  # number of scenes of each validation set that are rendered for TensorBoard
_TRUSTED = ("dsr.", "torch.optim.")
# The kinds of the parts that a checkpoint names
_PARTS = {"net": DisparityNetwork, "objective": Objective, "optimizer": torch.optim.Optimizer, "scheduler": LRScheduler}


class WarmupCosine(LambdaLR):
    """Linear warm-up to the optimiser's learning rate, then its decay to zero as a cosine over the other ``steps``."""

    def __init__(self, optimizer: torch.optim.Optimizer, steps: int, warmup: int = 300) -> None:
        if warmup < 0:
            raise ValueError(f"warmup: expected 0 or more, got {warmup}")

        def factor(step: int) -> float:
            if step < warmup:
                return (step + 1) / warmup
            return 0.5 * (1 + math.cos(math.pi * min((step - warmup) / max(steps - warmup, 1), 1.0)))

        super().__init__(optimizer, factor)


class SuperResolution(lightning.LightningModule):
    """The training of a network of disparities, under any :class:`lightning.Trainer`.

    The averaged weights are what is validated, tested and used. Under ``precision="bf16-mixed"`` the network's
    convolutions run in bfloat16, the loss and the metrics in their own precision.

    Validations log the scores of the network, ``val/METRIC``, and of bicubic interpolation of the same maps,
    ``bicubic/METRIC``, which are computed in the first validation.

    ``scheduler`` makes the schedule of an optimiser, which is updated after every step; ``average`` is the decay of the
    moving average of the weights, smaller in the first steps, 0 for the weights themselves; ``validation_sets`` are
    names, in the order of the loaders.
    """

    logs_curves = True  # adds the callback Curves, unless the trainer has one

    def __init__(
        self,
        net: DisparityNetwork,
        objective: Objective,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = ADAMW,
        scheduler: Callable[[torch.optim.Optimizer], LRScheduler] | None = None,
        *,
        average: float = 0.999,
        metrics: Callable[[], torchmetrics.MetricCollection] = visual_metrics,
        validation_sets: Sequence[str] = ("val",),
    ) -> None:
        super().__init__()
        if not net.covers:
            raise ValueError("model: expected a network that covers the whole image, its variant leaves out pixels")
        if not 0 <= average < 1:
            raise ValueError(f"average: expected 0 or more and less than 1, got {average}")
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = copy.deepcopy(self.net).requires_grad_(False)
        self.objective, self.decay = objective, average
        self._make_optimizer, self._make_scheduler = optimizer, scheduler
        self.sets = tuple(validation_sets)
        self.metrics = nn.ModuleList(metrics() for _ in self.sets)
        self._make_metrics = metrics
        self._bicubic_metrics: list[torchmetrics.MetricCollection] = []
        self.bicubic: dict[str, dict[str, float]] = {}
        self.validation_scores: dict[str, dict[str, float]] = {}
        self.shown_scores: dict[str, dict[str, float]] = {}
        self._pictures: dict[str, Tensor] = {}

    def configure_callbacks(self) -> list[Callback]:
        """Return the callback that logs losses and speed, unless the trainer has one, which Lightning would replace."""
        callbacks: list[Callback] = self.trainer.callbacks  # type: ignore[attr-defined]
        return [Curves()] if self.logs_curves and not any(isinstance(each, Curves) for each in callbacks) else []

    def forward(self, batch: Batch) -> Tensor:
        """Return high-resolution depth by the averaged weights, (B, 1, H, W) in metres; NaN where there is none."""
        with torch.autocast(self.device.type, enabled=False):
            return to_depth(self.average.answer_scene(batch).to(batch["disparity_lr"].dtype), batch)

    def training_step(self, batch: Batch, _: int = 0) -> Tensor:
        """Return the loss of a batch of patches."""
        terms = self.loss_terms(batch)
        self.log_dict({f"train/{name}": value.detach() for name, value in terms.items()}, logger=False)
        return terms["loss"]

    def loss_terms(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms."""
        answer = self.net.answer_patches(batch)
        with torch.autocast(self.device.type, enabled=False):
            return self.objective(answer, batch)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradient and log its norm; drop a gradient that is not finite, so that the step changes nothing."""
        by_norm = gradient_clip_algorithm != "value" and gradient_clip_val is not None
        norm = nn.utils.clip_grad_norm_(self.net.parameters(), gradient_clip_val if by_norm else math.inf)  # type: ignore[arg-type]
        if gradient_clip_val is not None and not by_norm:
            nn.utils.clip_grad_value_(self.net.parameters(), gradient_clip_val)
        self.log("train/gradient_norm", norm.detach(), logger=False)
        if optimizer.defaults.get("fused"):  # such an optimiser drops a step by a flag, which nothing waits for
            optimizer.found_inf = (~norm.isfinite()).float()  # type: ignore[attr-defined]
        elif not bool(norm.isfinite()):
            optimizer.zero_grad(set_to_none=True)

    def optimizer_step(self, *arguments: Any, **named: Any) -> None:
        """Do a step, then update the moving average of the weights."""
        super().optimizer_step(*arguments, **named)
        step = self.global_step + 1
        update = get_ema_multi_avg_fn(min(self.decay, step / (step + 9)))
        update(list(self.average.parameters()), list(self.net.parameters()), None)
        for average, current in zip(self.average.buffers(), self.net.buffers(), strict=True):
            average.copy_(current)  # such as the statistics of batch normalisation, which are averages already

    def on_validation_epoch_start(self) -> None:
        """Score bicubic interpolation, too, unless its scores are known from the training's first validation."""
        known = self.bicubic and self.trainer.state.fn == TrainerFn.FITTING
        self._bicubic_metrics = [] if known else [self._make_metrics().to(self.device) for _ in self.sets]

    def validation_step(self, batch: Batch, index: int, dataloader_idx: int = 0) -> None:
        """Score a whole scene, if the batch has one; render the first few for the loggers."""
        if not batch:
            return
        with torch.autocast(self.device.type, enabled=False):
            depth = self(batch)
            scored = [(self.metrics[dataloader_idx], depth)]
            if self._bicubic_metrics:
                scored.append((self._bicubic_metrics[dataloader_idx], batch["bicubic"]))
            unit = Unit(**batch["unit"])
            for metrics, each in scored:
                pair = SurfacePair(each, batch["depth"], batch["rays"], unit=unit, image_dtype=torch.float32)
                metrics.update(pair)  # type: ignore[operator]
            if self._trainer is None or not self._trainer.loggers:
                return
            number = index * self.trainer.world_size + self.trainer.global_rank  # of the scene
            if number < _RENDERED_SCENES:
                depth_lr = to_depth(batch["disparity_lr"].to(batch["depth"].dtype), batch)
                picture = comparison(depth, batch["depth"], batch["rays"], batch["rgb"], depth_lr)
                self._pictures[f"renderings/{self.sets[dataloader_idx]}_{number}"] = picture

    def predict_step(self, batch: Batch, *_: Any) -> Tensor | None:
        """Return a scene's depth, as :meth:`forward`; None for an empty batch."""
        return self(batch) if batch else None

    def on_validation_epoch_end(self) -> None:
        """Log the mean scores as ``val/METRIC`` or ``test/METRIC``, to loggers in the units of tables, and pictures."""
        if not self.trainer.sanity_checking:  # of a few scenes
            pictures = self._pictures
            if self.trainer.world_size > 1:
                all_devices: list[Any] = [None] * self.trainer.world_size
                torch.distributed.all_gather_object(all_devices, pictures)
                pictures = {name: picture for each in all_devices for name, picture in each.items()}
            for name, picture in sorted(pictures.items()):
                for logger in self.loggers:
                    log_picture(logger, name, picture, self.global_step)
            self._log_scores("test" if self.trainer.testing else "val")
        self._pictures, self._bicubic_metrics = {}, []
        for each in self.metrics:
            each.reset()  # type: ignore[operator]

    test_step = validation_step
    on_test_epoch_start, on_test_epoch_end = on_validation_epoch_start, on_validation_epoch_end

    def _log_scores(self, stage: str) -> None:
        means = self._means(stage, self.metrics)
        if self._bicubic_metrics:
            self.bicubic = self._means("bicubic", self._bicubic_metrics)
        self.validation_scores = means | self.bicubic
        metrics: Any = {name: metric for each in self.metrics for name, metric in each.items()}  # type: ignore[operator]
        self.shown_scores = {kind: in_table_units(metrics, raw) for kind, raw in self.validation_scores.items()}
        tagged, shown = (
            {f"{kind}/{name}": value for kind, each in scores.items() for name, value in each.items()}
            for scores in (self.validation_scores, self.shown_scores)
        )
        if self.trainer.state.fn != TrainerFn.FITTING:
            self.log_dict(shown)
            return
        self.log_dict(tagged, logger=False)
        for logger in self.loggers:  # Lightning would count steps from 0
            logger.log_metrics(shown, self.global_step)
            logger.save()

    def _means(self, kind: str, collections: Any) -> dict[str, dict[str, float]]:
        """Return the mean scores over the scenes, by ``kind`` for all sets and, if there are several, for each."""
        scores = [{name: value.double() for name, value in compute_means(each).items()} for each in collections]
        names = dict.fromkeys(name for each in scores for name in each)
        means = {name: torch.stack([each[name] for each in scores if name in each]).nanmean() for name in names}
        sets = {f"{kind}_{name}": each for name, each in zip(self.sets, scores, strict=True)}
        found = {kind: means} | (sets if len(sets) > 1 else {})
        return {each: {name: float(value) for name, value in of.items()} for each, of in found.items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the scores of bicubic interpolation, and of what the module is made, as plain values."""
        checkpoint["bicubic"] = self.bicubic
        makers = {
            "net": functools.partial(self.net.__class__, **self.net.arguments()),
            "objective": functools.partial(self.objective.__class__, **self.objective.arguments()),
            "optimizer": self._make_optimizer,
            "scheduler": self._make_scheduler,
        }
        nodes = {name: _node_of(make) for name, make in makers.items() if make is not None}
        plain = {"average": self.decay, "validation_sets": list(self.sets)}
        checkpoint["hyper_parameters"] = plain | {name: node for name, node in nodes.items() if node is not None}

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]  # Lightning's has arguments for another file of arguments
        cls, checkpoint_path: str | Path, map_location: Any = None, **parts: Any
    ) -> Self:
        """Return the module of a checkpoint; ``parts`` replace what it names, such as a ``net`` that is not dsr's."""
        stored = read_torch_file(Path(checkpoint_path)).get("hyper_parameters")
        if not isinstance(stored, Mapping):
            raise ValueError(f"{checkpoint_path}: expected a checkpoint of {cls.__name__}, it names no parts")
        for name in _PARTS:
            if name in stored and name not in parts:
                parts[name] = _read_part(Path(checkpoint_path), name, stored[name])
            elif name in ("net", "objective") and name not in parts:
                raise ValueError(f"{checkpoint_path}: expected {name}=, which the checkpoint does not name")
        return super().load_from_checkpoint(checkpoint_path, map_location, weights_only=True, **parts)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the scores of bicubic interpolation, which earlier checkpoints lack."""
        stored = checkpoint.get("bicubic", {})
        message = f"bicubic: expected scores by the names of sets and metrics, got {stored!s:.80}"
        with refusing(message, AttributeError, TypeError, ValueError, OverflowError, RuntimeError):
            self.bicubic = {str(kind): {str(k): float(v) for k, v in each.items()} for kind, each in stored.items()}

    def configure_optimizers(self) -> Any:
        """Return the optimiser and, if there is one, its schedule, which is updated after every step."""
        optimizer = self._make_optimizer(self.net.parameters())
        if self._make_scheduler is None:
            return optimizer
        schedule = {"scheduler": self._make_scheduler(optimizer), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}


def _node_of(make: Any) -> dict[str, Any] | None:
    """Return a class, or a partial of one, as ``_target_`` beside plain arguments; None for anything else."""
    made = make if isinstance(make, functools.partial) else functools.partial(make)
    if made.args or not isinstance(made.func, type):
        return None
    try:
        json.dumps(made.keywords)
    except (TypeError, ValueError):
        return None
    return {"_target_": f"{made.func.__module__}.{made.func.__qualname__}", **made.keywords}


def _read_part(path: Path, name: str, node: Mapping[str, Any]) -> Any:
    """Return a part of a module of its class and arguments in a checkpoint, which may come from somebody else."""
    target, expected = str(node.get("_target_")), _PARTS[name]
    if not target.startswith(_TRUSTED):
        raise ValueError(f"{name}: the checkpoint names {target}, neither dsr's nor torch.optim's; give {name}=")
    kind = load_object(name, target, f"a {expected.__name__}")
    if not (isinstance(kind, type) and issubclass(kind, expected)):
        raise ValueError(f"{name}: expected a {expected.__name__} in the checkpoint, {target} is none")
    arguments = {key: value for key, value in node.items() if key not in ("_target_", "_partial_")}
    try:
        if issubclass(kind, DisparityNetwork):
            make_network(path, kind, arguments)  # is not larger than the file
            return kind(**arguments)
        return kind.of(**arguments) if issubclass(kind, Objective) else functools.partial(kind, **arguments)
    except TypeError as error:
        raise ValueError(f"{path}: {name}: {error}") from error
