"""A multirun is refused before anything is computed if one of its jobs cannot be run."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import run_python

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = ("dataset.size=64", "metrics.lpips=false", "device=cpu")


@pytest.fixture
def multirun(tmp_path, monkeypatch):
    """Return a runner of a multirun: the exit code, the lines of its output and those of its errors."""
    monkeypatch.setenv("DSR_DATA", "data")

    def call(command, *arguments):
        done = run_python(str(REPOSITORY / f"{command}.py"), "-m", *arguments, cwd=tmp_path)
        return done.returncode, done.stdout.splitlines(), done.stderr.splitlines()

    return call


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("eval", ("dataset=simgeo,icl", "method=bicubic", "hydra/launcher=joblib")),
        ("train", ("dataset=procedural,icl", "trainer=smoke", "metrics.lpips=false")),
    ],
)
def test_absent_data_set_refuses_the_multirun_before_anything_is_computed(multirun, tmp_path, command, arguments):
    code, output, errors = multirun(command, *arguments)
    assert (code, output) == (2, [])
    assert errors[0] == "error: 1 of the jobs cannot be run, so none is begun"
    assert ": dataset=icl: expected its files in data/icl_nuim" in errors[1]
    assert list(tmp_path.iterdir()) == []


def test_every_job_that_cannot_be_run_is_named(multirun, tmp_path):
    (tmp_path / "out" / "2").mkdir(parents=True)
    (tmp_path / "out" / "2" / "thesis.tex").touch()
    code, output, errors = multirun(
        "eval", *SMALL, "method=bicubic,msg_v", "seed=1,2", "output_dir=out/${seed}", "weights=nowhere"
    )
    assert (code, output) == (2, [])
    named = [line for line in errors if line.startswith("error: dataset.size=64")]
    assert ["method=bicubic seed=2" in named[0], "output_dir: out/2" in named[0]] == [True, True]
    assert all("weights: method=msg_v: expected a file of weights, got nowhere" in line for line in named[1:])
    assert len(named) == 3
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["2"]
    _, _, errors = multirun("eval", *SMALL, "method=bicubic,nearest,bilinear", "output_dir=same")
    assert sum("output_dir: expected a directory for each job" in line for line in errors) == 2


@pytest.mark.parametrize("launcher", ["basic", pytest.param("joblib", marks=pytest.mark.nightly)])
def test_jobs_are_run_and_complete_scenes_are_reused(multirun, tmp_path, launcher):
    arguments = (*SMALL, "method=bicubic,nearest", "dataset.scenes=[statue]", f"hydra/launcher={launcher}")
    code, _, errors = multirun("eval", *arguments)
    assert (code, errors) == (0, [])
    assert sorted(path.name for path in (tmp_path / "outputs" / "eval").iterdir()) == [
        "bicubic_x4_simgeo_scenes-statue_size64_seed0", "nearest_x4_simgeo_scenes-statue_size64_seed0"
    ]  # fmt: skip
    assert "predictions re-used: 1 (overwrite=true computes them again)" in multirun("eval", *arguments)[1]


def test_experiment_leaves_out_the_data_sets_that_are_not_there(multirun, tmp_path):
    given = ("+experiment=paper_tables", "method=bicubic", "dataset.scenes=[statue]", *SMALL)
    code, _, [note] = multirun("eval", *given)
    assert (code, note[:28], "icl" in note) == (0, "note: left out, as not in da", True)
    assert sorted(path.name for path in (tmp_path / "outputs" / "eval").iterdir()) == [
        f"bicubic_x{scale}_simgeo_scenes-statue_size64_seed0" for scale in (4, 8)
    ]


SWEEP = """
import os, sys, time
from pathlib import Path
from dsr.app.entry import run_command

def job(config):
    Path("job").write_text(str(os.getpid()))
    time.sleep(60)

if __name__ == "__main__":
    run_command("eval", job, sys.argv[1:])
"""


@pytest.mark.nightly
def test_interrupted_sweep_stops_its_jobs_in_other_processes(tmp_path):
    (tmp_path / "sweep.py").write_text(SWEEP)
    command = [sys.executable, "sweep.py", "-m", "method=bicubic", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY / "src")}
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=tmp_path, env=environment) as process:
        pid, deadline = tmp_path / "job", time.monotonic() + 60
        while not (pid.is_file() and pid.read_text()) and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    job, deadline = Path("/proc", pid.read_text()), time.monotonic() + 5
    while job.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
