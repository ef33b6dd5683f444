"""Sweeps on other launchers than Hydra's own: every job comes back, also one that is killed or has to leave."""

import contextlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dsr.app import slurm
from dsr.app.entry import run_command
from dsr.utils import interruption
from dsr.utils.configuration import ConfigError

REPOSITORY = Path(__file__).resolve().parents[2]
LOCAL = ("hydra/launcher=slurm", "hydra.launcher.cluster=local", "hydra.launcher.gpus_per_node=null")
ONE_NODE = (
    "hydra/launcher=slurm", "hydra.launcher.gpus_per_node=null", "hydra.launcher.cpus_per_task=1",
    "hydra.launcher.mem_gb=1",
)  # fmt: skip


def needs(module):
    return pytest.mark.skipif(importlib.util.find_spec(module) is None, reason="pip install -e '.[cluster]'")


@pytest.fixture
def sweep(monkeypatch, tmp_path, capfd):
    """Return a runner of a sweep over values of the seed: the exit code and the lines of errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY / "src"))
    monkeypatch.setattr(slurm, "_ASK", (0.2, 0.4))

    def run(job, seeds, *arguments):
        monkeypatch.setattr(sys, "argv", ["eval.py"])
        code = 0
        try:
            run_command("eval", job, ["-m", f"seed={','.join(map(str, seeds))}", *arguments])
        except SystemExit as ended:
            code = ended.code
        return code, [line for line in capfd.readouterr().err.splitlines() if line.startswith(("error", "interr"))]

    return run


def eventful(config):
    """Do what the seed says: 0 work, 1 fail, 2 be killed, 3 have to leave at the first time, and be begun again."""
    with Path(f"begun-{config.seed}").open("a") as file:
        file.write("begun\n")
    if config.seed == 1:
        raise ConfigError("seed: not this one")
    if config.seed == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if config.seed == 3 and len(Path("begun-3").read_text().splitlines()) == 1:
        with interruption.deferred() as noted:
            os.kill(os.getpid(), signal.SIGTERM)  # as some clusters do before
            assert not noted.requested
            os.kill(os.getpid(), signal.SIGUSR2)
            assert noted.requested
            Path("saved").touch()
        signal.raise_signal(noted.number)
    if config.seed == 3:
        assert Path("saved").exists()
    return float(config.seed)


eventful.__module__ = "__main__"  # is sent to the jobs' processes as it is


def expect_reported(lines, *, killed):
    assert lines[0] == "error: 2 of 4 jobs failed", lines
    assert lines[1] == "error: seed=1: seed: not this one"
    assert lines[2].startswith(f"error: seed=2: ended without a result ({killed}); what it finished is kept; see ")
    assert len(lines) == 3


@needs("submitit")
def test_jobs_of_submitit_come_back_when_one_is_killed_and_one_requeued(sweep, tmp_path):
    code, lines = sweep(eventful, range(4), *LOCAL)
    assert code == 2
    expect_reported(lines, killed="FINISHED")
    assert (tmp_path / "begun-3").read_text() == "begun\n" * 2


@pytest.fixture
def one_node_slurm(shared, monkeypatch, tmp_path_factory):
    """Start a Slurm of one node."""
    if shutil.which("slurmctld") is None or os.geteuid() != 0:
        pytest.skip("needs Debian's slurmctld, slurmd, slurm-client and munge, and root")
    script, folder = str(shared / "slurm" / "one-node.sh"), str(tmp_path_factory.mktemp("slurm"))
    monkeypatch.delenv("SLURM_CONF", raising=False)
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}  # that nproc obeys
    began = subprocess.run(
        ["bash", script, "start", folder], capture_output=True, text=True, check=False, timeout=60, env=environment
    )
    try:
        assert began.returncode == 0, began.stderr
        monkeypatch.setenv("SLURM_CONF", began.stdout.strip())
        yield
        drain = 'for i in $(seq 150); do [ -n "$(squeue -h -t R,CG)" ] || break; sleep 0.2; done'
        subprocess.run(
            ["bash", "-c", drain], check=True, timeout=60
        )  # else its end is reported to the next test's Slurm
    finally:
        subprocess.run(["bash", script, "stop", folder], check=True, timeout=60)


@needs("submitit")
@pytest.mark.usefixtures("one_node_slurm")
def test_jobs_of_slurm_come_back_when_one_is_killed_and_one_requeued(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(slurm, "_ASK", (1.0, 1.0))
    held = "squeue -h -t PD -o '%A %r' | grep BeginTime | cut -d' ' -f1"  # Slurm waits two minutes with a requeued job
    start = "sleep 2; scontrol update jobid=$j starttime=now"  # at once, its credentials would count as revoked
    helper = f"while sleep 0.3; do for j in $({held}); do {start}; done; done"
    with subprocess.Popen(["bash", "-c", helper], stderr=subprocess.DEVNULL) as process:
        try:
            code, lines = sweep(eventful, range(4), *ONE_NODE)
        finally:
            process.kill()
    assert code == 2
    expect_reported(lines, killed="FAILED")
    assert (tmp_path / "begun-3").read_text() == "begun\n" * 2


def in_a_task(config):
    """Note which process of the job this is; one that is not the first one has no say in its result."""
    Path(f"task-{os.environ['SLURM_PROCID']}").touch()
    if os.environ["SLURM_PROCID"] != "0":
        raise ConfigError("not here")
    return 0.0


in_a_task.__module__ = "__main__"


@needs("submitit")
@pytest.mark.usefixtures("one_node_slurm")
def test_jobs_of_slurm_have_several_processes_for_several_devices(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(slurm, "_ASK", (1.0, 1.0))
    code, lines = sweep(in_a_task, (0,), *ONE_NODE, "hydra.launcher.tasks_per_node=2")
    assert (code, lines) == (0, [])
    wait_until((tmp_path / "task-1").exists, 30)  # the sweep ends with the result of task 0
    assert sorted(path.name for path in tmp_path.glob("task-*")) == ["task-0", "task-1"]


@needs("submitit")
def test_sweep_without_slurm_is_one_line(sweep, monkeypatch, tmp_path):
    monkeypatch.setattr(shutil, "which", lambda *_: None)
    code, lines = sweep(eventful, (0,), *ONE_NODE)
    assert code == 2
    assert lines == ['error: hydra/launcher=slurm: Could not detect "srun", are you indeed on a slurm cluster?']
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["multirun.yaml"]


@needs("submitit")
def test_interrupted_sweep_stops_its_jobs(sweep, tmp_path):
    def lasting(config):
        Path("pid").write_text(str(os.getpid()))
        time.sleep(60)

    lasting.__module__ = "__main__"
    interrupted = interrupt_when(tmp_path / "pid")
    code, lines = sweep(lasting, (0,), *LOCAL)
    interrupted.wait(10)
    assert code == 130
    assert lines == ["interrupted; what is finished is kept, the same command continues from there"]
    wait_until(lambda: not is_alive(int((tmp_path / "pid").read_text())), 10)
    assert not is_alive(int((tmp_path / "pid").read_text()))


def interrupt_when(path):
    """Send this process SIGINT as soon as a file has a content."""
    watch = f"until [ -s {path} ]; do sleep 0.1; done; kill -INT {os.getpid()}"
    return subprocess.Popen(["bash", "-c", watch])


def wait_until(condition, seconds):
    """Wait for a condition, but no longer than some seconds; what follows checks it."""
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.1)


def is_alive(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def on_a_gpu(config):
    """Note which GPUs this process sees, and wait for the others, so that each job has a process of its own."""
    Path(f"gpu-{config.seed}").write_text(os.environ["CUDA_VISIBLE_DEVICES"])
    deadline = time.monotonic() + 30
    while len(list(Path().glob("gpu-*"))) < 4 and time.monotonic() < deadline:
        time.sleep(0.05)


on_a_gpu.__module__ = "__main__"


@needs("joblib")
def test_jobs_of_joblib_have_a_gpu_each_and_share_them_evenly(sweep, monkeypatch, tmp_path):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,GPU-7a")
    code, lines = sweep(on_a_gpu, range(4), "hydra/launcher=gpus", "hydra.launcher.n_jobs=4")
    assert (code, lines) == (0, []), lines
    assert sorted((tmp_path / f"gpu-{seed}").read_text() for seed in range(4)) == ["4", "4", "GPU-7a", "GPU-7a"]
