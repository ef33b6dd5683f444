"""The outline of a job of a multirun, which :mod:`dsr.app.sweeps` asks for before the first job begins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from dsr.app.schema import Identity


@dataclass(frozen=True)
class Plan:
    """The outline of a job: its directory and identity, and how many units (scenes or steps) are left and done."""

    folder: Path
    identity: Identity
    unit: str
    left: int
    done: int = 0


def runs_here() -> bool:
    """Return whether the launcher of the multirun runs its jobs in this process, and so with its devices."""
    return HydraConfig.get().runtime.choices.get("hydra/launcher") == "basic"
