"""The structured schema of the configuration: what the keys are and which values they take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf

from dsr.degrade import SCALES

PRECISIONS = ("float32", "bfloat16")
_GROUPS = ("dataset", "downsampling", "method", "metrics")


class ConfigError(ValueError):
    """A configuration that cannot be run: one line that names the key, what was expected and what came."""


@dataclass
class MetricsConfig:
    """Which metrics to compute."""

    lpips: bool = True
    lpips_trunk: str | None = None


@dataclass
class EvalConfig:
    """The configuration of ``eval.py``.

    The groups dataset, downsampling and method are made by :func:`dsr.app.build.build`, which checks their keys
    against what the class or function that they name takes.
    """

    dataset: dict[str, Any] = MISSING
    downsampling: dict[str, Any] = MISSING
    method: dict[str, Any] = MISSING
    metrics: MetricsConfig = field(default_factory=MetricsConfig)
    scale: int = 4
    weights: str | None = None
    device: str = "auto"
    precision: str = "float32"
    seed: int = 0
    output_dir: str | None = None
    overwrite: bool = False

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> EvalConfig:
        """Return the checked settings of a composed configuration.

        Raises:
            ConfigError: a key is unknown or missing, or a value is not one of its choices.

        """
        names = [entry.name for entry in fields(cls)]
        for key, value in plain.items():
            if key not in names:
                raise ConfigError(f"{key}: unknown key; expected {', '.join(names)}")
            if value == MISSING or (value is None and key in _GROUPS):
                raise ConfigError(f"{key}: missing; give it as {key}=...")
        settings = cls(**{**plain, "metrics": MetricsConfig(**plain["metrics"])})
        settings.check()
        return settings

    def check(self) -> None:
        """Check the values that a type cannot.

        Raises:
            ConfigError: a value is not one of its choices.

        """
        if self.scale not in SCALES:
            raise ConfigError(f"scale: expected one of {', '.join(map(str, SCALES))}, got {self.scale}")
        if self.precision not in PRECISIONS:
            raise ConfigError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision}")
        if self.seed < 0:
            raise ConfigError(f"seed: expected 0 or a positive number, got {self.seed}")


def plain_config(config: DictConfig) -> dict[str, Any]:
    """Return a composed configuration as plain Python, interpolations resolved; what is missing is "???"."""
    return OmegaConf.to_container(config, resolve=True)  # type: ignore[return-value]


def register() -> None:
    """Tell Hydra of the schemas."""
    ConfigStore.instance().store(name="eval_schema", node=EvalConfig)
