"""The optimisation of one image as a LightningModule, its checkpoints and its cost."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
import torchmetrics
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.shading import comparison
from dsr.methods.dip.problem import ImageProblem, PriorObjective
from dsr.methods.dip.skip_net import Padding, SkipNet, levels_for
from dsr.methods.dip.stopping import Stopping
from dsr.metrics.classes import compute_means, in_table_units
from dsr.metrics.functional import SurfacePair, rmse_v
from dsr.utils.torch_files import read_torch_file

_NOISE_CHANNELS = 32
_LARGEST_RATE = 1e36
"""A larger learning rate, divided by the correction of Adam's first step, is no float32 number."""

_TEMPORARY = 1.6
"""Measured ratio of the peak memory of a step to the memory that the forward pass saves for the backward pass."""


@dataclass(frozen=True)
class PriorSettings:
    """The network, its input and its optimiser.

    Args:
        steps: maximum number of steps.
        learning_rate: learning rate of Adam.
        widths, skips: channels by level, see :class:`~dsr.methods.dip.skip_net.SkipNet`; small images use fewer levels.
        padding: padding of the convolutions.
        border: pixels that are added on each side by reflection and cropped from the output, to avoid border effects.
        guide: whether the RGB image is part of the network's input, besides 32 channels of noise.
        input_noise: upper limit of the uniform input noise, which is fixed.
        perturbation, guide_perturbation: standard deviations of the noise added to the input noise and to the image in
            each step.
        average: decay of the exponential moving average of the depth maps.
        margin: extension of the depth range beyond the low-resolution map's, as a fraction of it.
        mixed: whether convolutions run in bfloat16.

    Raises:
        ValueError: a value is out of range.

    """

    steps: int = 600
    learning_rate: float = 0.01
    widths: Sequence[int] = (32, 64, 128, 128, 128)
    skips: Sequence[int] = (4, 4, 4, 4, 4)
    padding: Padding = "zeros"
    border: int = 8
    guide: bool = True
    input_noise: float = 0.1
    perturbation: float = 0.1
    guide_perturbation: float = 0.05
    average: float = 0.99
    margin: float = 0.1
    mixed: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if self.steps <= 0:
            raise ValueError(f"steps: expected a positive number, got {self.steps}")
        if not 0 < self.learning_rate <= _LARGEST_RATE:
            raise ValueError(
                f"learning_rate: expected a positive number up to {_LARGEST_RATE:g}, got {self.learning_rate}"
            )
        for name in ("input_noise", "perturbation", "guide_perturbation", "margin"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected 0 or a positive number, got {getattr(self, name)}")
        if self.border < 0:
            raise ValueError(f"border: expected 0 or a positive number, got {self.border}")
        if not self.guide and not self.input_noise:
            raise ValueError("input_noise: expected a positive number, or guide=true; got 0 and false")
        if not 0 <= self.average < 1:
            raise ValueError(f"average: expected 0 or more and less than 1, got {self.average}")
        for name, values in (("widths", self.widths), ("skips", self.skips)):
            if not values or min(values) < 1 or len(values) != len(self.widths):
                raise ValueError(f"{name}: expected a positive number for each level, got {list(values)}")


class PriorOptimisation(lightning.LightningModule):
    """The optimisation of one network for one image.

    Args:
        problem: the image.
        objective: the loss.
        settings: settings of the network and the optimiser.
        stopping: stopping rule.
        seed: seed of the weights, the input and its perturbations.
        metrics: metrics of a validation pass; None for none.
        truth: (1, 1, H, W) true depth for validation, otherwise only used by the oracle; None for none.
        base: (1, 1, H, W) initial depth in metres that the network's output is added to; None for none.

    """

    start: Tensor
    spread: Tensor
    average: Tensor

    def __init__(
        self,
        problem: ImageProblem,
        objective: PriorObjective,
        settings: PriorSettings,
        stopping: Stopping,
        seed: int,
        metrics: torchmetrics.MetricCollection | None = None,
        truth: Tensor | None = None,
        base: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.problem, self.objective, self.settings, self.stopping = problem, objective, settings, stopping
        self.metrics, self.truth, self.base = metrics, truth, base
        self.validation_scores: dict[str, dict[str, float]] = {}
        self.shown_scores: dict[str, dict[str, float]] = {}
        device, size = problem.rgb.device, problem.rgb.shape[-2:]
        self._border = min(settings.border, min(size) - 1)  # reflection needs as many pixels
        self.generator = torch.Generator(device).manual_seed(seed)
        with torch.random.fork_rng([]):
            torch.manual_seed(seed)
            self.net = self._network().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
            photo = functional.pad(problem.rgb, (self._border,) * 4, mode="reflect")
            noise = settings.input_noise * torch.rand(1, _NOISE_CHANNELS, *photo.shape[-2:])
        parts = [noise.to(device), photo] if settings.guide else [noise.to(device)]
        spread = torch.full((sum(part.shape[1] for part in parts), 1, 1), settings.perturbation, device=device)
        spread[_NOISE_CHANNELS:] = settings.guide_perturbation
        self.register_buffer("start", torch.cat(parts, dim=1), persistent=False)
        self.register_buffer("spread", spread, persistent=False)
        self.register_buffer("average", torch.zeros_like(problem.grey))

    def training_step(self, _: Any, __: int) -> Tensor:
        """Return the loss of this step's depth map, and update the average."""
        depth, intensity = self.answer()
        terms = self.objective(depth, intensity, self.problem)
        step = self.global_step + 1
        named = {f"train/{name}": value.detach() for name, value in terms.items()}
        self.log_dict({"step": float(step), **named}, batch_size=1)  # else Lightning counts from 0
        with torch.no_grad():
            self.average.lerp_(depth, 1 - min(self.settings.average, (step - 1) / (step + 9)))
            if self.stopping.observe(step, depth, self.average):
                self.trainer.should_stop = True
        return terms["loss"]

    def answer(self) -> tuple[Tensor, Tensor]:
        """Return depth in metres and intensity in [0, 1], both (1, 1, H, W), for a newly perturbed input."""
        shape, device = self.start.shape, self.start.device
        draws = torch.randn(shape, generator=self.generator, device=device)
        x = torch.addcmul(self.start, draws, self.spread).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=self.settings.mixed):
            y = self.net(x)
        height, width = self.problem.grey.shape[-2:]
        y = y[..., self._border :, self._border :][..., :height, :width].float()
        return self._depth(y[:, :1]), y[:, 1:].sigmoid()

    def result(self) -> Tensor:
        """Return the resulting depth map, (1, 1, H, W) in metres."""
        return self.stopping.result(self.average)

    def validation_step(self, _: Any, __: int) -> None:
        """Score the current average if there is a true depth, and log renderings."""
        depth = self.average
        if self.truth is not None:
            pair = SurfacePair(depth, self.truth, self.problem.rays, unit=self.problem.unit)
            self.stopping.judge(float(rmse_v(pair).nanmean()), depth)
            if self.metrics is not None:
                self.metrics.reset()
                self.metrics.update(pair)
                scores = {name: float(value) for name, value in compute_means(self.metrics).items()}
                self.validation_scores = {"val": scores}
                self.shown_scores = {"val": in_table_units(self.metrics, scores)}
                named = {f"val/{name}": value for name, value in self.shown_scores["val"].items()}
                self.log_dict({"step": float(self.global_step), **named}, batch_size=1)
        writer: Any = getattr(self.logger, "experiment", None)
        if hasattr(writer, "add_image"):
            problem = self.problem
            picture = comparison(depth, self.truth, problem.rays, problem.rgb, problem.depth_lr)
            writer.add_image("renderings", picture, self.global_step)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam."""
        return torch.optim.Adam(self.net.parameters(), self.settings.learning_rate, fused=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the states of the random generator and of the stopping rule."""
        checkpoint["generator"], checkpoint["stopping"] = self.generator.get_state(), self.stopping.state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the states of the random generator and of the stopping rule."""
        self.generator.set_state(checkpoint["generator"].cpu())
        self.stopping.restore(checkpoint["stopping"])

    def _network(self) -> SkipNet:
        """Return the network; with a base its initial depth output is 0."""
        settings = self.settings
        height, width = self.problem.rgb.shape[-2:]
        levels = levels_for(height, width, len(settings.widths))
        channels = _NOISE_CHANNELS + (3 if settings.guide else 0)
        net = SkipNet(channels, 2, settings.widths[:levels], settings.skips[:levels], settings.padding)
        if self.base is not None:
            nn.init.zeros_(net.last.weight[:1])
            nn.init.zeros_(net.last.bias[:1])  # type: ignore[index]
        return net

    def _depth(self, y: Tensor) -> Tensor:
        """Convert the network's first channel to depth in metres."""
        problem = self.problem
        margin = self.settings.margin * problem.depth_range
        least = max(problem.min_depth - margin, 0.5 * problem.min_depth)
        if self.base is not None:
            return (self.base + margin * y).clamp(min=0.5 * problem.min_depth)
        return least + (problem.min_depth + problem.depth_range + margin - least) * y.sigmoid()


class Provenance(Callback):
    """Stores a digest of the problem and the settings in each checkpoint."""

    def __init__(self, origin: str) -> None:
        self._origin = origin

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Store the digest."""
        checkpoint["origin"] = self._origin


def cost_of_step(module: PriorOptimisation) -> tuple[float, float]:
    """Measure the seconds of a step and the bytes that it and the optimiser need; the module stays unchanged."""
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
    """Return the path if it holds a checkpoint of the same problem and settings, else None."""
    if not path.is_file():
        return None
    try:
        stored = read_torch_file(path).get("origin")
    except (ValueError, AttributeError, OSError):
        return None
    return path if stored == origin else None
