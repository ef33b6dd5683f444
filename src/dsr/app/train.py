"""The command behind ``train.py``."""

from __future__ import annotations

import contextlib
import logging
import shutil
import signal
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import lightning
import torch
import torchmetrics
from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dsr.app import rundir
from dsr.app.build import build, pick_device
from dsr.app.perceptual import perceptual_network
from dsr.app.progress import TrainingBar, over
from dsr.app.schema import ConfigError, TrainConfig, plain_config
from dsr.atomic import replacing
from dsr.data.base import SceneSource
from dsr.data.patches import PatchData, PatchSettings
from dsr.data.procedural.source import Procedural
from dsr.degrade import Downsampling
from dsr.methods.msg_net import MSGNet
from dsr.methods.weights import save_msg_weights
from dsr.quality.metrics import visual_metrics
from dsr.training import Objective, Schedule, SuperResolution, balanced_weight

WEIGHTS = "weights.safetensors"
_MONITOR = "val/RMSE_v"
_PATCHES_FOR_W = 64
_LARGEST_SEED = 2**32 - 1


def train(config: DictConfig) -> Path:
    """Train a network: checkpoints, a TensorBoard log, and the weights of the best validation RMSE_v.

    A run that was interrupted goes on from its last checkpoint when the same command is given again.

    Args:
        config: composed from ``conf/train.yaml``.

    Returns:
        The file of weights.

    Raises:
        ConfigError: the configuration cannot be run, or is trained already.

    """
    plain = plain_config(config)
    settings = TrainConfig.of(plain)
    device = pick_device(settings.device)
    console = Console()
    if settings.seed > _LARGEST_SEED:
        raise ConfigError(f"seed: expected at most {_LARGEST_SEED}, got {settings.seed}")
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    net = build("model", settings.model, {"scale": settings.scale})
    data = _data(settings)
    network = perceptual_network(settings.metrics.lpips_trunk) if settings.metrics.lpips else None
    identity = rundir.identity_of(plain, None, device)
    names = {**plain, "method": settings.model}
    folder = Path(settings.output_dir or rundir.default_directory("train", names, identity)).expanduser()
    weights, last = folder / WEIGHTS, folder / "checkpoints" / "last.ckpt"
    if weights.exists() and not settings.overwrite:
        raise ConfigError(f"output_dir: {weights} is trained already; overwrite=true trains it anew")
    _prepare(console, data.source)
    module = _module(settings, net, data, visual_metrics(None if network is None else network.to(device)))
    rundir.claim(folder, plain, identity)
    if settings.overwrite:
        weights.unlink(missing_ok=True)  # or they would pass for this run's, should it be interrupted
        for made in ("checkpoints", "tensorboard"):
            shutil.rmtree(folder / made, ignore_errors=True)
    resume = last if last.is_file() else None
    _announce(console, settings, net, data, module.objective, folder, resume)
    best = ModelCheckpoint(last.parent, "best", monitor=_MONITOR, mode="min", save_on_train_epoch_end=False)
    latest = ModelCheckpoint(
        last.parent, last.stem, enable_version_counter=False, save_on_train_epoch_end=False
    )  # save_last=True keeps the best's
    with _without_chatter():
        callbacks = [best, latest, LearningRateMonitor("step"), TrainingBar(console)]
        trainer = _trainer(settings, folder, device, callbacks)
    trainer.logger.experiment.add_text("config", f"```yaml\n{OmegaConf.to_yaml(config, resolve=True)}```")  # type: ignore[union-attr]
    _fit(trainer, module, data, resume)
    _export(module, Path(best.best_model_path), weights, str(settings.model["name"]))
    console.print(f"weights: {weights}", markup=False, highlight=False, soft_wrap=True)
    return weights


def _data(settings: TrainConfig) -> PatchData:
    """Return the patches that the configuration describes."""
    trainer = settings.trainer
    downsampling = build("downsampling", settings.downsampling)
    if not isinstance(downsampling, Downsampling):
        raise ConfigError("downsampling: training needs a model such as box, measured is none")
    source = build("dataset", settings.dataset)
    try:
        patches = PatchSettings(
            trainer.patch,
            trainer.batch,
            min(trainer.validate_every, trainer.steps),
            trainer.validation_scenes,
            trainer.flip,
            trainer.colour,
            trainer.workers,
        )
        return PatchData(source, patches, settings.scale, downsampling, settings.seed)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _module(
    settings: TrainConfig, net: MSGNet, data: PatchData, metrics: torchmetrics.MetricCollection
) -> SuperResolution:
    """Return the network under training; loads the scenes, which its loss may depend on."""
    trainer = settings.trainer
    try:
        data.setup()
        schedule = Schedule(trainer.steps, trainer.learning_rate, trainer.warmup, trainer.weight_decay)
        return SuperResolution(net, _objective(settings, data), schedule, metrics)
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from error


def _prepare(console: Console, source: SceneSource) -> None:
    """Let a data set that renders its scenes do so, with a bar."""
    if isinstance(source, Procedural):
        count = len(source.scenes())
        for _ in over(console, source.prepare(), "render", count):
            pass


def _objective(settings: TrainConfig, data: PatchData) -> Objective:
    """Return the loss; w is computed from training patches unless it is a number."""
    if not settings.model["visual"]:
        return Objective(settings.model["depth_loss"])
    w = balanced_weight(data.some_patches(_PATCHES_FOR_W)) if settings.loss.w == "auto" else float(settings.loss.w)
    return Objective(settings.model["depth_loss"], w)


def _fit(trainer: lightning.Trainer, module: SuperResolution, data: PatchData, resume: Path | None) -> None:
    """Train; an interruption, which Lightning turns into an exit with code 1, comes out as the KeyboardInterrupt."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        with _without_chatter():
            trainer.fit(module, data, ckpt_path=resume, weights_only=True)
    except SystemExit:
        if not trainer.interrupted:
            raise
    if trainer.interrupted:
        signal.signal(signal.SIGINT, handler)  # Lightning has it ignored
        raise KeyboardInterrupt


def _trainer(settings: TrainConfig, folder: Path, device: torch.device, callbacks: list[Callback]) -> lightning.Trainer:
    """Return Lightning's trainer."""
    return lightning.Trainer(
        accelerator="gpu" if device.type == "cuda" else device.type,
        devices=1 if device.type == "cpu" or device.index is None else [device.index],
        precision="bf16-mixed" if settings.precision == "bfloat16" else "32-true",
        max_steps=settings.trainer.steps,
        gradient_clip_val=settings.trainer.clip,
        reload_dataloaders_every_n_epochs=1,
        log_every_n_steps=min(10, settings.trainer.validate_every),
        logger=TensorBoardLogger(folder, name="", version="tensorboard"),
        callbacks=callbacks,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )


def _announce(
    console: Console,
    settings: TrainConfig,
    net: MSGNet,
    data: PatchData,
    objective: Objective,
    folder: Path,
    resume: Path | None,
) -> None:
    """Say what the run will do."""
    visual = f" + {objective.w:.3g} MSE_v" if objective.w else ""
    trainer = settings.trainer
    lines: Mapping[str, Any] = {
        "model": f"{settings.model['name']} x{settings.scale}, {sum(p.numel() for p in net.parameters()):,} parameters",
        "data": f"{len(data.training_names)} scenes of {settings.dataset['name']} to train on, "
        f"{len(data.validation_names)} to validate with",
        "loss": f"{objective.depth_loss}{visual}",
        "steps": f"{trainer.steps} of {trainer.batch} patches of {trainer.patch} x {trainer.patch}"
        + (", resumed" if resume else ""),
        "log": f"tensorboard --logdir {folder}",
    }
    for name, line in lines.items():
        console.print(f"{name:<6} {line}", markup=False, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def _without_chatter() -> Iterator[None]:
    """Keep Lightning's tips, and its warnings of what is meant to be so, off the terminal."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*does not have many workers.*")
            warnings.filterwarnings("ignore", ".*smaller than the logging interval.*")
            for resumed in ("exists and is not empty", "that ended before the epoch ended"):
                warnings.filterwarnings("ignore", f".*{resumed}.*")
            warnings.filterwarnings("ignore", ".*LeafSpec.*", FutureWarning)
            warnings.filterwarnings("ignore", ".*LeafSpec.*", DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)


def _export(module: SuperResolution, best: Path, weights: Path, name: str) -> None:
    """Write the weights of the best checkpoint."""
    state = torch.load(best, map_location="cpu", weights_only=True)["state_dict"]
    module.load_state_dict(state)
    with replacing(weights) as temporary:
        save_msg_weights(temporary, module.net, name)
