"""The command behind ``train.py``."""

from __future__ import annotations

import contextlib
import fnmatch
import functools
import math
import os
import shutil
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dsr.app import run_directory as rundir
from dsr.app.devices import Processes, find_processes
from dsr.app.divergence import NOTE, expect_no_divergence, note_divergence, step_of
from dsr.app.metrics import check_metrics, metric_collection
from dsr.app.multirun import Plan, runs_here
from dsr.app.schema import Config, Identity, TrainConfig, given_keys, plain_config
from dsr.app.trainer import (
    MONITOR,
    has_idle_layers,
    seconds_per_step,
    seconds_per_validation,
    seconds_to_prepare,
    training_trainer,
)
from dsr.app.training_runs import WEIGHTS, keyed, read_config, training_data
from dsr.data.scene_source import SceneSource, prepare_scenes
from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import load_network, network_name, save_network
from dsr.training.data_module import PatchData
from dsr.training.loggers import RUN_IDS, expect_installed, log_config, log_layout, log_settings
from dsr.training.module import SuperResolution
from dsr.training.settings import PatchSettings
from dsr.utils import interruption
from dsr.utils.checkpoints import CheckpointError, DivergenceError
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.configuration import ConfigError, build, check
from dsr.utils.console import USAGE_ERROR, ConsoleProgress, one_line, without_credentials
from dsr.utils.files import replacing
from dsr.utils.guards import expect_stored
from dsr.utils.lightning import NOT_OF_A_CALLBACK, fit
from dsr.utils.progress import SILENT, Progress, duration
from dsr.utils.torch_files import read_torch_file

_LARGEST_SEED = 2**32 - 1
_FOLDERS = ("checkpoints", "tensorboard", "csv", "wandb", "mlruns")
"""What a training writes into its directory beside files."""
_LAST = Path("checkpoints", "last.ckpt")
"""The checkpoint that a training goes on from, in the directory of its run."""
_RESUMABLE = ("resume", "device", "trust")


def train(config: DictConfig) -> float:
    """Train a network: checkpoints, a TensorBoard log, and the weights of the best validation RMSE_v.

    An interrupted run is continued from its last checkpoint by the same command or by ``resume=RUN_DIR``.

    Args:
        config: composed from ``conf/train.yaml``.

    Returns:
        The score of the validation of the weights that are kept, their mean RMSE_v, as a fraction like those in files.

    Raises:
        ConfigError: the configuration cannot be run, or its training is already complete.
        KeyboardInterrupt: the training was interrupted; the message says how to resume it.

    """
    plain, settings, device = _read(config)
    processes = _processes(settings, device)
    with processes.running():
        if processes.first:
            return _train(plain, settings, device, processes)
        try:
            return _train(plain, settings, device, processes)
        except (ConfigError, KeyboardInterrupt) as error:  # the first process says so
            if not isinstance(error, KeyboardInterrupt):
                sys.exit(USAGE_ERROR)
            interruption.await_requeue()
            sys.exit(interruption.exit_code())


def plan(config: DictConfig) -> list[Plan]:
    """Check what :func:`train` would do as a job of a multirun; nothing is computed or written.

    A training that is complete, or that would diverge again, is no work, and keeps no other one from its own.

    Args:
        config: composed from ``conf/train.yaml``.

    Raises:
        ConfigError: the configuration cannot be run.

    """
    here = runs_here()
    plain, settings, device = _read(config, here=here)
    count = _processes(settings, device).count if here else 1
    prepared = _prepare(plain, settings, device, count)
    elsewhere = () if here else ("device", "precision")
    rundir.expect_free(prepared.folder, plain, prepared.identity, (*prepared.tolerated, *elsewhere))
    left = _steps_left(prepared, settings)
    done = settings.steps - left

    def seconds(shared: set[str]) -> float:
        scenes = str((plain["dataset"], plain["validation"]))  # which the first job of several prepares
        sources = [] if scenes in shared else _by_source(prepared.data)
        shared.add(scenes)
        return sum(_costs(settings, prepared, sources, done, devices=count, progress=SILENT).values())

    return [Plan(prepared.folder, prepared.identity, "step", left, done, seconds if here else None)]


def _steps_left(prepared: _Prepared, settings: TrainConfig) -> int:
    """Return how many steps are to be done; none if the training is complete or would diverge again."""
    try:
        _expect_unfinished(prepared.folder, prepared.identity, overwrite=settings.overwrite)
    except ConfigError:
        return 0
    if prepared.resume is None:
        return settings.steps
    try:
        return settings.steps - int(read_torch_file(prepared.resume)["global_step"])
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise CheckpointError(prepared.resume, error) from error


def _processes(settings: TrainConfig, device: torch.device) -> Processes:
    """Return the processes of the training."""
    return find_processes(device, settings.trainer["devices"], settings.trainer["strategy"])


def _read(config: DictConfig, *, here: bool = True) -> tuple[dict[str, Any], TrainConfig, torch.device]:
    """Return the configuration, perhaps of the run to resume, its checked settings and the device to train on."""
    plain = _resumed(plain_config(config))
    settings = TrainConfig.of(plain)
    _set_accumulation(settings)
    device = pick_device(settings.device) if here else torch.device("cpu")
    if settings.precision == "auto":
        plain["precision"] = settings.precision = fast_precision(device)
    return plain, settings, device


def _set_accumulation(settings: TrainConfig) -> None:
    """Take the batches of a step from Lightning's scheduler: a training is one epoch, so that they never change."""
    for name, node in settings.callbacks.items():
        if isinstance(node, Mapping) and str(node.get("_target_")).endswith(".GradientAccumulationScheduler"):
            if settings.accumulate > 1:
                raise ConfigError(f"callbacks.{name}: expected trainer.accumulate_grad_batches=1 beside it")
            scheduler = build(f"callbacks.{name}", node)
            settings.trainer["accumulate_grad_batches"] = scheduler.get_accumulate_grad_batches(0)
            settings.callbacks = {other: each for other, each in settings.callbacks.items() if other != name}


@dataclass(frozen=True)
class _Prepared:
    """A training that can be run, in the directory of its run."""

    device: torch.device
    data: PatchData
    module: SuperResolution
    identity: Identity
    folder: Path
    resume: Path | None
    tolerated: tuple[str, ...]


def _prepare(plain: Config, settings: TrainConfig, device: torch.device, devices: int) -> _Prepared:
    """Check and build all that a training on a number of devices needs, and write nothing."""
    if settings.seed > _LARGEST_SEED:
        raise ConfigError(f"seed: expected at most {_LARGEST_SEED}, got {settings.seed}")
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    net = _network(settings)
    data = training_data(settings, devices)
    if settings.downsampling.get("assumed") is not None:
        raise ConfigError("downsampling.assumed: a training assumes no downsampling model; leave it out")
    check_metrics(settings.metrics)
    for name, node in settings.logger.items():
        expect_installed(name)
        for key, value in node.items():
            if isinstance(value, str) and without_credentials(value) != value:
                raise ConfigError(
                    f"logger.{name}.{key}: expected an address without name and password, which the run's config.yaml "
                    "would keep; the service reads them from the environment"
                )
    check("trainer", settings.more_of_trainer)
    for group in ("callbacks", "logger"):
        for name, node in getattr(settings, group).items():
            check(f"{group}.{name}", node)
    identity = rundir.identity_of(plain, None, device)
    folder = rundir.folder_of(settings.output_dir or rundir.default_directory("train", plain, identity))
    last = folder / _LAST
    metrics = functools.partial(metric_collection, settings.metrics)
    module = _module(settings, net, data, metrics)
    tolerated = ("results_version", "scenes_version", "device") if "resume" in given_keys() else ()
    resume = last if last.is_file() and not settings.overwrite else None
    return _Prepared(device, data, module, identity, folder, resume, tolerated)


def _train(plain: Config, settings: TrainConfig, device: torch.device, processes: Processes) -> float:
    """Train in one of the processes, the first of which has the directory for itself, and return the best score."""
    prepared = _prepare(plain, settings, device, processes.count)
    folder = prepared.folder
    new = not folder.exists()
    if not processes.first:
        return _fit(plain, settings, prepared, processes, new=False)
    rundir.expect_free(folder, plain, prepared.identity, prepared.tolerated)
    with rundir.at_work(folder, plain, prepared.identity, alone=True):
        return _fit(plain, settings, prepared, processes, new=new)


def _fit(plain: Config, settings: TrainConfig, prepared: _Prepared, processes: Processes, *, new: bool) -> float:
    """Train in a directory, which is ``new`` if this training has made it, and return the best score."""
    first, device = processes.first, prepared.device
    progress = ConsoleProgress(Console(quiet=not first))
    data, module, identity, folder = prepared.data, prepared.module, prepared.identity, prepared.folder
    resume, tolerated, weights = prepared.resume, prepared.tolerated, folder / WEIGHTS
    if first:
        _expect_trainable(folder, plain, identity, tolerated)
        _claim(folder, plain, identity, tolerated, progress)
    idle = processes.count > 1 and has_idle_layers(module, data.example_batch())
    trainer = None
    try:
        scored: Any = module.metrics[0]
        known = [f"val/{name}" for name in scored]
        trainer, best, own = training_trainer(settings, folder, device, progress, processes, known=known, idle=idle)
        if first:
            _open_log(trainer, plain, module)
            _announce(progress, settings, prepared, processes.count)
        _load(progress, module, data)
    except ConfigError:
        if new:  # a corrected command begins anew
            _discard(trainer, folder)
        raise
    facts = _facts(plain, module, data.patches)
    if first:
        _describe(trainer, plain, facts, resumed=resume is not None)
    _fit_steps(trainer, own, prepared, new=new)
    if trainer.fast_dev_run:  # type: ignore[attr-defined]
        return math.nan
    if first:
        _export(module, folder / _LAST.with_name(f"{settings.keep}.ckpt"), weights, facts)
    progress.say(f"weights: {weights}")
    score = best.best_model_score if settings.keep == "best" else trainer.callback_metrics.get(MONITOR)
    return math.nan if score is None else float(score)


def _fit_steps(
    trainer: lightning.Trainer, callbacks: Mapping[str, Callback], prepared: _Prepared, *, new: bool
) -> None:
    """Train; an error that one of Lightning's or dsr's callbacks raises is of the configuration."""
    folder = prepared.folder
    try:
        fit(trainer, prepared.module, prepared.data, prepared.resume)
    except DivergenceError as error:
        raise note_divergence(folder, folder / _LAST, prepared.identity, error) from error
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted at step {trainer.global_step}; resume={folder} continues from there"
        ) from None
    except Exception as error:
        subjects = {id(frame.f_locals.get("self")) for frame, _ in traceback.walk_tb(error.__traceback__)}
        theirs = [name for name, each in callbacks.items() if type(each).__module__.startswith(("lightning.", "dsr."))]
        name = next((name for name in theirs if id(callbacks[name]) in subjects), None)
        if name is None or isinstance(error, NOT_OF_A_CALLBACK):
            raise
        if new and not trainer.global_step:
            _discard(trainer, folder)
        raise ConfigError(f"callbacks.{name}: {one_line(error)}") from error


def _expect_trainable(folder: Path, plain: Config, identity: Identity, tolerated: Sequence[str]) -> None:
    """Check that the directory is free or that of this training, which is neither complete nor diverges again."""
    rundir.expect_free(folder, plain, identity, tolerated)
    _expect_unfinished(folder, identity, overwrite=plain["overwrite"])


def _expect_unfinished(folder: Path, identity: Identity, *, overwrite: bool) -> None:
    """Check that a training is neither complete nor diverges again."""
    if overwrite:
        return
    if (folder / WEIGHTS).exists():
        raise ConfigError(f"output_dir: {folder / WEIGHTS} is trained already; overwrite=true trains it again")
    expect_no_divergence(folder, identity)


def _claim(folder: Path, plain: Config, identity: Identity, tolerated: Sequence[str], progress: Progress) -> None:
    """Make the directory that of this training, without the files of one that it replaces."""
    for key in rundir.claim(folder, plain, identity, tolerated):
        progress.say(f"note: the run began with another {key}")
    if plain["overwrite"]:
        _clear(folder)


def _discard(trainer: lightning.Trainer | None, folder: Path) -> None:
    """Remove the directory of a training that cannot begin."""
    for logger in trainer.loggers if trainer is not None else ():
        logger.finalize("failed")
    shutil.rmtree(folder)
    if folder.parent == Path("outputs", "train"):
        with contextlib.suppress(OSError):  # others are in it
            os.removedirs(folder.parent)


def _resumed(plain: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration, or the configuration of the run to resume."""
    if plain.get("resume") is None:
        return plain
    folder = Path(plain["resume"]).expanduser()
    others = [key for key in given_keys() if key not in _RESUMABLE]
    if others:
        raise ConfigError(f"resume: continues with the run's own configuration; {', '.join(others)} cannot be changed")
    before = read_config(folder, plain["trust"])
    try:
        expect_stored(folder / _LAST)
    except (ValueError, OSError, BadZipFile) as error:
        raise ConfigError(f"resume: {error}") from error
    device = {"device": plain["device"]} if "device" in given_keys() else {}
    return {**before, **device, "resume": None, "output_dir": str(folder), "overwrite": False, "trust": None}


def _network(settings: TrainConfig) -> DisparityNetwork:
    """Build the network, with initial weights if they are given."""
    net: DisparityNetwork = build("model.net", settings.model["net"])
    for key, take in (("weights", net.start_from), ("shared", net.share)):
        given = getattr(settings.start, key)
        if given is None:
            continue
        try:
            networks = {**NETWORKS, network_name(type(net)): type(net)}
            first = load_network(Path(given).expanduser(), networks)
        except (ValueError, OSError) as error:
            raise ConfigError(f"start.{key}: {error}") from error
        try:
            take(first)
        except ValueError as error:
            raise ConfigError(f"start.{key}: {given}: {error}") from error
    for scale in settings.degradation.get("scales") or ():
        if not net.serves(settings.scale, int(scale)):
            raise ConfigError(
                f"degradation.scales: expected factors that weights for {settings.scale} serve, got {scale}"
            )
    for pattern in settings.start.frozen:
        found = [value for name, value in net.named_parameters() if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            kinds = ", ".join(dict.fromkeys(f"{name.split('.')[0]}.*" for name, _ in net.named_parameters()))
            raise ConfigError(f"start.frozen: expected patterns of parameters' names, such as {kinds}; got {pattern}")
        for value in found:
            value.requires_grad_(False)
    return net


def _module(settings: TrainConfig, net: DisparityNetwork, data: PatchData, metrics: Any) -> SuperResolution:
    """Build the training module, and its optimiser once, for its errors."""
    node, names = settings.model, settings.names
    w, loss = node["objective"].get("w"), settings.loss
    for key, unused in (("visual", not w and loss.visual != "mse_v"), ("w", loss.w not in ("auto", w))):
        if unused:
            what = "a loss of its own" if w is None else "no visual loss, which model.objective.w=auto adds"
            raise ConfigError(f"loss.{key}: model={names['model']} has {what}; leave it out")
    given = {"net": net, "metrics": metrics, "validation_sets": data.validation_sets}
    with keyed():
        module = build("model", {key: value for key, value in node.items() if key not in given}, given, names["model"])
        module.logs_curves = False  # a callback of the configuration does
        module.objective.check(net, data.patches.patch, hinted=names["degradation"] != "plain")
    try:
        module.configure_optimizers()
    except (ValueError, TypeError) as error:
        part = "optimizer" if "nvalid" in str(error) else "scheduler"  # as torch's optimisers say
        raise ConfigError(f"model.{part}: {error}") from error
    return module


def _load(progress: Progress, module: SuperResolution, data: PatchData) -> None:
    """Prepare and load the scenes, and compute the weights of the loss that depend on them."""
    for source, names in data.used_scenes:
        prepare_scenes(source, names, progress)
    with keyed():
        data.setup()
        balanced = module.objective.balanced(data.first_patches)
    if balanced is not module.objective:
        module.objective = balanced
        progress.say(f"loss   {balanced.formula}")


def _clear(folder: Path) -> None:
    """Remove the files of an earlier training, so that they are not taken for this one's if it is interrupted."""
    for name in (WEIGHTS, NOTE, *RUN_IDS.values()):
        (folder / name).unlink(missing_ok=True)
    for name in _FOLDERS:
        shutil.rmtree(folder / name, ignore_errors=True)


def _announce(progress: Progress, settings: TrainConfig, prepared: _Prepared, devices: int) -> None:
    """Show what the run will do, and how long it will take."""
    data, module = prepared.data, prepared.module
    patches = data.patches
    held_out = ", ".join(f"{len(names)} of {kind}" for kind, (_, names) in data.validation_scenes().items())
    parameters = sum(each.numel() for each in module.net.parameters())
    accumulate = f" x {settings.accumulate} batches" if settings.accumulate > 1 else ""
    accumulate += f" x {devices} devices" if devices > 1 else ""
    lines: Mapping[str, Any] = {
        "model": f"{settings.names['model']} x{settings.scale}, {parameters:,} parameters, {settings.precision}",
        "data": f"{data.training_count} scenes of {settings.names['dataset']} to train on, {held_out} to validate with",
        "loss": module.objective.formula,
        "steps": f"{settings.steps} of {patches.batch} patches of {patches.patch} x {patches.patch}{accumulate}"
        + (", resumed" if prepared.resume else ""),
        "log": ", ".join(
            f"tensorboard --logdir {prepared.folder}" if name == "tensorboard" else name for name in settings.logger
        ),
    }
    for name, line in lines.items():
        progress.say(f"{name:<6} {line}")
    done = 0 if prepared.resume is None else step_of(prepared.resume) or 0
    costs = _costs(settings, prepared, _by_source(data), done, devices=devices, progress=progress)
    named = ", ".join(f"{duration(seconds)} for {what}" for what, seconds in costs.items()) or "all steps are done"
    progress.say(f"time   about {duration(sum(costs.values()))}: {named}, as measured now")


def _costs(
    settings: TrainConfig,
    prepared: _Prepared,
    sources: Sequence[tuple[SceneSource, list[str]]],
    done: int,
    *,
    devices: int,
    progress: Progress,
) -> dict[str, float]:
    """Return the seconds of what a training has left after ``done`` steps, as measured now, by what it is."""
    data, module = prepared.data, prepared.module.to(prepared.device)
    interval = settings.interval
    steps, validations = settings.steps - done, math.ceil(settings.steps / interval) - done // interval + (not done)
    with keyed():
        pairs = [seconds_to_prepare(source, names, progress) for source, names in sources]
        validation = seconds_per_validation(module, data) / devices
    step = seconds_per_step(module, data.example_batch(), settings.precision) * settings.accumulate
    parts = {
        f"{sum(count for _, count in pairs)} scenes that are not in the cache": sum(seconds for seconds, _ in pairs),
        f"{steps} step{'s' * (steps != 1)} of {step:.2g} s": step * steps,
        f"{validations} validation{'s' * (validations != 1)} of {validation:.2g} s": validation * validations,
    }
    return {what: seconds for what, seconds in parts.items() if not what.startswith("0 ")}


def _by_source(data: PatchData) -> list[tuple[SceneSource, list[str]]]:
    """Return the scenes of each data set, those to validate with first, as one of them is measured with, too."""
    sources: dict[int, tuple[SceneSource, list[str]]] = {}
    for source, names in reversed(data.used_scenes):
        sources.setdefault(id(source), (source, []))[1].extend(names)
    return list(sources.values())


def _open_log(trainer: lightning.Trainer, plain: Config, module: SuperResolution) -> None:
    """Write the configuration to the logs, and lay them out."""
    collections: Any = module.metrics
    for logger in trainer.loggers:
        log_config(logger, f"```yaml\n{OmegaConf.to_yaml(OmegaConf.create(dict(plain)))}```")
        log_layout(logger, {name: metric.chart_title for name, metric in collections[0].items()})


def _describe(trainer: lightning.Trainer, plain: Config, facts: Mapping[str, Any], *, resumed: bool) -> None:
    """Write the main settings and the resulting w to the logs."""
    listed = {**facts, "method": facts["model"], "degradation": rundir.degradation_of(plain)}
    loss = {**plain["loss"], "w": facts["w"]} if "w" in facts else {}
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger) or not resumed:  # MLflow refuses another device, say
            log_settings(logger, listed, {**plain, "loss": loss})


def _facts(plain: Config, module: SuperResolution, patches: PatchSettings) -> dict[str, Any]:
    """Return the training's main settings, for the weights' header and the log."""
    groups = ("model", "dataset", "downsampling", "noise", "degradation", "trainer")
    return {
        **{group: plain["names"][group] for group in groups},
        **{key: plain[key] for key in ("scale", "seed", "precision")},
        "steps": plain["trainer"]["max_steps"],
        "learning_rate": plain["model"].get("optimizer", {}).get("lr"),
        **{key: getattr(patches, key) for key in ("batch", "patch")},
        **module.objective.facts,
    }


def _export(module: SuperResolution, kept: Path, weights: Path, facts: Mapping[str, Any]) -> None:
    """Write the averaged weights of a checkpoint, with the training's main settings."""
    prefix = "average."
    try:
        checkpoint = read_torch_file(kept)
        state, steps = checkpoint["state_dict"], int(checkpoint["global_step"])
        module.average.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OSError) as error:
        raise CheckpointError(kept, error) from error
    with replacing(weights) as temporary:
        save_network(temporary, module.average, facts["model"], {**facts, "steps": steps})
