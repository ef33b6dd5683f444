"""The structured schema of the configuration: what the keys are and which values they take."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Self

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf

from dsr.training.settings import PatchSettings, Schedule
from dsr.utils.configuration import ConfigError, check_types
from dsr.utils.guards import is_number
from dsr.utils.ratios import NATIVE, check_scale

STRATEGIES = ("auto", "ddp")
KEPT = ("best", "last")
PRECISIONS = ("float32", "bfloat16", "auto")
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
)


SEVERAL = ("logger", "experiment")
"""Groups of which several choices go together, as a list."""


@dataclass
class MetricsConfig:
    """Which metrics to compute."""

    protocols: list[str] = field(default_factory=lambda: ["paper"])
    lpips: bool = True
    lpips_trunk: str | None = None
    extra: list[str] = field(default_factory=list)


class Checked:
    """A dataclass of settings that is checked when it is made from a configuration."""

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> Self:
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
            raise ConfigError(f"{place}{key}: unknown key; expected {', '.join(names)}")


@dataclass
class RunConfig(Checked):
    """The configuration that all commands have.

    The groups (dataset, downsampling, noise, method, model) are made by :func:`dsr.utils.configuration.build`, which
    checks their keys against what the class or function that they name takes.
    """

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

    def check(self) -> None:
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """
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
    weights: str | None = None
    run: str | None = None
    trust: Any = None
    workers: Any = "auto"
    threads: Any = "auto"

    @property
    def measured(self) -> bool:
        """Whether the low-resolution maps are the scenes' own."""
        return str(self.downsampling.get("target")).endswith(".Measured")

    def check(self) -> None:
        """Check values beyond their types.

        Raises:
            ConfigError: a value is not one of its choices.

        """
        super().check()
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value != "auto" and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ConfigError(f"{name}: expected auto or a whole number, 1 or more, got {value!r}")
        if not self.measured:
            _expect_factor(self.scale, "; downsampling=measured takes a sensor's map of any ratio")
        if not (is_number(self.scale) and self.scale >= 1) and self.scale != NATIVE:
            raise ConfigError(
                f"scale: expected {NATIVE} or the ratio of the measured maps, 1 or more, got {self.scale!r}"
            )


@dataclass
class TrainerConfig:
    """The training's steps, data and optimiser; see ``conf/trainer/default.yaml``."""

    name: str = "default"
    steps: int = 12000
    validate_every: int = 1000
    learning_rate: float = Schedule.learning_rate
    warmup: int = Schedule.warmup
    weight_decay: float = Schedule.weight_decay
    clip: float = Schedule.clip
    average: float = 0.999
    patch: int = PatchSettings.patch
    batch: int = PatchSettings.batch
    accumulate: int = 1
    validation_scenes: int = PatchSettings.validation_scenes
    scenes: int | None = PatchSettings.scenes
    flip: bool = PatchSettings.flip
    rotate: bool = PatchSettings.rotate
    depth_scale: float = PatchSettings.depth_scale
    colour: float = PatchSettings.colour
    photo: float = PatchSettings.photo
    workers: int = PatchSettings.workers
    devices: Any = 1
    strategy: str = "auto"
    init: str | None = None
    shared: str | None = None
    frozen: list[str] = field(default_factory=list)
    keep: str = "best"


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
        default_factory=lambda: {"name": "plain", "target": "dsr.degradation.random_degradation.plain"}
    )
    trainer: TrainerConfig = field(default_factory=TrainerConfig)
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
        w = self.loss.w
        if w != "auto" and (not is_number(w) or w < 0):
            raise ConfigError(f"loss.w: expected auto or a number, 0 or more, got {w!r}")
        for name in ("validate_every", "accumulate"):
            if not getattr(self.trainer, name) > 0:
                raise ConfigError(f"trainer.{name}: expected a positive number, got {getattr(self.trainer, name)}")
        devices = self.trainer.devices
        if devices != "auto" and (isinstance(devices, bool) or not isinstance(devices, int) or devices < 1):
            raise ConfigError(f"trainer.devices: expected auto or a positive number, got {devices!r}")
        for name, choices in (("strategy", STRATEGIES), ("keep", KEPT)):
            if (value := getattr(self.trainer, name)) not in choices:
                raise ConfigError(f"trainer.{name}: expected one of {', '.join(choices)}, got {value}")


def given_keys() -> list[str]:
    """Return the keys that the command line sets, without + or ~; none outside of a Hydra command."""
    if not HydraConfig.initialized():
        return []
    return [override.partition("=")[0].lstrip("+~") for override in HydraConfig.get().overrides.task]


def user_directories() -> tuple[Path, ...]:
    """Return the user's configuration directories, of ``--config-dir``; none outside of a Hydra command."""
    if not HydraConfig.initialized():
        return ()
    sources = HydraConfig.get().runtime.config_sources
    return tuple(Path(each.path) for each in sources if each.schema == "file" and each.provider != "main")


def plain_config(config: DictConfig) -> dict[str, Any]:
    """Return a composed configuration as plain Python, interpolations resolved; missing values are "???"."""
    return OmegaConf.to_container(config, resolve=True)  # type: ignore[return-value]


def raw_group(config: DictConfig, group: str) -> Any:
    """Return a group of a composed configuration, its interpolations as they are."""
    return OmegaConf.to_container(config, resolve=False)[group]  # type: ignore[index,call-overload]


def register() -> None:
    """Register the schemas with Hydra."""
    ConfigStore.instance().store(name="eval_schema", node=EvalConfig)
    ConfigStore.instance().store(name="train_schema", node=TrainConfig)
