"""The devices and processes of a training."""

import os

import pytest
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment, SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only

from dsr.app.devices import find_processes
from dsr.utils.configuration import ConfigError

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _alone(monkeypatch):
    for name in os.environ:
        if name.startswith("SLURM_") or name in ("LOCAL_RANK", "RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID"):
            monkeypatch.delenv(name)


def step_of_slurm(monkeypatch, tasks, rank, nodes=1):
    values = {"STEP_NUM_TASKS": tasks, "NTASKS": tasks, "PROCID": rank, "LOCALID": rank, "NODEID": 0, "JOB_ID": 7,
              "STEP_NUM_NODES": nodes, "JOB_NAME": "train"}  # fmt: skip
    for name, value in values.items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))
    monkeypatch.setenv("SLURM_NTASKS_PER_NODE", str(tasks))


def test_one_device_and_several_of_a_cpu_are_processes_that_lightning_starts(monkeypatch):
    monkeypatch.setattr("dsr.app.devices._can_start_processes", lambda: True)
    for devices, count in (("auto", 1), (1, 1), (2, 2)):
        found = find_processes(CPU, devices, "auto")
        assert (found.count, found.rank, found.first) == (count, 0, True)
        assert isinstance(found.environment, LightningEnvironment)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert not find_processes(CPU, 2, "ddp").first


@pytest.mark.parametrize("devices", [1, "auto"])
def test_ddp_for_one_device_is_refused(devices):
    with pytest.raises(ConfigError, match=r"^trainer\.strategy: expected auto for 1 device, got ddp"):
        find_processes(CPU, devices, "ddp")


def test_more_devices_than_there_are_are_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    cuda = torch.device("cuda")
    assert find_processes(cuda, 1, "auto").count == 1
    with pytest.raises(ConfigError, match=r"^trainer\.devices: expected at most 2, the number of cuda here, got 3$"):
        find_processes(cuda, 3, "ddp")
    with pytest.raises(ConfigError, match=r"expected at most 1, the number for device=cuda:1, got 2$"):
        find_processes(torch.device("cuda:1"), 2, "auto")


def test_tasks_of_a_slurm_step_are_the_processes_and_slurm_requeues_nothing(monkeypatch):
    step_of_slurm(monkeypatch, tasks=2, rank=1)
    found = find_processes(CPU, 2, "ddp")
    assert (found.count, found.rank) == (2, 1)
    assert isinstance(found.environment, SLURMEnvironment)
    assert not found.environment.auto_requeue
    with pytest.raises(ConfigError, match=r"^trainer\.devices: expected 2, the number of processes that srun "):
        find_processes(CPU, 1, "auto")
    step_of_slurm(monkeypatch, tasks=2, rank=1, nodes=2)
    with pytest.raises(ConfigError, match="on 1 node"):
        find_processes(CPU, 2, "ddp")


def test_job_of_slurm_with_one_task_is_a_process_as_any_other(monkeypatch):
    step_of_slurm(monkeypatch, tasks=1, rank=0)
    assert isinstance(find_processes(CPU, 1, "auto").environment, LightningEnvironment)
    monkeypatch.delenv("SLURM_STEP_NUM_TASKS")  # as in the job's script
    monkeypatch.setenv("SLURM_NTASKS", "4")
    assert isinstance(find_processes(CPU, 1, "auto").environment, LightningEnvironment)


def test_process_of_a_launcher_does_not_start_the_processes_of_devices(monkeypatch):
    monkeypatch.setattr("dsr.app.devices._can_start_processes", lambda: False)
    with pytest.raises(ConfigError, match=r"^trainer\.devices: expected 1 in a process of a launcher, got 2; "):
        find_processes(CPU, 2, "auto")


def test_environment_is_as_before_when_the_processes_have_ended(monkeypatch):
    monkeypatch.setenv("MASTER_PORT", "5")
    monkeypatch.setattr(rank_zero_only, "rank", 0)
    before = dict(os.environ)
    with find_processes(CPU, 1, "auto").running():
        os.environ.update(LOCAL_RANK="0", MASTER_PORT="6")
    assert dict(os.environ) == before
