"""The command behind ``train.py``: seed, network, data, module, callbacks, loggers, trainer; fit; write the weights."""

import contextlib
import fnmatch
import functools
import math
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import lightning
import torch
from lightning.pytorch.callbacks import (
    Callback,
    GradientAccumulationScheduler,
    LearningRateMonitor,
    ModelCheckpoint,
    ProgressBar,
)
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins import environments
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dsr.app import run_directory as rundir
from dsr.app.metrics import check_metrics, metric_collection
from dsr.app.schema import (
    READ_OF_TRAINER,
    Config,
    Identity,
    TrainConfig,
    given_keys,
    given_overrides,
    plain_config,
    runs_here,
)
from dsr.app.training_runs import WEIGHTS, keyed, read_config, training_data
from dsr.data.scene_source import prepare_scenes
from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import load_network, network_name, save_network
from dsr.training.callbacks import log_layout
from dsr.training.data_module import PatchData
from dsr.training.module import SuperResolution
from dsr.utils import interruption
from dsr.utils.arrays import read_torch_file
from dsr.utils.checkpoints import (
    BestCheckpoint,
    DivergenceError,
    Interruption,
    ScoreTables,
    StepProgress,
    fit,
    make_trainer,
    without_chatter,
)
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.configuration import ConfigError, build, expect_library
from dsr.utils.console import USAGE_ERROR, ConsoleProgress, one_line
from dsr.utils.files import replacing
from dsr.utils.guards import did_you_mean
from dsr.utils.runs_table import list_run

MONITOR = "val/RMSE_v"
_LARGEST_SEED = 2**32 - 1
_LAST = Path("checkpoints", "last.ckpt")  # which a training goes on from, in the directory of its run
_OF_PROCESSES = ("LOCAL_RANK", "NODE_RANK", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")  # which Lightning sets
_CREDENTIALS = re.compile(r"[A-Za-z][\w+.-]*://([^\s/]*|\S*:\S*)@")  # before the host of an address
_RESUMABLE = ("resume", "device", "trust")  # keys that may stand beside resume=


def train(config: DictConfig) -> float:
    """Train a network: checkpoints, a TensorBoard log, and the weights of the best validation RMSE_v.

    An interrupted run is continued from its last checkpoint by the same command or by ``resume=RUN_DIR``. Returns the
    mean RMSE_v of the validation of the weights that are kept, as a fraction like those in files.
    """
    plain, settings, device = _read(config)
    processes = find_processes(device, settings.trainer["devices"])
    with processes.running():
        return _Training(plain, settings, device, processes).run()


def check(config: DictConfig) -> Iterator[tuple[Path, Identity]]:
    """Check what :func:`train` would do as a job of a multirun, and write nothing; yield its directory and identity."""
    here = runs_here()
    plain, settings, device = _read(config, here=here)
    prepared = _Training(plain, settings, device, find_processes(device, settings.trainer["devices"] if here else 1))
    elsewhere = () if here else ("device", "precision")
    rundir.expect_free(prepared.folder, plain, prepared.identity, (*prepared.tolerated, *elsewhere))
    yield prepared.folder, prepared.identity


@dataclass(frozen=True)
class Processes:
    """The processes of a training, one per device; Lightning starts them, unless ``srun`` or ``torchrun`` have."""

    count: int
    rank: int  # of this one; 0 writes files and prints
    environment: environments.ClusterEnvironment  # what Lightning learns of the processes from

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Join the processes within this context; Lightning's end with the first one, which alone reports a mistake."""
        before = {name: os.environ[name] for name in _OF_PROCESSES if name in os.environ}
        rank_zero_only.rank = self.rank  # type: ignore[attr-defined]
        if self.rank and isinstance(self.environment, environments.LightningEnvironment):
            interruption.end_with(os.getppid())
        try:
            yield
        except (ConfigError, KeyboardInterrupt) as error:
            if self.rank == 0:
                raise
            sys.exit(USAGE_ERROR if isinstance(error, ConfigError) else interruption.exit_code())
        finally:
            if self.count > 1 and torch.distributed.is_initialized():
                torch.distributed.destroy_process_group()
            for name in _OF_PROCESSES:  # the next job of a multirun starts processes of its own
                os.environ.pop(name, None)
            os.environ.update(before)


def find_processes(device: torch.device, devices: int | Literal["auto"]) -> Processes:
    """Return the processes on a number of devices of a kind; ``auto`` for all that there are, on a CPU one.

    A step of Slurm with one task is a process as any other: Lightning must neither expect that Slurm starts those of
    further devices, nor answer the signals by which submitit or the user wants a job to be requeued.
    """
    there = torch.cuda.device_count() if device == torch.device("cuda") else 1
    count = there if devices == "auto" else devices
    if device.type != "cpu" and count > there:
        raise ConfigError(f"trainer.devices: expected at most {there} for device={device}, got {count}")
    environment: environments.ClusterEnvironment = environments.LightningEnvironment()
    tasks = os.environ.get("SLURM_STEP_NUM_TASKS", "")
    started = None
    if environments.TorchElasticEnvironment.detect():
        environment, started = environments.TorchElasticEnvironment(), int(os.environ["WORLD_SIZE"])
    elif tasks.isdecimal() and int(tasks) > 1:  # not in a job's script, which no srun has started
        os.environ.setdefault("SLURM_NTASKS_PER_NODE", tasks)  # Lightning asks for it
        environment, started = environments.SLURMEnvironment(auto_requeue=False), int(tasks)
    if started not in (None, count):
        raise ConfigError(f"trainer.devices: expected {started}, the number of processes of this job, got {count}")
    rank = environment.global_rank() if started else environment.local_rank()
    return Processes(count, rank if count > 1 else 0, environment)


def _read(config: DictConfig, *, here: bool = True) -> tuple[dict[str, Any], TrainConfig, torch.device]:
    """Return the configuration, perhaps of the run to resume, its checked settings and the device to train on."""
    plain = plain_config(config)
    resumed = plain.get("resume") is not None
    if resumed:
        folder = Path(plain["resume"]).expanduser()
        if others := ", ".join(key for key in given_keys() if key not in _RESUMABLE):
            raise ConfigError(f"resume: continues with the run's own configuration; {others} cannot be changed")
        before = read_config(folder, plain["trust"])
        device = {"device": plain["device"]} if "device" in given_keys() else {}
        plain = {**before, **device, "resume": None, "output_dir": str(folder), "overwrite": False, "trust": None}
    settings = TrainConfig.of(plain)
    if resumed:
        settings.patches.setdefault("on_device", False)  # as runs that were begun without this key
    chosen = pick_device(settings.device, precision=settings.precision) if here else torch.device("cpu")
    if settings.precision == "auto":
        plain["precision"] = settings.precision = fast_precision(chosen)
    return plain, settings, chosen


class _Training:
    """A training that can be run, in the directory of its run, of which nothing is written yet."""

    def __init__(self, plain: Config, settings: TrainConfig, device: torch.device, processes: Processes) -> None:
        if settings.seed > _LARGEST_SEED:
            raise ConfigError(f"seed: expected at most {_LARGEST_SEED}, got {settings.seed}")
        lightning.seed_everything(settings.seed, workers=True, verbose=False)
        net = _network(settings)
        data = training_data(settings, processes.count, device)
        if settings.downsampling.get("assumed") is not None:
            raise ConfigError("downsampling.assumed: a training assumes no downsampling model; leave it out")
        check_metrics(settings.metrics)
        module = _module(settings, net, data)
        if settings.trainer["compile"]:
            module.net.compile(dynamic=False)
        identity = rundir.identity_of(plain, None, device)
        folder = rundir.directory_of("train", plain, identity, given_overrides())
        progress = ConsoleProgress(Console(quiet=processes.rank > 0))
        best = BestCheckpoint(folder / _LAST.parent, MONITOR)
        callbacks = [
            *_own_callbacks(settings, module),
            ScoreTables(folder / "validation.csv", best),
            best,
            StepProgress(progress, "train"),
            Interruption(folder / _LAST),
        ]
        loggers = []
        for name, node in settings.logger.items():
            if name in ("wandb", "mlflow"):  # an extra of that name installs the library
                expect_library(f"logger={name}", name, name)
            for key, value in node.items():  # of which the run's config.yaml keeps each
                if isinstance(value, str) and _CREDENTIALS.search(value):
                    what = "an address without name and password, which the service reads from the environment"
                    raise ConfigError(f"logger.{name}.{key}: expected {what}")
            with without_chatter():
                loggers.append(build(f"logger.{name}", {"save_dir": str(folder), **node}))
        ours = READ_OF_TRAINER.keys() - {"gradient_clip_val"}  # the limit of gradients is only checked here
        unused = "_find_unused_parameters_true" if settings.degradation.get("scales") else ""  # layers of one factor
        trainer = make_trainer(
            device,
            settings.steps,
            settings.interval,
            callbacks=callbacks,
            node={key: value for key, value in settings.trainer.items() if key not in ours},
            logger=loggers,
            devices=processes.count,
            accumulate=settings.accumulate,
            environment=processes.environment,
            strategy=f"ddp{unused}" if processes.count > 1 else "auto",
            precision="bf16-mixed" if settings.precision == "bfloat16" else "32-true",
            default_root_dir=folder,
        )
        resumable = ("results_version", "scenes_version", "outside_code", "device")
        self.tolerated = resumable if "resume" in given_keys() else ()
        self.resume = folder / _LAST if (folder / _LAST).is_file() and not settings.overwrite else None
        self.plain, self.settings, self.identity, self.folder, self.device = plain, settings, identity, folder, device
        self.data, self.module, self.trainer, self.best, self.progress = data, module, trainer, best, progress

    def run(self) -> float:
        """Train in one of the processes, the first of which has the directory for itself; return the best score."""
        settings, folder, data, module, trainer = self.settings, self.folder, self.data, self.module, self.trainer
        if trainer.is_global_zero:
            rundir.expect_free(folder, self.plain, self.identity, self.tolerated)
            if (folder / WEIGHTS).exists() and not settings.overwrite:
                raise ConfigError(f"output_dir: {folder / WEIGHTS} is trained already; overwrite=true trains it again")
        held_out = ", ".join(f"{len(names)} of {kind}" for kind, (_, names) in data.held_out.items())
        count = sum(len(names) for _, names in data.trained)
        parameters = sum(each.numel() for each in module.net.parameters())
        patch, several = data.patches.patch, f" x {settings.accumulate} batches" if settings.accumulate > 1 else ""
        several += f" x {trainer.world_size} devices" if trainer.world_size > 1 else ""
        logs = (f"tensorboard --logdir {folder}" if name == "tensorboard" else name for name in settings.logger)
        computed = f"{parameters:,} parameters, {settings.precision} on {self.device}"
        for line in (
            f"model  {settings.names['model']} x{settings.scale}, {computed}",
            f"data   {count} scenes of {settings.names['dataset']} to train on, {held_out} to validate with",
            f"steps  {settings.steps} of {data.patches.batch} patches of {patch} x {patch}{several}"
            f"{', resumed' if self.resume else ''}",
            f"log    {', '.join(logs)}",
        ):
            self.progress.say(line)
        for source, names in (*data.trained, *data.held_out.values()):
            prepare_scenes(source, names, self.progress)
        with keyed():
            data.setup()
            module.objective = module.objective.balanced(data.first_patches)  # its weights may depend on the scenes
        self.progress.say(f"loss   {module.objective.formula}")
        if not trainer.is_global_zero:
            return self._fit()
        with rundir.at_work(folder, self.plain, self.identity, self.tolerated, alone=True) as changed:
            for key in changed:
                self.progress.say(f"note: the run began with another {key}")
            if settings.overwrite:  # nothing of the earlier training is taken for this one's if it is interrupted
                (folder / WEIGHTS).unlink(missing_ok=True)
                for name in ("checkpoints", "tensorboard", "csv", "wandb"):
                    shutil.rmtree(folder / name, ignore_errors=True)
            return self._fit()

    def _fit(self) -> float:
        """Train in the directory of the run; return the score of the weights that are kept."""
        plain, settings, folder, trainer = self.plain, self.settings, self.folder, self.trainer
        groups = ("model", "dataset", "downsampling", "noise", "degradation", "trainer")
        facts = {
            **{group: plain["names"][group] for group in groups},
            **{key: plain[key] for key in ("scale", "seed", "precision")},
            "steps": settings.steps,
            "learning_rate": settings.model.get("optimizer", {}).get("lr"),
            **{key: getattr(self.data.patches, key) for key in ("batch", "patch")},
            **self.module.objective.facts,
        }
        if trainer.is_global_zero:
            self._log(facts)
        try:
            fit(trainer, self.module, self.data, self.resume)
        except DivergenceError as error:
            raise ConfigError(
                f"{folder}: the training {error}; checkpoints of earlier steps are kept; a lower model.optimizer.lr or "
                "trainer.gradient_clip_val, or a longer model.scheduler.warmup, may help, with overwrite=true"
            ) from error
        except MisconfigurationException as error:
            raise ConfigError(f"trainer, callbacks: {one_line(error)}") from error
        except KeyboardInterrupt:
            message = f"interrupted at step {trainer.global_step}; resume={folder} continues from there"
            raise KeyboardInterrupt(message) from None
        finally:
            client: Any = sys.modules.get("wandb")
            if getattr(client, "run", None) is not None:
                client.finish()  # so that the next job of a multirun has a run of its own
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return math.nan
        if trainer.is_global_zero:
            kept = folder / _LAST.with_name(f"{settings.keep}.ckpt")
            checkpoint = read_torch_file(kept)
            state, prefix = checkpoint["state_dict"], "average."
            average = {name.removeprefix(prefix): each for name, each in state.items() if name.startswith(prefix)}
            self.module.average.load_state_dict(average)
            facts["steps"] = checkpoint["global_step"]
            with replacing(folder / WEIGHTS) as temporary:
                save_network(temporary, self.module.average, facts["model"], facts)
        self.progress.say(f"weights: {folder / WEIGHTS}")
        score = self.best.best_model_score if settings.keep == "best" else trainer.callback_metrics.get(MONITOR)
        return math.nan if score is None else float(score)

    def _log(self, facts: Mapping[str, Any]) -> None:
        """Log the configuration before there are values: TensorBoard gets its main settings and a layout of charts."""
        plain = self.plain
        metrics: Any = self.module.metrics[0]
        table = {**facts, "method": facts["model"], "degradation": rundir.degradation_of(plain)}
        for logger in self.trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_text("config", f"```yaml\n{OmegaConf.to_yaml(OmegaConf.create(dict(plain)))}```")
                logger.experiment.flush()
                log_layout(logger, {name: metric.chart_title for name, metric in metrics.items()})
                logger.log_hyperparams(table)
                list_run(logger.experiment, "training", table, {})
            elif self.resume is None:  # MLflow refuses another device, say
                loss = {**plain["loss"], "w": facts["w"]} if "w" in facts else {}
                logger.log_hyperparams({**plain, "loss": loss})


def _network(settings: TrainConfig) -> DisparityNetwork:
    net: DisparityNetwork = build("model.net", settings.model["net"])
    for key, take in (("weights", net.start_from), ("shared", net.share)):
        given = getattr(settings.start, key)
        if given is None:
            continue
        try:
            start = load_network(Path(given).expanduser(), {**NETWORKS, network_name(type(net)): type(net)})
        except (ValueError, OSError) as error:
            raise ConfigError(f"start.{key}: {error}") from error
        try:
            take(start)
        except ValueError as error:
            raise ConfigError(f"start.{key}: {given}: {error}") from error
    for scale in settings.degradation.get("scales") or ():
        if not net.serves(settings.scale, int(scale)):
            expected = f"factors that weights for {settings.scale} serve"
            raise ConfigError(f"degradation.scales: expected {expected}, got {scale}")
    for pattern in settings.start.frozen:
        found = [value for name, value in net.named_parameters() if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            kinds = ", ".join(dict.fromkeys(f"{name.split('.')[0]}.*" for name, _ in net.named_parameters()))
            raise ConfigError(f"start.frozen: expected patterns of parameters' names, such as {kinds}; got {pattern}")
        for value in found:
            value.requires_grad_(False)
    return net


def _module(settings: TrainConfig, net: DisparityNetwork, data: PatchData) -> SuperResolution:
    node, names = settings.model, settings.names
    w, loss = node["objective"].get("w"), settings.loss
    for key, unused in (("visual", not w and loss.visual != "mse_v"), ("w", loss.w not in ("auto", w))):
        if unused:
            what = "a loss of its own" if w is None else "no visual loss, which model.objective.w=auto adds"
            raise ConfigError(f"loss.{key}: model={names['model']} has {what}; leave it out")
    metrics = functools.partial(metric_collection, settings.metrics)
    given = {"net": net, "metrics": metrics, "validation_sets": list(data.held_out)}
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


def _own_callbacks(settings: TrainConfig, module: SuperResolution) -> list[Callback]:
    scored: Any = module.metrics[0]
    kinds = ["val", *(f"{kind}_{each}" for kind in ("val", "bicubic") for each in module.sets), "bicubic"]
    known = [f"{kind}/{name}" for kind in kinds for name in scored]
    own: list[Callback] = []
    for name, node in settings.callbacks.items():
        each = build(f"callbacks.{name}", node)
        monitor = getattr(each, "monitor", None)
        if monitor is not None and not monitor.startswith("train/") and monitor not in known:
            expected = f"one of {', '.join(known[: len(scored)])}"
            near = did_you_mean(monitor, known)
            raise ConfigError(f"callbacks.{name}.monitor: expected {expected}, got {monitor}{near}")
        if isinstance(each, LearningRateMonitor) and not settings.logger:
            raise ConfigError(f"callbacks.{name}: expected a logger to write to, such as logger=csv, got none")
        if isinstance(each, ProgressBar | GradientAccumulationScheduler):
            what = "shows progress, which dsr does, or accumulates batches, which trainer.accumulate_grad_batches does"
            raise ConfigError(f"callbacks.{name}: expected none that {what}; leave it out")
        if isinstance(each, ModelCheckpoint):  # whose keys would be alike
            each.__class__ = type(type(each).__name__, (type(each),), {"state_key": f"callbacks.{name}"})
        own.append(each)
    return own
