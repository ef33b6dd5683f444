"""The devices of a training, and the processes that use them: one per device.

Lightning starts the processes, unless ``srun`` or ``torchrun`` have started this one as one of several.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from lightning.pytorch.plugins.environments import (
    ClusterEnvironment,
    LightningEnvironment,
    SLURMEnvironment,
    TorchElasticEnvironment,
)
from lightning.pytorch.utilities import rank_zero_only

from dsr.utils import interruption
from dsr.utils.configuration import ConfigError

_OF_PROCESSES = ("LOCAL_RANK", "NODE_RANK", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")
"""Environment variables that Lightning sets where it starts processes."""
_STARTED_BY = "DSR_TRAINING_PROCESS"
"""Environment variable of the processes that Lightning starts: the number of the process that they end with."""
_PROGRAMS = ("dsr", "dsr.__main__")


@dataclass(frozen=True)
class Processes:
    """The processes of a training, as this one sees them.

    Args:
        count: of processes, and so of devices.
        rank: number of this one; 0 writes files and prints.
        environment: what Lightning learns of the processes from.

    """

    count: int
    rank: int
    environment: ClusterEnvironment

    @property
    def first(self) -> bool:
        """Whether this is the process that writes files and prints."""
        return self.rank == 0

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Join the processes within this context; those that Lightning has started end with the first one."""
        before = {name: os.environ.get(name) for name in (*_OF_PROCESSES, _STARTED_BY)}
        rank_zero_only.rank = self.rank  # type: ignore[attr-defined]
        if self.first:
            os.environ[_STARTED_BY] = str(os.getpid())
        else:
            interruption.silence()
            if isinstance(self.environment, LightningEnvironment) and _STARTED_BY in os.environ:
                interruption.end_with(int(os.environ[_STARTED_BY]))
        try:
            yield
        finally:
            if self.count > 1 and torch.distributed.is_initialized():
                torch.distributed.destroy_process_group()
            for name, value in before.items():  # the next job of a multirun starts processes of its own
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def find_processes(device: torch.device, devices: int | Literal["auto"], strategy: str) -> Processes:
    """Return the processes of a training.

    Args:
        device: the kind of device to train on, perhaps one of several.
        devices: how many; ``auto`` for all that there are of the kind, on a CPU one.
        strategy: ``ddp`` for several, ``auto`` for any number.

    Raises:
        ConfigError: there are fewer devices, the strategy does not fit their number, or Slurm or ``torchrun`` have
            started another number of processes.

    """
    count = _count(device, devices)
    if strategy == "ddp" and count == 1:
        raise ConfigError("trainer.strategy: expected auto for 1 device, got ddp; trainer.devices=2 trains on two")
    started, environment = _environment()
    if started not in (None, count):
        raise ConfigError(
            f"trainer.devices: expected {started}, the number of processes that {_starter(environment)}, got {count}"
        )
    if count > 1 and started is None and not _can_start_processes():
        raise ConfigError(
            f"trainer.devices: expected 1 in a process of a launcher, got {count}; Slurm starts {count} processes with "
            f"hydra.launcher.tasks_per_node={count}"
        )
    rank = environment.local_rank() if isinstance(environment, LightningEnvironment) else environment.global_rank()
    return Processes(count, rank if count > 1 else 0, environment)


def _count(device: torch.device, devices: int | Literal["auto"]) -> int:
    """Return the number of devices to train on."""
    if device.type == "cpu":
        return 1 if devices == "auto" else devices
    index: int | None = device.index  # torch's stubs say int
    there = torch.cuda.device_count() if device.type == "cuda" and index is None else 1
    count = there if devices == "auto" else devices
    if count > there:
        what = f"of {device.type} here" if index is None else f"for device={device}"
        raise ConfigError(f"trainer.devices: expected at most {there}, the number {what}, got {count}")
    return count


def _environment() -> tuple[int | None, ClusterEnvironment]:
    """Return how many processes Slurm or torchrun have started, None for none, and where Lightning finds them.

    A step of Slurm with one task is a process as any other: Lightning must neither expect that Slurm starts those of
    further devices, nor answer the signals by which submitit or the user wants a job to be requeued.
    """
    if TorchElasticEnvironment.detect():
        return int(os.environ["WORLD_SIZE"]), TorchElasticEnvironment()
    tasks = os.environ.get("SLURM_STEP_NUM_TASKS", "")
    if not tasks.isdecimal() or int(tasks) < 2:  # also in a job's script, which no srun has started
        return None, LightningEnvironment()
    if os.environ.get("SLURM_STEP_NUM_NODES", "1") != "1":
        raise ConfigError("trainer.devices: expected the tasks of this Slurm step on 1 node, they are on several")
    os.environ.setdefault("SLURM_NTASKS_PER_NODE", tasks)  # Lightning asks for it
    return int(tasks), SLURMEnvironment(auto_requeue=False)


def _starter(environment: ClusterEnvironment) -> str:
    return "srun started" if isinstance(environment, SLURMEnvironment) else "torchrun started"


def _can_start_processes() -> bool:
    """Return whether this process was started by the command's program, which Lightning starts again."""
    main: Any = sys.modules["__main__"]
    return main.__spec__ is None or main.__spec__.name in _PROGRAMS
