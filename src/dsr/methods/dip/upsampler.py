"""DIP and DIP-V: depth super-resolution by an untrained network that is optimised for each image.

Ulyanov, Vedaldi, Lempitsky, *Deep Image Prior*, CVPR 2018, guided by the photo and with the visual loss of Voynov et
al., *Perceptual Deep Depth Super-Resolution*, ICCV 2019, section 4.2. The network outputs a depth map, whose
low-resolution version is compared with the input, and the photo's intensity. Holes of the input have no data term and
are inpainted by the network.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import lightning
import torch
import torchmetrics
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.utils.data import DataLoader

from dsr.degradation.downsampling import Downsampling, scene_generator
from dsr.methods.base import WORKSPACE, Abilities, Cost, Method
from dsr.methods.dip.optimisation import PriorOptimisation, PriorSettings, Provenance, checkpoint_of, cost_of_step
from dsr.methods.dip.problem import DataLoss, ImageProblem, PriorObjective
from dsr.methods.dip.skip_net import Padding
from dsr.methods.dip.stopping import Fixed, Oracle, Residual, Stopping, StoppingName, Variance
from dsr.methods.networks.network import DTYPES, Precision
from dsr.methods.networks.trained import TrainedNetwork
from dsr.methods.noise_level import estimate_noise, normal_noise_deg
from dsr.metrics.visual_loss import VisualLossName, make_visual_loss
from dsr.sample import DepthSample
from dsr.utils.checkpoints import Divergence, DivergenceError, Interruption
from dsr.utils.lightning import ListedScores, StepProgress, ValidationTable, fit, make_trainer
from dsr.utils.progress import Progress, Steps, StepsProgress, duration
from dsr.utils.runs_table import list_run

_SECONDS_BETWEEN_CHECKPOINTS = 60.0
_ADVICE = "a lower method.learning_rate may help"


@dataclass(kw_only=True)
class DeepImagePrior(Method):
    """A method that optimises a network for each image.

    Each image has its own network and its own random numbers, which depend on the seed, the data set, the scene and the
    scale only, not on other images.

    Args:
        scale: upsampling factor.
        downsampling: assumed downsampling model of the low-resolution map.
        steps, learning_rate, widths, skips, padding, border: see :class:`~dsr.methods.dip.optimisation.PriorSettings`.
        guide, input_noise, perturbation, guide_perturbation, average, margin: the same.
        data_loss, data_weight, w_intensity: see :class:`~dsr.methods.dip.problem.PriorObjective`.
        w: weight of the visual loss; ``auto`` is 1 for MSE_v, and makes another loss as large as MSE_v for a smoothed
            low-resolution map.
        visual: the visual loss, see :class:`~dsr.metrics.visual_loss.VisualLoss`.
        largest_tilt: limit in degrees; the visual loss is omitted if the estimated noise of the low-resolution map
            tilts its normals by more. None for no limit.
        stopping: ``fixed``: after ``steps``; ``variance``: at the minimum of the iterates' variance; ``residual``: when
            the residual reaches the estimated noise of the low-resolution map; ``oracle``: at the validation pass with
            the lowest RMSE_v, which uses the true depth.
        patience: steps without a new minimum until ``variance`` stops.
        validate_every: steps between validation passes, which log scores and renderings; 0 for none.
        precision: dtype of the convolutions.
        seed: seed of all random numbers.
        device: device of the computations.
        metrics: function that returns the metrics of a validation pass; None for none.
        workspace: directory for logs and checkpoints; None for neither.
        display: display of the progress.
        about: what TensorBoard's table of runs says of an image: ``method`` and ``degradation``; None for not known.
        lpips_trunk: file of AlexNet's weights for ``visual=lpips``; None to use torch's hub cache.

    Raises:
        ValueError: a value is out of range, or ``visual`` needs weights that are not there.

    """

    abilities = Abilities(ratios="whole", optimises=True, assumes_downsampling=True, cost=Cost(2500, 2300, program=6e8))
    range_type = "orthogonal"

    scale: int
    downsampling: Downsampling
    steps: int = PriorSettings.steps
    learning_rate: float = PriorSettings.learning_rate
    widths: Sequence[int] = PriorSettings.widths
    skips: Sequence[int] = PriorSettings.skips
    padding: Padding = PriorSettings.padding
    border: int = PriorSettings.border
    guide: bool = PriorSettings.guide
    input_noise: float = PriorSettings.input_noise
    perturbation: float = PriorSettings.perturbation
    guide_perturbation: float = PriorSettings.guide_perturbation
    average: float = PriorSettings.average
    margin: float = PriorSettings.margin
    data_loss: DataLoss = PriorObjective.data_loss
    data_weight: float = PriorObjective.data_weight
    w: float | Literal["auto"] = "auto"
    w_intensity: float = PriorObjective.w_intensity
    visual: VisualLossName = "mse_v"
    largest_tilt: float | None = 10.0
    stopping: StoppingName = "fixed"
    patience: int = 200
    validate_every: int = 100
    precision: Precision = "float32"
    seed: int = 0
    device: torch.device | str = "cpu"
    metrics: Callable[[], torchmetrics.MetricCollection] | None = None
    workspace: Path | None = None
    display: Progress | None = None
    about: Mapping[str, str] | None = None
    lpips_trunk: str | Path | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        self.device = torch.device(self.device)
        if self.precision not in DTYPES:
            raise ValueError(f"precision: expected one of {', '.join(DTYPES)}, got {self.precision!r}")
        for name, least in (("patience", 1), ("validate_every", 0), ("largest_tilt", 0)):
            if (getattr(self, name) or 0) < least:
                raise ValueError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        if self.stopping not in get_args(StoppingName):
            raise ValueError(f"stopping: expected one of {', '.join(get_args(StoppingName))}, got {self.stopping!r}")
        if self.stopping == "oracle" and not self.validate_every:
            raise ValueError("validate_every: expected a positive number, as stopping=oracle needs it")
        given = {each.name: getattr(self, each.name) for each in fields(PriorSettings) if each.name != "mixed"}
        given |= {"widths": tuple(self.widths), "skips": tuple(self.skips)}
        self._settings = PriorSettings(**given, mixed=self.precision == "bfloat16")
        if self.visual != "mse_v" and self.w == 0:
            raise ValueError(f"visual: expected mse_v where w is 0, as for DIP, got {self.visual}")
        visual = make_visual_loss(self.visual, self.lpips_trunk)
        w = 1.0 if self.w == "auto" else self.w
        self._objective = PriorObjective(self.data_loss, self.data_weight, w, self.w_intensity, visual)

    @property
    def flag(self) -> str:
        """Mark for scores: ``oracle`` if the true depth was used, else empty."""
        return "oracle" if self.stopping == "oracle" else ""

    def base(self, sample: DepthSample) -> Tensor | None:
        """Return the initial depth of the optimisation, (1, H, W) in metres; None for none."""
        return None

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device; valid everywhere.

        Args:
            progress: called with the number of steps done and their total, unless there is a display.

        Raises:
            ValueError: the optimisation diverged.
            KeyboardInterrupt: the user interrupted it; with a workspace, the next call resumes.

        """
        with torch.inference_mode(mode=False), torch.enable_grad():
            module, origin = self.module(sample)
            display = self.display or StepsProgress(progress)
            folder = None if self.workspace is None else self.workspace / WORKSPACE / sample.scene
            resume = None if folder is None else checkpoint_of(folder / "last.ckpt", origin)
            if folder is not None and resume is None:
                (folder / "last.ckpt").unlink(missing_ok=True)
            display.say(self._announcement(module, sample.scene, resume is not None))
            if not module.objective.w and self._objective.w:
                title = module.objective.visual.title
                display.say(f"{sample.scene}: without {title}; {_noise_of(sample)}, more than largest_tilt")
            trainer = self._trainer(module, folder, origin, display, sample)
            try:
                fit(trainer, module, _numbers(self.steps), resume, val_dataloaders=_numbers(1))
            except DivergenceError as error:
                raise ValueError(f"{sample.scene}: the optimisation {error}; {_ADVICE}") from error
            except KeyboardInterrupt:
                where = f"interrupted at step {trainer.global_step} of {sample.scene}"
                on = "; the same command continues from there" if folder is not None else ""
                raise KeyboardInterrupt(where + on) from None
            depth = module.result()
        if not bool(depth.isfinite().all()):
            raise ValueError(f"{sample.scene}: the optimisation diverged; {_ADVICE}")
        if folder is not None:
            (folder / "last.ckpt").unlink(missing_ok=True)
        if trainer.global_step < self.steps:
            display.say(f"{sample.scene}: stopped at step {trainer.global_step} ({self.stopping})")
        return depth[0].detach().to(sample.depth_lr)

    def seconds(self, sample: DepthSample) -> float:
        """Return how long an image takes, in seconds, by a step that is measured now."""
        with torch.inference_mode(mode=False), torch.enable_grad():
            return self.steps * cost_of_step(self.module(sample)[0])[0]

    def module(self, sample: DepthSample) -> tuple[PriorOptimisation, str]:
        """Return an image's LightningModule, and a digest of its problem and settings."""
        device = torch.device(self.device)
        problem = ImageProblem.of(sample, self.downsampling, self.range_type, device)
        base = self.base(sample)
        truth = None if sample.depth is None else sample.depth[None].to(device, torch.float32)
        seed = scene_generator(self.seed, sample.dataset, sample.scene, sample.scale, "prior").initial_seed()
        objective = replace(self._objective, w=self._weight(problem, sample))
        facts = (self._settings, objective, self.downsampling, self.stopping, self.patience, seed)
        digest = hashlib.sha256(repr((facts, sample.camera, sample.camera_lr)).encode())
        for values in (sample.rgb, sample.depth_lr, base):
            if values is not None:
                digest.update(values.detach().cpu().contiguous().numpy().tobytes())
        module = PriorOptimisation(
            problem,
            objective,
            self._settings,
            self._rule(problem),
            seed,
            None if self.metrics is None or truth is None else self.metrics().to(device),
            truth,
            None if base is None else base[None].to(device, torch.float32),
        )
        return module, digest.hexdigest()

    def _weight(self, problem: ImageProblem, sample: DepthSample) -> float:
        """Return the weight of the visual loss; 0 if the noise of the low-resolution map is too large for normals."""
        visual = self._objective.visual
        if self._objective.w:
            visual.check_size(sample.camera_lr.height, sample.camera_lr.width)
        if not self._normals_count(sample):
            return 0.0
        return problem.balance_weight(visual) if self.w == "auto" else self._objective.w

    def _normals_count(self, sample: DepthSample) -> bool:
        """Return whether noise tilts the low-resolution map's normals by at most ``largest_tilt``."""
        tilt = normal_noise_deg(estimate_noise(sample.depth_lr[None]), sample.camera_lr)
        return self.largest_tilt is None or tilt <= self.largest_tilt

    def _rule(self, problem: ImageProblem) -> Stopping:
        """Return the stopping rule."""
        if self.stopping == "variance":
            return Variance(problem.grey, self.patience)
        if self.stopping == "residual":
            return Residual(problem.depth_lr, problem.residual)
        return Oracle() if self.stopping == "oracle" else Fixed()

    def _announcement(self, module: PriorOptimisation, scene: str, resumed: bool) -> str:
        """Return a line with the number of steps, the expected time and memory."""
        seconds, memory = cost_of_step(module)
        most = "" if self.stopping in ("fixed", "oracle") else "up to "
        height, width = module.problem.grey.shape[-2:]
        return (
            f"{scene}: {most}{self.steps} steps at {height} x {width} in {self.precision}"
            f"{', resumed' if resumed else ''}; {most}about {duration(seconds * self.steps)} "
            f"({seconds:.2g} s a step as measured now), about {memory / 2**30:.1f} GiB of memory of its own"
        )

    def _trainer(
        self, module: PriorOptimisation, folder: Path | None, origin: str, display: Progress, sample: DepthSample
    ) -> lightning.Trainer:
        """Return Lightning's trainer for one image."""
        scene = sample.scene
        callbacks: list[Callback] = [Divergence(patience=1), StepProgress(display, "steps", scene)]
        logger: Any = False
        if folder is not None:
            callbacks += [
                Provenance(origin),
                Interruption(folder / "last.ckpt", _SECONDS_BETWEEN_CHECKPOINTS),
            ]
            if module.metrics is not None and self.validate_every:
                callbacks += [ValidationTable(folder / "validation.csv"), ListedScores()]
            logger = TensorBoardLogger(folder.parent, name="", version=scene, default_hp_metric=False)
            settings = {"scene": scene, "scale": self.scale, "stopping": self.stopping, "w": module.objective.w,
                        "visual": self.visual, "data_loss": self.data_loss, "steps": self.steps, "seed": self.seed,
                        "dataset": sample.dataset, **(self.about or {})}  # fmt: skip
            logger.log_hyperparams(settings)
            list_run(logger.experiment, "optimisation", settings, {})
        return make_trainer(
            torch.device(self.device),
            self.steps,
            min(self.validate_every or self.steps, self.steps),
            callbacks=callbacks,
            logger=logger,
            limit_val_batches=1 if self.validate_every else 0,
            enable_checkpointing=folder is not None,  # the callback above
        )


@dataclass(kw_only=True)
class WarmStarted(DeepImagePrior):
    """A deep image prior that starts from the result of a trained network.

    Args:
        weights: weights file of the network.
        model: name of the network's model.
        **settings: as for :class:`DeepImagePrior`; ``margin`` is the depth that an output of 1 adds, as a fraction of
            the low-resolution map's range.

    Raises:
        ValueError: a value is out of range, or the weights are of another network.

    """

    abilities = replace(DeepImagePrior.abilities, ratios="factors", needs="weights")

    weights: Path
    model: str
    steps: int = 100

    def __post_init__(self) -> None:
        """Load the network."""
        super().__post_init__()
        self._trained = TrainedNetwork(Path(self.weights), self.scale, self.model, device=self.device)

    def base(self, sample: DepthSample) -> Tensor:
        """Return the trained network's depth; holes are filled with the low-resolution map's mean."""
        depth = self._trained(sample).clone()
        return torch.where(depth.isfinite(), depth, sample.depth_lr.nanmean())


def _noise_of(sample: DepthSample) -> str:
    """Describe the estimated noise of a low-resolution map."""
    noise = estimate_noise(sample.depth_lr[None])
    return f"noise of {noise:.2%} tilts the input's normals by {normal_noise_deg(noise, sample.camera_lr):.0f} degrees"


def _numbers(count: int) -> Any:
    """Return a loader of numbers, one for each step, that does not use the global random generator."""
    numbers: Any = range(count)
    return DataLoader(numbers, batch_size=None, generator=torch.Generator())
