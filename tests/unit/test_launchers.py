"""The launchers of sweeps: what they need, what they refuse, and how jobs leave that their scheduler stops."""

import importlib.util
import os
import stat
from types import SimpleNamespace

import pytest

from dsr.app import gpus, slurm
from dsr.app.multirun import LAUNCHERS, expect_launcher
from dsr.app.slurm import SlurmSettings
from dsr.utils.configuration import ConfigError

SLURM = {
    "cluster": "slurm", "partition": None, "account": None, "qos": None, "constraint": None, "gpus_per_node": 1,
    "tasks_per_node": 1, "cpus_per_task": 8, "mem_gb": 32, "timeout_min": 240, "signal_delay_s": 120,
    "max_num_timeout": 20, "array_parallelism": 16,
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(LAUNCHERS.keys() - {"basic"}))
def test_launcher_that_is_not_installed_names_the_extra(monkeypatch, name):
    expect_launcher([f"hydra/launcher={name}x", "hydra.launcher.n_jobs=2"])  # Hydra refuses it
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    library = LAUNCHERS[name].rpartition(".")[2]
    with pytest.raises(ConfigError) as refusal:
        expect_launcher(["-m", f"hydra/launcher={name}"])
    message = f"hydra/launcher={name}: expected {library}, which is not installed; pip install -e '.[cluster]' in a"
    assert str(refusal.value) == f"{message} checkout"


@pytest.mark.parametrize(
    ("values", "key", "value"),
    [
        (SLURM, "timeout_min", 0),
        (SLURM, "gpus_per_node", -1),
        (SLURM, "tasks_per_node", 0),
        (SLURM | {"cluster": "local"}, "tasks_per_node", 2),
        (SLURM, "max_num_timeout", -1),
    ],
)
def test_setting_out_of_range_is_refused_by_name(values, key, value):
    SlurmSettings(**values)
    with pytest.raises(ConfigError, match=rf"^hydra\.launcher\.{key}: expected .*, got {value}$"):
        SlurmSettings(**{**values, key: value})


@pytest.fixture
def squeue(monkeypatch, tmp_path):
    """Return a function that sets what ``squeue`` answers."""
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")

    def answers(text, code=0):
        script = tmp_path / "squeue"
        script.write_text(f"#!/bin/sh\ncat <<'END' >&{2 if code else 1}\n{text}\nEND\nexit {code}\n")
        script.chmod(script.stat().st_mode | stat.S_IXUSR)

    return answers


def test_slurm_state_of_a_job_is_that_of_squeue_or_ended_where_slurm_forgot_it(squeue):
    squeue("7 0 RUNNING\n7 1 OUT_OF_MEMORY OutOfMemory\n8 N/A PENDING ReqNodeNotAvail, May be reserved")
    states = {
        "7_0": ("RUNNING", ""), "7_1": ("OUT_OF_MEMORY", "OutOfMemory"), "7_2": ("COMPLETED", ""),
        "8": ("PENDING", "ReqNodeNotAvail, May be reserved"),
    }  # fmt: skip
    assert slurm._slurm_states(["7_0", "7_1", "7_2", "8"]) == states
    squeue("slurm_load_jobs error: Invalid job id specified", 1)
    assert slurm._slurm_states(["7_0"]) == {"7_0": ("COMPLETED", "")}
    squeue("slurm_load_jobs error: Unable to contact slurm controller (connect failure)", 1)
    assert slurm._slurm_states(["7_0"]) == {}


def test_slurm_job_has_ended_only_after_several_answers_in_a_row(squeue, monkeypatch):
    class Handle:
        job_id = "7_0"

    monkeypatch.setattr(slurm, "_ASK", (0.0, 0.0))
    waiting = slurm._Waiting("slurm")

    def states(*answers):
        seen = []
        for answer in answers:
            squeue(f"7 0 {answer} None")
            seen.append(dict(waiting.states([Handle])))
        return seen

    assert states("FAILED", "FAILED", "PENDING", "FAILED", "FAILED") == [{}] * 5
    assert states("FAILED") == [{"7_0": "FAILED"}]


def test_reason_that_jobs_are_pending_is_reported_once(squeue, monkeypatch, caplog):
    monkeypatch.setattr(slurm, "_ASK", (0.0, 0.0))
    caplog.set_level("INFO", "dsr.app.slurm")
    waiting = slurm._Waiting("slurm")
    jobs = [SimpleNamespace(job_id=f"7_{number}") for number in range(3)]
    for reasons in (("None",) * 3, ("Resources", "Resources", "JobArrayTaskLimit"), ("Resources", "PartitionConfig")):
        squeue("\n".join(f"7 {number} PENDING {reason}" for number, reason in enumerate(reasons)))
        assert waiting.states(jobs) == {}
    assert caplog.messages == [
        "Jobs pending in Slurm: 2 (Resources)", "Jobs pending in Slurm: 1 (PartitionConfig)"
    ]  # fmt: skip


def test_visible_gpus_are_those_of_the_environment(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-7a")
    assert (gpus.visible_gpus(), gpus.count_gpus(-1)) == (["2", "GPU-7a"], 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert (gpus.visible_gpus(), gpus.count_gpus(-1)) == ([], -1)


@pytest.mark.parametrize("visible", ["", "3"])
def test_process_with_one_gpu_or_none_takes_none(monkeypatch, tmp_path, visible):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    gpus.take_gpu(tmp_path)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == visible
    assert list(tmp_path.iterdir()) == []


def test_processes_take_the_gpus_in_turn_and_free_them_at_their_end(monkeypatch, tmp_path):
    taken, locks = [], []
    for _ in range(5):  # each as if it were another process
        monkeypatch.setattr(gpus, "_taken", [])
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
        gpus.take_gpu(tmp_path)
        taken.append(os.environ["CUDA_VISIBLE_DEVICES"])
        locks += gpus._taken
        if len(taken) == 4:
            locks[1].release()
    assert taken == ["0", "1", "0", "1", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    gpus.take_gpu(tmp_path)  # the same process keeps its own
    assert len(gpus._taken) == 1
    for lock in locks:
        lock.release()
