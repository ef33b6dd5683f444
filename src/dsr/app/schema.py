"""The structured schema of the configuration: what the keys are and which values they take."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Self

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dsr.utils.configuration import ConfigError, build, check_types
from dsr.utils.guards import is_number
from dsr.utils.ratios import NATIVE, check_scale
from dsr.utils.spelling import did_you_mean

Config = Mapping[str, Any]
"""A composed configuration as plain values."""
Identity = Mapping[str, Any]
"""What the results of a run depend on: settings, weights, versions, the kind of device."""
_LONGEST_NAME = 100
_MOST = 1024
"""Workers and threads, more of which no system starts."""
STRATEGIES = ("auto", "ddp")
KEPT = ("best", "last")
VISUAL = ("mse_v", "dssim", "lpips")
PRECISIONS = ("float32", "bfloat16", "auto")
_TRAINER = {"max_steps": 12000, "val_check_interval": 1000, "accumulate_grad_batches": 1, "devices": 1,
            "strategy": "auto", "gradient_clip_val": None}  # fmt: skip
"""What dsr itself reads of the trainer's arguments, and their defaults."""
MOVED = {
    **{f"trainer.{key}": f"trainer.{new}" for key, new in (
        ("steps", "max_steps"), ("validate_every", "val_check_interval"), ("accumulate", "accumulate_grad_batches"),
        ("clip", "gradient_clip_val"), ("max_step", "max_steps"), ("step", "max_steps"),
    )},
    **{f"trainer.{key}": f"patches.{key}" for key in (
        "patch", "batch", "validation_scenes", "scenes", "flip", "rotate", "depth_scale", "colour", "photo", "workers"
    )},
    "trainer.init": "start.weights",
    **{f"trainer.{key}": f"start.{key}" for key in ("shared", "frozen")},
    **{f"trainer.{key}": f"model.{new}" for key, new in (
        ("learning_rate", "optimizer.lr"), ("lr", "optimizer.lr"), ("weight_decay", "optimizer.weight_decay"),
        ("warmup", "scheduler.warmup"), ("average", "average"),
    )},
    "trainer.keep": "keep",
    "trainer.precision": "precision",
    "trainer.accelerator": "device",
    "trainer.logger": "logger",
    "trainer.callbacks": "callbacks",
    "model.depth_loss": "model.objective.depth_loss",
    "model.shading": "model.objective.shading",
    "model.visual": "model.objective.w",
}  # fmt: skip
"""Keys by other names: what Lightning and torch have names for, and arguments of the trainer that have their own."""
SET_BY_DSR = ("plugins", "use_distributed_sampler", "num_nodes", "default_root_dir", "enable_checkpointing",
               "barebones", "inference_mode", "max_epochs", "min_epochs", "max_time")  # fmt: skip
"""Arguments of the trainer that dsr's trainings have values of their own for."""
_GROUPS = (
    "dataset",
    "downsampling",
    "noise",
    "holes",
    "degradation",
    "method",
    "metrics",
    "model",
    "trainer",
    "loss",
    "logger",
    "callbacks",
)


NAMED = ("dataset", "downsampling", "noise", "holes", "degradation", "method", "model", "optimizer", "scheduler",
         "trainer")  # fmt: skip
"""Groups whose choice is in ``names``."""
SEVERAL = ("logger", "callbacks", "experiment")
"""Groups of which several choices go together, as a list."""


@dataclass
class MetricsConfig:
    """Which metrics to compute."""

    protocols: list[str] = field(default_factory=lambda: ["paper"])
    lpips: bool = True
    lpips_trunk: str | None = None
    alignment: str = "none"
    extra: list[str] = field(default_factory=list)


class Checked:
    """A dataclass of settings that is checked when it is made from a configuration."""

    @classmethod
    def of(cls, plain: Config) -> Self:
        """Return the checked settings of a composed configuration.

        Raises:
            ConfigError: a key is unknown or missing, or a value is not one of its choices.

        """
        parts: dict[str, Any] = {entry.name: entry.default_factory for entry in fields(cls)}  # type: ignore[arg-type]
        _refuse_unknown(plain, parts)
        for key, value in plain.items():
            if value == MISSING or (value is None and key in _GROUPS):
                raise ConfigError(f"{key}: missing; give it as {key}=...")
            if is_dataclass(parts[key]):
                _refuse_unknown(value, [entry.name for entry in fields(parts[key])], f"{key}.")
                check_types(parts[key], value, f"{key}.")
        check_types(cls, plain)
        settings = cls(**{k: parts[k](**v) if is_dataclass(parts[k]) else v for k, v in plain.items()})
        settings.check()
        return settings

    def check(self) -> None:
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """


def expect_name(key: str, name: str) -> None:
    """Refuse a name, which becomes that of files and folders, that would lead elsewhere.

    Raises:
        ConfigError: the name is such a one.

    """
    leads = name in ("", ".", "..") or {*"/\\"} & {*name} or not name.isprintable()
    if leads or len(name) > _LONGEST_NAME:
        raise ConfigError(f"{key}: expected a name without folders, got {name[:60]!r}")


def _expect_factor(scale: Any, hint: str = "") -> None:
    """Raise ConfigError, with a hint, for a scale that downsampling models do not have."""
    try:
        check_scale(scale)
    except ValueError as error:
        raise ConfigError(f"{error}{hint}") from error


def _refuse_unknown(plain: Any, names: Collection[str], place: str = "") -> None:
    """Raise ConfigError for the first key that is not in ``names``, and for a value that has no keys."""
    if not isinstance(plain, Mapping):
        raise ConfigError(f"{place.rstrip('.')}: expected the keys {', '.join(names)}, got {plain!r}")
    for key in plain:
        if key not in names:
            meant = did_you_mean(key, names if place else [*names, "experiment"])
            raise ConfigError(f"{place}{key}: unknown key; expected {', '.join(names)}{meant}")


@dataclass
class RunConfig(Checked):
    """The configuration that all commands have.

    The groups (dataset, downsampling, noise, method, model) are nodes for ``hydra.utils.instantiate``, which
    :func:`dsr.utils.configuration.build` makes, too; it checks their keys against what the class or function that they
    name takes. ``names`` has the choices of the groups.
    """

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

    def build(self, group: str) -> Any:
        """Build what a group's node describes.

        Raises:
            ConfigError: a key is unknown, missing or of another type, or a value is refused.

        """
        name = self.names.get(group)
        return build(group, getattr(self, group), {} if name is None else {"name": name}, name)

    def check(self) -> None:
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """
        for group, name in self.names.items():
            expect_name(f"names.{group}", str(name))
        if self.precision not in PRECISIONS:
            raise ConfigError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision}")
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
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """
        super().check()
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value != "auto" and (isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= _MOST):
                raise ConfigError(f"{name}: expected auto or a whole number from 1 to {_MOST}, got {value!r}")
        if not self.measured:
            _expect_factor(self.scale, "; downsampling=measured takes a sensor's map of any ratio")
        if not (is_number(self.scale) and self.scale >= 1) and self.scale != NATIVE:
            raise ConfigError(
                f"scale: expected {NATIVE} or the ratio of the measured maps, 1 or more, got {self.scale!r}"
            )


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
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """
        super().check()
        _expect_factor(self.scale)
        if "net" not in self.model:
            raise ConfigError("model: missing; give it as model=...")
        if self.loss.visual not in VISUAL:
            raise ConfigError(f"loss.visual: expected one of {', '.join(VISUAL)}, got {self.loss.visual!r}")
        w = self.loss.w
        if w != "auto" and (not is_number(w) or w < 0):
            raise ConfigError(f"loss.w: expected auto or a number, 0 or more, got {w!r}")
        if self.keep not in KEPT:
            raise ConfigError(f"keep: expected one of {', '.join(KEPT)}, got {self.keep}")
        for key in (*(f"trainer.{each}" for each in self.trainer), *(f"model.{each}" for each in self.model)):
            if key in MOVED:
                raise ConfigError(f"{key}: unknown key; expected {MOVED[key]}")
        for key in self.trainer:
            if key in SET_BY_DSR:
                raise ConfigError(f"trainer.{key}: unknown key; dsr sets it itself, a training has trainer.max_steps")
        if isinstance(self.trainer.get("profiler"), str):
            raise ConfigError(
                "trainer.profiler: expected a node with _target_, dirpath and filename, which writes a file"
            )
        self._check_trainer()

    def _check_trainer(self) -> None:
        """Check what dsr itself reads of the trainer's arguments, without Lightning, which takes seconds to import."""
        self.trainer = {**_TRAINER, **self.trainer}

        def is_count(value: Any) -> bool:
            return isinstance(value, int) and not isinstance(value, bool) and value > 0

        for name, fits, expected in (
            ("max_steps", is_count, "a whole number, 1 or more"),
            ("val_check_interval", is_count, "a whole number of batches, 1 or more"),
            ("accumulate_grad_batches", is_count, "a whole number, 1 or more"),
            ("devices", lambda value: value == "auto" or is_count(value), "auto or a whole number, 1 or more"),
            ("strategy", lambda value: value in STRATEGIES, f"one of {', '.join(STRATEGIES)}"),
            ("gradient_clip_val", lambda value: value is None or (is_number(value) and 0 < value < math.inf),
             "a positive number or null"),
        ):  # fmt: skip
            value = self.trainer[name]
            if not fits(value):
                raise ConfigError(f"trainer.{name}: expected {expected}, got {value!r:.60}")

    @property
    def more_of_trainer(self) -> dict[str, Any]:
        """The trainer's node without the keys that dsr handles itself; the limit of gradients is only checked here."""
        return {key: value for key, value in self.trainer.items() if key not in _TRAINER or key == "gradient_clip_val"}

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

    Raises:
        ConfigError: an interpolation cannot be resolved.

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
        if lists := named.keys() - choices.keys():
            group = lists.pop()
            raise ConfigError(f"{group}: expected one choice, got a list; -m {group}=A,B runs each of several")
        named |= {group: name for group, name in choices.items() if group in NAMED}
    plain["names"] = named | {
        group: str(name) for group, name in (plain.get("names") or {}).items() if name is not None
    }
    return plain


def raw_group(config: DictConfig, group: str) -> Any:
    """Return a group of a composed configuration, its interpolations as they are."""
    return OmegaConf.to_container(config, resolve=False)[group]  # type: ignore[index,call-overload]


def register() -> None:
    """Register the schemas with Hydra."""
    ConfigStore.instance().store(name="eval_schema", node=EvalConfig)
    ConfigStore.instance().store(name="train_schema", node=TrainConfig)
