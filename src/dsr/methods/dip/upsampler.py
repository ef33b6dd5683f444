"""DIP and DIP-V: depth super-resolution by an untrained network that is optimised for each image.

Ulyanov, Vedaldi, Lempitsky, *Deep Image Prior*, CVPR 2018, guided by the photo and with the visual loss of Voynov et
al., *Perceptual Deep Depth Super-Resolution*, ICCV 2019, section 4.2. The network predicts a depth map d, whose
low-resolution version D d is compared with the input d_LR, and the intensity of the photo:

    c data(D d / r, d_LR / r) + w visual(D d, d_LR) + w_I Lap_1(intensity, photo)

with the range r of the input, and c = 10 for MSE, 1 for Lap_1. Holes of the input have no data term; the network fills
them. The result is a moving average of the depth maps of all steps.

The network is the hourglass of Ulyanov et al. What differs: convolutions are padded with zeros, the last one always
computes in float32, and the widths may differ between levels.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
import torchmetrics
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

from dsr.degradation.downsampling import Downsampling, downsample_depth, scene_generator
from dsr.geometry.surface import comparison, depth_to_normals
from dsr.methods.base import WORKSPACE, Abilities, Cost, Method, whole_scale
from dsr.methods.images import compute_min_max, estimate_noise, grey, mean3x3, normal_noise_deg
from dsr.methods.networks.network import DTYPES, Precision
from dsr.metrics.classes import compute_means, in_table_units
from dsr.metrics.functional import SurfacePair, rmse_v
from dsr.metrics.losses import VisualLossName, lap1, make_visual_loss, match_weight, mse
from dsr.sample import DepthSample
from dsr.utils.checkpoints import ScoreTables, StepProgress, fit, make_trainer
from dsr.utils.guards import expect_positive
from dsr.utils.progress import Progress, Steps, StepsProgress
from dsr.utils.runs_table import list_run

DATA_WEIGHTS = {"mse": 10.0, "lap1": 1.0}
_NOISE_CHANNELS = 32
_PHOTO_PERTURBATION = 0.05  # standard deviation of the noise added to the photo in each step
_MARGIN = 0.1  # extension of the depth range beyond the input's, as a fraction of it
_LARGEST_TILT = 10.0  # degrees by which the input's noise may tilt its normals for a visual loss
_STEPS_BETWEEN_CHECKS = 100  # of the loss, which is fetched from the device for it


@dataclass(kw_only=True)
class DeepImagePrior(Method):
    """A method that optimises a network for each image; the options are described in ``conf/method/dip.yaml``.

    Each image has its own network and its own random numbers, which depend on the seed, the data set, the scene and the
    scale only, not on other images.
    """

    abilities = Abilities(ratios="whole", optimises=True, assumes_downsampling=True, cost=Cost(2500, 2300, program=6e8))
    range_type = "orthogonal"

    scale: int
    downsampling: Downsampling
    steps: int = 600
    learning_rate: float = 0.01
    widths: Sequence[int] = (32, 64, 128, 128, 128)
    skips: Sequence[int] = (4, 4, 4, 4, 4)
    border: int = 8
    input_noise: float = 0.1
    perturbation: float = 0.1
    average: float = 0.99
    data_loss: Literal["lap1", "mse"] = "lap1"
    visual: VisualLossName = "mse_v"
    w: float | Literal["auto"] = "auto"
    w_intensity: float = 0.01
    oracle: bool = False
    validate_every: int = 100
    precision: Precision = "float32"
    seed: int = 0
    device: torch.device | str = "cpu"
    metrics: Callable[[], torchmetrics.MetricCollection] | None = None
    workspace: Path | None = None  # directory for logs; None for no logs
    display: Progress | None = None
    about: Mapping[str, str] | None = None  # what TensorBoard's table of runs says of an image
    lpips_trunk: str | Path | None = None  # file of AlexNet's weights; None to use torch's hub cache

    def __post_init__(self) -> None:
        self.device = torch.device(self.device)
        w = 1.0 if self.w == "auto" else self.w
        expect_positive(steps=self.steps, learning_rate=self.learning_rate)
        expect_positive(or_zero=True, border=self.border, input_noise=self.input_noise, perturbation=self.perturbation)
        expect_positive(or_zero=True, w=w, w_intensity=self.w_intensity, validate_every=self.validate_every)
        layers = len(self.widths) == len(self.skips) > 0
        for name, expected, right in (
            ("widths", "a positive number for each level", layers and min(self.widths) > 0),
            ("skips", "a positive number for each level", layers and min(self.skips) > 0),
            ("average", "0 or more and less than 1", 0 <= self.average < 1),
            ("data_loss", "lap1 or mse", self.data_loss in DATA_WEIGHTS),
            ("visual", "mse_v where w is 0, as for DIP", bool(w) or self.visual == "mse_v"),
            ("validate_every", "a positive number for oracle=true", self.validate_every > 0 or not self.oracle),
            ("precision", f"one of {', '.join(DTYPES)}", self.precision in DTYPES),
        ):  # fmt: skip
            if not right:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")
        self.visual_loss = make_visual_loss(self.visual, self.lpips_trunk)

    @property
    def flag(self) -> str:
        """Mark for scores: ``oracle`` if the true depth was used, else empty."""
        return "oracle" if self.oracle else ""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device; valid everywhere.

        ``progress`` is not called if there is a display. A ValueError tells that the optimisation diverged.
        """
        display = self.display or StepsProgress(progress)
        with torch.inference_mode(mode=False), torch.enable_grad():
            noise = estimate_noise(sample.depth_lr[None])
            tilt = normal_noise_deg(noise, sample.camera_lr)
            module = PriorOptimisation(self, sample, visual=tilt <= _LARGEST_TILT)
            if self.w and not module.w:
                display.say(
                    f"{sample.scene}: without {self.visual_loss.title}; noise of {noise:.2%} tilts the input's normals "
                    f"by {tilt:.0f} degrees, more than {_LARGEST_TILT:.0f}"
                )
            callbacks: list[Callback] = [StepProgress(display, "steps", sample.scene)]
            logger: TensorBoardLogger | Literal[False] = False
            if self.workspace is not None:
                folder = self.workspace / WORKSPACE / sample.scene
                shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run
                if module.metrics is not None and self.validate_every:
                    callbacks.append(ScoreTables(folder / "validation.csv"))
                logger = TensorBoardLogger(folder.parent, name="", version=sample.scene, default_hp_metric=False)
                settings = {"scene": sample.scene, "dataset": sample.dataset, "scale": self.scale, "w": module.w,
                            "visual": self.visual, "data_loss": self.data_loss, "steps": self.steps,
                            "seed": self.seed, **(self.about or {})}  # fmt: skip
                logger.log_hyperparams(settings)
                list_run(logger.experiment, "optimisation", settings, {})
            trainer = make_trainer(
                torch.device(self.device), self.steps, min(self.validate_every or self.steps, self.steps),
                callbacks=callbacks, logger=logger, limit_val_batches=1 if self.validate_every else 0,
                enable_checkpointing=False,
            )  # fmt: skip
            numbers: Any = (range(self.steps), range(1))  # of the steps, and of the scenes of a validation
            steps, scenes = (  # loaders that do not use the global random generator
                DataLoader(each, batch_size=None, generator=torch.Generator()) for each in numbers
            )
            fit(trainer, module, steps, val_dataloaders=scenes)
        return module.best[0].to(sample.depth_lr)


class PriorOptimisation(lightning.LightningModule):
    """The optimisation of one network for one image, with a visual loss if ``visual``."""

    def __init__(self, options: DeepImagePrior, sample: DepthSample, *, visual: bool) -> None:
        super().__init__()
        self.options, self.sample, device = options, sample, torch.device(options.device)
        self.rgb = sample.rgb[None].to(device, torch.float32)  # (1, 3, H, W)
        self.grey = grey(self.rgb)
        self.depth_lr = sample.depth_lr[None].to(device, torch.float32)  # (1, 1, h, w)
        self.truth = None if sample.depth is None else sample.depth[None].to(device, torch.float32)
        self.rays = sample.camera.rays(dtype=torch.float32, device=device)[None]
        self.rays_lr = sample.camera_lr.rays(dtype=torch.float32, device=device)[None]
        self.complete = bool(sample.depth_lr.isfinite().all())
        low, high = compute_min_max(sample.depth_lr[None]).flatten().tolist()
        self.range = max(high - low, 1e-3 * high)
        margin = _MARGIN * self.range
        self.target = self.depth_lr / self.range
        self.near, self.far = max(low - margin, 0.5 * low), low + self.range + margin

        height, width = self.grey.shape[-2:]
        sides = min(self.depth_lr.shape[-2:]), min(height, width)
        self.levels_lr, self.levels = (1 + (side >= 6) + (side >= 12) for side in sides)  # of Laplacian pyramids
        self.border = min(options.border, min(height, width) - 1)  # reflection needs as many pixels
        seed = scene_generator(options.seed, sample.dataset, sample.scene, sample.scale, "prior").initial_seed()
        self.generator = torch.Generator(device).manual_seed(seed)
        photo = functional.pad(self.rgb, (self.border,) * 4, mode="reflect")
        levels = levels_for(height, width, len(options.widths))
        with torch.random.fork_rng([]):
            torch.manual_seed(seed)
            net = SkipNet(_NOISE_CHANNELS + 3, 2, options.widths[:levels], options.skips[:levels])
            noise = options.input_noise * torch.rand(1, _NOISE_CHANNELS, *photo.shape[-2:])
        self.net = net.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.start = torch.cat([noise.to(device), photo], dim=1)
        self.spread = torch.full((_NOISE_CHANNELS + 3, 1, 1), options.perturbation, device=device)
        self.spread[_NOISE_CHANNELS:] = _PHOTO_PERTURBATION

        self.w = (1.0 if options.w == "auto" else options.w) if visual else 0.0
        self.normals_lr = depth_to_normals(self.depth_lr, self.rays_lr) if self.w and self.complete else None
        if self.w:
            options.visual_loss.check_size(*self.depth_lr.shape[-2:])
            if options.w == "auto" and options.visual != "mse_v":
                smoothed = SurfacePair(mean3x3(self.depth_lr), self.depth_lr, self.rays_lr)
                self.w = match_weight(options.visual_loss, [smoothed])
        self.average = torch.zeros_like(self.grey)
        self.best, self.lowest = self.average, float("inf")  # the best one is a copy if the true depth chooses it
        self.metrics = None if options.metrics is None or self.truth is None else options.metrics().to(device)
        self.validation_scores: dict[str, dict[str, float]] = {}
        self.shown_scores: dict[str, dict[str, float]] = {}

    def forward(self) -> tuple[Tensor, Tensor]:
        """Return depth in metres and intensity in [0, 1], both (1, 1, H, W), for a newly perturbed input."""
        draws = torch.randn(self.start.shape, generator=self.generator, device=self.start.device)
        x = torch.addcmul(self.start, draws, self.spread).contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.options.precision == "bfloat16"):
            y = self.net(x)
        (height, width), border = self.grey.shape[-2:], self.border
        depth, intensity = y[..., border : border + height, border : border + width].float().split(1, dim=1)
        return self.near + (self.far - self.near) * depth.sigmoid(), intensity.sigmoid()

    def loss_terms(self, depth: Tensor, intensity: Tensor) -> dict[str, Tensor]:
        """Return ``loss`` and its terms, scalars, of (1, 1, H, W) depth in metres and intensity in [0, 1]."""
        options, scale, model = self.options, whole_scale(self.sample), self.options.downsampling
        complete = None if model.kernel == "bicubic" else True  # bicubic may undershoot
        depth_lr = downsample_depth(depth, self.sample.camera, scale, model, options.range_type, complete=complete)[0]
        complete = complete if self.complete else False
        if options.data_loss == "mse":
            data = mse(depth_lr / self.range, self.target, complete=complete).squeeze()
        else:
            data = lap1(depth_lr / self.range, self.target, levels=self.levels_lr, complete=complete).squeeze()
        terms = {f"data_{options.data_loss}": data}
        loss = DATA_WEIGHTS[options.data_loss] * data
        if self.w:
            surfaces = SurfacePair(depth_lr, self.depth_lr, self.rays_lr)
            surfaces.complete = complete or surfaces.complete  # which is not asked of a GPU
            if surfaces.complete and self.normals_lr is not None:
                surfaces.normals = depth_to_normals(depth_lr, self.rays_lr), self.normals_lr
            visual = options.visual_loss(surfaces).squeeze()
            terms[options.visual] = visual if surfaces.complete else visual.nansum()  # there may be none between holes
            loss = loss + self.w * terms[options.visual]
        if options.w_intensity:
            terms["intensity"] = lap1(intensity, self.grey, levels=self.levels, complete=True).squeeze()
            loss = loss + options.w_intensity * terms["intensity"]
        return {"loss": loss, **terms}

    def training_step(self, _: Any, __: int) -> Tensor:
        """Return the loss of this step's depth map, and update the average."""
        depth, intensity = self()
        terms, step = self.loss_terms(depth, intensity), self.global_step + 1
        if step in (1, self.options.steps) or step % self.trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            named = {f"train/{name}": value.detach() for name, value in terms.items()}
            self.log_dict({"step": float(step), **named}, batch_size=1)  # else Lightning counts from 0
        if (step == self.options.steps or step % _STEPS_BETWEEN_CHECKS == 0) and not terms["loss"].isfinite():
            raise ValueError(f"{self.sample.scene}: diverged by step {step}; a lower method.learning_rate may help")
        with torch.no_grad():
            self.average.lerp_(depth, 1 - min(self.options.average, (step - 1) / (step + 9)))
        return terms["loss"]

    def validation_step(self, _: Any, __: int) -> None:
        """Score the average if there is a true depth, and log renderings."""
        if self.truth is not None:
            pair = SurfacePair(self.average, self.truth, self.rays, unit=self.sample.unit)
            score = float(rmse_v(pair).nanmean()) if self.options.oracle else float("inf")
            if score < self.lowest:
                self.lowest, self.best = score, self.average.clone()
            if self.metrics is not None:
                self.metrics.reset()
                self.metrics.update(pair)
                scores = {name: float(value) for name, value in compute_means(self.metrics).items()}
                self.validation_scores = {"val": scores}
                self.shown_scores = {"val": in_table_units(self.metrics, scores)}
                named = {f"val/{name}": value for name, value in self.shown_scores["val"].items()}
                self.log_dict({"step": float(self.global_step), **named}, batch_size=1)
        if isinstance(self.logger, TensorBoardLogger):
            picture = comparison(self.average, self.truth, self.rays, self.rgb, self.depth_lr)
            self.logger.experiment.add_image("renderings", picture, self.global_step)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Return Adam."""
        return torch.optim.Adam(self.net.parameters(), self.options.learning_rate, fused=True)


class SkipNet(nn.Module):
    """An hourglass with narrow skip connections, of given channels at each level, full resolution first.

    In the decoder, each level doubles the resolution bilinearly, concatenates the skip connection and applies a 3 x 3
    and a 1 x 1 convolution. Batch normalisation over the image and a leaky ReLU follow every convolution.
    """

    def __init__(self, inputs: int, outputs: int, widths: Sequence[int], skips: Sequence[int]) -> None:
        super().__init__()
        above = [inputs, *widths[:-1]]
        below = [*widths[1:], widths[-1]]
        self.skip = nn.ModuleList(_block(i, s, 1) for i, s in zip(above, skips, strict=True))
        self.down = nn.ModuleList(
            nn.Sequential(_block(i, w, 3, 2), _block(w, w, 3)) for i, w in zip(above, widths, strict=True)
        )
        self.norm = nn.ModuleList(_Norm(s + b) for s, b in zip(skips, below, strict=True))
        self.up = nn.ModuleList(
            nn.Sequential(_block(s + b, w, 3), _block(w, w, 1)) for s, b, w in zip(skips, below, widths, strict=True)
        )
        self.last = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H, W), at least in float32."""
        sides: list[Tensor] = []
        for skip, down in zip(self.skip, self.down, strict=True):
            sides.append(skip(x))
            x = down(x)
        for side, norm, up in zip(reversed(sides), reversed(self.norm), reversed(self.up), strict=True):
            x = upsample_2x(x)[..., : side.shape[-2], : side.shape[-1]]  # the side may be odd
            x = up(norm(torch.cat((side, x), dim=1)))
        with torch.autocast(x.device.type, enabled=False):  # bfloat16 would round depth to 256 steps
            return self.last(x.to(self.last.weight.dtype))


def levels_for(height: int, width: int, most: int) -> int:
    """Return the number of levels of a SkipNet, 1 to ``most``; batch norm needs 2 x 2 pixels in the smallest."""
    return max(1, min(most, (min(height, width) - 1).bit_length() - 1))


def upsample_2x(x: Tensor) -> Tensor:
    """Upsample (B, C, h, w) bilinearly to (B, C, 2 h, 2 w), with pixels as areas and border pixels repeated."""
    result: Tensor = _Upsample2x.apply(x)
    return result


class _Upsample2x(torch.autograd.Function):
    """Bilinear upsampling by slices, whose backward pass is several times as fast as the library's on a CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Mix the two nearest pixels with weights 1/4 and 3/4 along each axis."""
        channels_last = x.is_contiguous(memory_format=torch.channels_last)
        layout = torch.channels_last if channels_last else torch.contiguous_format
        with torch.autocast(x.device.type, enabled=False):  # which pads in float32
            x = functional.pad(x, (1, 1, 1, 1), mode="replicate")
        for axis in (2, 3):
            size, shape = x.shape[axis] - 2, list(x.shape)
            shape[axis] = 2 * size
            out = torch.empty(shape, dtype=x.dtype, device=x.device, memory_format=layout)
            even, odd = out.unflatten(axis, (size, 2)).unbind(axis + 1)
            here = x.narrow(axis, 1, size)
            torch.lerp(here, x.narrow(axis, 0, size), 0.25, out=even)
            torch.lerp(here, x.narrow(axis, 2, size), 0.25, out=odd)
            x = out
        return x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Apply the transpose."""
        for axis in (3, 2):
            size = gradient.shape[axis] // 2
            even, odd = gradient.unflatten(axis, (size, 2)).unbind(axis + 1)
            out = (even + odd).mul_(0.75)
            out.narrow(axis, 0, size - 1).add_(even.narrow(axis, 1, size - 1), alpha=0.25)
            out.narrow(axis, 1, size - 1).add_(odd.narrow(axis, 0, size - 1), alpha=0.25)
            ends = gradient.transpose(0, axis)[:: 2 * size - 1].transpose(0, axis)  # the first and the last
            if size == 1:
                ends = ends.sum(axis, keepdim=True)
            out.transpose(0, axis)[:: max(size - 1, 1)].transpose(0, axis).add_(ends, alpha=0.25)
            gradient = out
        return gradient


class _Norm(nn.BatchNorm2d):
    """A batch normalisation that always uses the statistics of the current image."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, track_running_stats=False)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (B, C, H, W) without the buffer that nn.BatchNorm2d's own call allocates."""
        return torch.native_batch_norm(x, self.weight, self.bias, None, None, True, 0.1, self.eps)[0]


def _block(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)
    return nn.Sequential(convolution, _Norm(outputs), nn.LeakyReLU(0.2, inplace=True))
