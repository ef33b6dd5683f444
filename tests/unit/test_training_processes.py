"""The devices and processes of a training."""

import os

import pytest
import torch
from lightning.pytorch.plugins.environments import LightningEnvironment, SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only

from dsr.app.train import find_processes
from dsr.utils.configuration import ConfigError

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _alone(monkeypatch):
    for name in os.environ:
        if name.startswith("SLURM_") or name in ("LOCAL_RANK", "RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID"):
            monkeypatch.delenv(name)


def test_processes_are_lightnings_on_a_machine_and_those_of_a_slurm_step_elsewhere(monkeypatch):
    for devices, count in (("auto", 1), (1, 1), (2, 2)):
        found = find_processes(CPU, devices)
        assert (found.count, found.rank) == (count, 0)
        assert isinstance(found.environment, LightningEnvironment)
    monkeypatch.setenv("SLURM_NTASKS", "4")  # as in a job's script, which no srun has started
    assert isinstance(find_processes(CPU, 1).environment, LightningEnvironment)
    for name in ("STEP_NUM_TASKS", "NTASKS", "PROCID", "LOCALID", "JOB_ID"):
        monkeypatch.setenv(f"SLURM_{name}", "2" if "TASKS" in name else "1")
    found = find_processes(CPU, 2)
    assert (found.count, found.rank, type(found.environment)) == (2, 1, SLURMEnvironment)
    assert not found.environment.auto_requeue
    with pytest.raises(ConfigError, match=r"^trainer\.devices: expected 2, "):
        find_processes(CPU, 1)


def test_more_devices_than_there_are_are_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert find_processes(torch.device("cuda"), "auto").count == 2
    for device, most in (("cuda", 2), ("cuda:1", 1)):
        with pytest.raises(ConfigError, match=rf"^trainer\.devices: expected at most {most} "):
            find_processes(torch.device(device), 3)


def test_environment_is_as_before_when_the_processes_have_ended(monkeypatch):
    monkeypatch.setenv("MASTER_PORT", "5")
    monkeypatch.setattr(rank_zero_only, "rank", 0)
    before = dict(os.environ)
    with find_processes(CPU, 1).running():
        os.environ.update(LOCAL_RANK="0", MASTER_PORT="6")
    assert dict(os.environ) == before
