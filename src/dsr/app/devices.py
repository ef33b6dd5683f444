"""The devices of a training, and the processes that use them: one per device.

Lightning starts the processes, unless ``srun`` or ``torchrun`` have started this one as one of several.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

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

_OF_PROCESSES = ("LOCAL_RANK", "NODE_RANK", "MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE")  # which Lightning sets


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

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Join the processes within this context; those that Lightning has started end with the first one."""
        before = {name: os.environ.get(name) for name in _OF_PROCESSES}
        rank_zero_only.rank = self.rank  # type: ignore[attr-defined]
        if self.rank and isinstance(self.environment, LightningEnvironment):
            interruption.end_with(os.getppid())
        try:
            yield
        finally:
            if self.count > 1 and torch.distributed.is_initialized():
                torch.distributed.destroy_process_group()
            for name, value in before.items():  # the next job of a multirun starts processes of its own
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def find_processes(device: torch.device, devices: int | Literal["auto"]) -> Processes:
    """Return the processes of a training.

    A step of Slurm with one task is a process as any other: Lightning must neither expect that Slurm starts those of
    further devices, nor answer the signals by which submitit or the user wants a job to be requeued.

    Args:
        device: the kind of device to train on, perhaps one of several.
        devices: how many; ``auto`` for all that there are of the kind, on a CPU one.

    Raises:
        ConfigError: there are fewer devices, or Slurm or ``torchrun`` have started another number of processes.

    """
    index: int | None = device.index  # torch's stubs say int
    there = torch.cuda.device_count() if device.type == "cuda" and index is None else 1
    count = there if devices == "auto" else devices
    if device.type != "cpu" and count > there:
        raise ConfigError(f"trainer.devices: expected at most {there} for device={device}, got {count}")
    environment: ClusterEnvironment = LightningEnvironment()
    tasks = os.environ.get("SLURM_STEP_NUM_TASKS", "")
    started = None
    if TorchElasticEnvironment.detect():
        environment, started = TorchElasticEnvironment(), int(os.environ["WORLD_SIZE"])
    elif tasks.isdecimal() and int(tasks) > 1:  # not in a job's script, which no srun has started
        os.environ.setdefault("SLURM_NTASKS_PER_NODE", tasks)  # Lightning asks for it
        environment, started = SLURMEnvironment(auto_requeue=False), int(tasks)
    if started not in (None, count):
        raise ConfigError(f"trainer.devices: expected {started}, the number of processes of this job, got {count}")
    rank = environment.global_rank() if started else environment.local_rank()
    return Processes(count, rank if count > 1 else 0, environment)
