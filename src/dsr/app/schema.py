"""The configuration: what its keys are, which values they take, and how it is composed."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Self

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from dsr.utils.configuration import ConfigError, build, config_directories
from dsr.utils.console import note_once
from dsr.utils.files import data_root
from dsr.utils.guards import did_you_mean, expect_one_of, is_number
from dsr.utils.ratios import NATIVE, SCALES

Config = Mapping[str, Any]  # a composed configuration as plain values
Identity = Mapping[str, Any]  # what a run's results depend on: settings, weights, versions, the kind of device
# Groups whose choice is in ``names``.
NAMED = ("dataset", "downsampling", "noise", "holes", "degradation", "method", "model", "optimizer", "scheduler",
         "trainer")  # fmt: skip
# Keys that users of Lightning look for, and those that dsr has for them.
_OF_LIGHTNING = {
    "ckpt_path": "resume=RUN_DIR of train.py or run=RUN_DIR of eval.py",
    "precision": "precision=bfloat16, tf32 or float32",
}
_LONGEST_NAME = 100
_MOST = 1024  # workers and threads, more of which no system starts
# Arguments of the trainer that dsr reads itself, and their defaults.
READ_OF_TRAINER = {"max_steps": 12000, "val_check_interval": 1000, "accumulate_grad_batches": 1, "devices": 1,
                   "strategy": "auto", "gradient_clip_val": None, "compile": False}  # fmt: skip
# Arguments of the trainer that dsr gives itself.
SET_BY_DSR = ("plugins", "use_distributed_sampler", "num_nodes", "default_root_dir", "enable_checkpointing",
               "barebones", "inference_mode", "max_epochs", "min_epochs", "max_time")  # fmt: skip


@dataclass
class MetricsConfig:
    """Which metrics to compute."""

    protocols: list[str] = field(default_factory=lambda: ["paper"])
    lpips: bool = True
    lpips_trunk: str | None = None
    alignment: str = "none"
    extra: list[str] = field(default_factory=list)


def expect_name(key: str, name: str) -> None:
    """Refuse a name, which becomes that of files and folders, that would lead elsewhere."""
    leads = name in ("", ".", "..") or {*"/\\"} & {*name} or not name.isprintable()
    if leads or len(name) > _LONGEST_NAME:
        raise ConfigError(f"{key}: expected a name without folders, got {name[:60]!r}")


def _is_count(value: object, most: float = math.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value <= most


@dataclass
class RunConfig:
    """The configuration that all commands have; ``names`` has the choices of the groups, which are nodes."""

    names: dict[str, Any] = field(default_factory=lambda: {"dataset": None})
    dataset: dict[str, Any] = MISSING
    downsampling: dict[str, Any] = MISSING
    noise: dict[str, Any] = MISSING
    metrics: MetricsConfig = field(default_factory=MetricsConfig)
    scale: int = 4
    device: str = "auto"
    precision: str = "auto"
    seed: int = 0
    output_dir: str | None = None
    overwrite: bool = False

    @classmethod
    def of(cls, plain: Config) -> Self:
        """Return the settings of a composed configuration; OmegaConf checks names and types, :meth:`check` values."""
        merged = OmegaConf.structured(cls)
        for key, value in plain.items():
            try:
                merged.merge_with({key: value})
            except OmegaConfBaseException as error:
                raise ConfigError(explain_value(error, error.full_key or key)) from error
        values: dict[str, Any] = OmegaConf.to_container(merged, resolve=True)  # type: ignore[assignment]
        for key, value in values.items():
            if value == MISSING:  # within a node it may be missing: a part of a mixture need not be used
                raise ConfigError(f"{key}: missing; give it as {key}=...")
        parts: dict[str, Any] = {each.name: each.default_factory for each in fields(cls)}
        settings = cls(**{key: parts[key](**value) if is_dataclass(parts[key]) else value
                          for key, value in values.items()})  # fmt: skip
        try:
            settings.check()
        except ValueError as error:
            raise ConfigError(str(error)) from error
        return settings

    def build(self, group: str) -> Any:
        """Build what a group's node describes."""
        name = self.names.get(group)
        return build(group, getattr(self, group), {} if name is None else {"name": name}, name)

    def check(self) -> None:
        """Check values beyond their types."""
        for group, name in self.names.items():
            expect_name(f"names.{group}", str(name))
        expect_one_of("precision", self.precision, ("float32", "tf32", "bfloat16", "auto"))
        if self.seed < 0:
            raise ConfigError(f"seed: expected 0 or a positive number, got {self.seed}")


@dataclass
class EvalConfig(RunConfig):
    """The configuration of ``eval.py``."""

    scale: Any = 4
    holes: dict[str, Any] = MISSING
    method: dict[str, Any] = MISSING
    label: str | None = None
    weights: str | None = None
    run: str | None = None
    trust: Any = None
    workers: Any = "auto"
    threads: Any = "auto"

    @property
    def measured(self) -> bool:
        """Whether the low-resolution maps are the scenes' own."""
        return str(self.downsampling.get("_target_")).endswith(".Measured")

    def check(self) -> None:
        """Check values beyond their types."""
        super().check()
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value != "auto" and not _is_count(value, _MOST):
                raise ConfigError(f"{name}: expected auto or a whole number from 1 to {_MOST}, got {value!r}")
        if not self.measured:
            expect_one_of("scale", self.scale, SCALES, "; downsampling=measured takes a sensor's map of any ratio")
        elif self.scale != NATIVE and not (is_number(self.scale) and self.scale >= 1):
            expected = f"{NATIVE} or the ratio of the measured maps, 1 or more"
            raise ConfigError(f"scale: expected {expected}, got {self.scale!r}")


@dataclass
class StartConfig:
    """The weights that a training starts from; see ``conf/train.yaml``."""

    weights: str | None = None
    shared: str | None = None
    frozen: list[str] = field(default_factory=list)


@dataclass
class LossConfig:
    """The loss on renderings beside the depth loss, for a model with a visual loss, and its weight."""

    visual: str = "mse_v"
    w: Any = "auto"


@dataclass
class TrainConfig(RunConfig):
    """The configuration of ``train.py``."""

    model: dict[str, Any] = MISSING
    degradation: dict[str, Any] = field(
        default_factory=lambda: {"_target_": "dsr.degradation.random_degradation.plain"}
    )
    trainer: dict[str, Any] = MISSING
    patches: dict[str, Any] = field(default_factory=lambda: {"_target_": "dsr.training.settings.PatchSettings"})
    start: StartConfig = field(default_factory=StartConfig)
    keep: str = "best"
    callbacks: dict[str, Any] = field(default_factory=dict)
    logger: dict[str, Any] = field(default_factory=dict)
    loss: LossConfig = field(default_factory=LossConfig)
    validation: dict[str, Any] = field(default_factory=dict)
    resume: str | None = None
    trust: Any = None

    def check(self) -> None:
        """Check values beyond their types, of the trainer without Lightning, which takes seconds to import."""
        super().check()
        expect_one_of("scale", self.scale, SCALES)
        if "net" not in self.model:
            raise ConfigError("model: missing; give it as model=...")
        expect_one_of("loss.visual", self.loss.visual, ("mse_v", "dssim", "lpips"))
        expect_one_of("keep", self.keep, ("best", "last"))
        w = self.loss.w
        if w != "auto" and (not is_number(w) or w < 0):
            raise ConfigError(f"loss.w: expected auto or a number, 0 or more, got {w!r}")
        for key in self.trainer:
            if key in SET_BY_DSR:
                raise ConfigError(f"trainer.{key}: unknown key; dsr sets it itself, a training has trainer.max_steps")
        if isinstance(self.trainer.get("profiler"), str):
            raise ConfigError("trainer.profiler: expected a node with _target_, dirpath and filename")
        trainer = self.trainer = {**READ_OF_TRAINER, **self.trainer}
        expect_one_of("trainer.strategy", trainer["strategy"], ("auto", "ddp"))
        for name in ("max_steps", "val_check_interval", "accumulate_grad_batches", "devices"):
            if not _is_count(trainer[name]) and (name, trainer[name]) != ("devices", "auto"):
                raise ConfigError(f"trainer.{name}: expected a whole number, 1 or more, got {trainer[name]!r:.60}")
        expect_one_of("trainer.compile", trainer["compile"], (True, False))
        clip = trainer["gradient_clip_val"]
        if clip is not None and not (is_number(clip) and clip > 0):
            raise ConfigError(f"trainer.gradient_clip_val: expected a positive number or null, got {clip!r:.60}")

    @property
    def steps(self) -> int:
        """The steps of the whole training."""
        return int(self.trainer["max_steps"])

    @property
    def accumulate(self) -> int:
        """The batches of a step."""
        return int(self.trainer["accumulate_grad_batches"])

    @property
    def interval(self) -> int:
        """The steps between two validations; ``val_check_interval`` counts batches."""
        return min(math.ceil(self.trainer["val_check_interval"] / self.accumulate), self.steps)


def explain_value(error: OmegaConfBaseException, key: str) -> str:
    """Return what OmegaConf says of a key: its first sentence, or the keys that there are beside an unknown one."""
    first = str(error).partition("\n")[0]
    if " not in " in first and error.parent_node is not None:
        keys = [str(each) for each in error.parent_node if not str(each).startswith("_")]
        name = key.rpartition(".")[2]
        if name in _OF_LIGHTNING:
            return f"{key}: unknown key; expected {_OF_LIGHTNING[name]}"
        adds = f"; +{key}=... adds one" if "." in key else ""  # at the top there are no others
        meant = did_you_mean(name, keys if "." in key else [*keys, "experiment"])
        return f"{key}: unknown key; expected one of {', '.join(keys)}{adds}{meant}"
    return f"{key}: {first}" if key else first


def given_overrides() -> list[str]:
    """Return the overrides of the command line or of the job of a multirun; none outside of a Hydra command."""
    if not HydraConfig.initialized():
        return []
    return list(OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False))  # type: ignore[arg-type]


def given_keys() -> list[str]:
    """Return the keys that the command line sets, without + or ~; none outside of a Hydra command."""
    return [override.partition("=")[0].lstrip("+~") for override in given_overrides()]


def user_directories() -> tuple[Path, ...]:
    """Return the user's configuration directories, of ``--config-dir``; none outside of a Hydra command."""
    if not HydraConfig.initialized():
        return ()
    sources = HydraConfig.get().runtime.config_sources
    return tuple(Path(each.path) for each in sources if each.schema == "file" and each.provider != "main")


def plain_config(config: DictConfig) -> dict[str, Any]:
    """Return a composed configuration as plain Python, interpolations resolved; missing values are "???".

    ``names`` gets the choices of the groups: those of the Hydra command, else the names of their classes.
    """
    try:
        plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"{error.full_key}: expected a value that it can be resolved to, got: {reason}") from error
    nodes = {group: node for group, node in plain.items() if group in NAMED and isinstance(node, Mapping)}
    named = {group: str(node["_target_"]).rpartition(".")[2] for group, node in nodes.items() if "_target_" in node}
    if HydraConfig.initialized():
        choices = HydraConfig.get().runtime.choices
        for group, _, value in (override.partition("=") for override in given_overrides()):
            if value.startswith("[") and group in (*NAMED, "metrics"):
                all_of_them = f", metrics.protocols={value} computes all of them" if group == "metrics" else ""
                raise ConfigError(f"{group}: expected one choice, got a list; -m runs each of several{all_of_them}")
        named |= {group: name for group, name in choices.items() if group in NAMED}
    given = {group: str(name) for group, name in (plain.get("names") or {}).items() if name is not None}
    return {**plain, "names": named | given}


def compose(name: str, overrides: Sequence[str] = (), directories: Sequence[Path] = ()) -> DictConfig:
    """Compose the configuration of a command, as in ``compose("train", ["model=msg_v", "scale=8"])``.

    Args:
        name: ``train`` or ``eval``.
        overrides: as on the command line.
        directories: of configuration files of your own.

    Example:
        >>> import dsr
        >>> config = dsr.compose("eval", ["method=tgv", "scale=4"])
        >>> config.method.iterations, config.scale
        (1000, 4)

    """
    register()
    project, *others = config_directories(directories)
    places = ",".join(f'"file://{directory.resolve()}"' for directory in others)
    more = [f"hydra.searchpath=[{places}]"] if places else []
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(project), version_base="1.3"):
            config = hydra.compose(name, [*overrides, *more], return_hydra_config=True)
    finally:
        if running is not None:
            GlobalHydra.instance().initialize(running)
    with open_dict(config):
        choices = config.hydra.runtime.choices
        given = {group: name for group, name in config.names.items() if name is not None}
        config.names = {each: choices[each] for each in NAMED if each in choices} | given
        del config["hydra"]
    return config


def register() -> None:
    """Register the schemas with Hydra, and ``${present:NAME,NAME}``: those data sets that are on this machine."""
    ConfigStore.instance().store(name="eval_schema", node=EvalConfig)
    ConfigStore.instance().store(name="train_schema", node=TrainConfig)
    OmegaConf.register_new_resolver("present", _present, replace=True)


def _present(*names: str) -> str:
    """Return the data sets that are on this machine or embedded, separated by commas; print a note on the others."""
    from dsr.data.download import CATALOGUE  # noqa: PLC0415 - only a few experiments ask for it

    folders = {name: CATALOGUE[name].folders if name in CATALOGUE else () for name in names}
    absent = [name for name in names if not all((data_root() / folder).is_dir() for folder in folders[name])]
    if absent:
        note_once(f"left out, as not in {data_root()}: {', '.join(absent)}; `dsr data get NAME` gets one")
    return ",".join(name for name in names if name not in absent)


def runs_here() -> bool:
    """Return whether the launcher of the multirun runs its jobs in this process, and so with its devices."""
    return HydraConfig.get().runtime.choices.get("hydra/launcher") == "basic"
