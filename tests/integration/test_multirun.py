"""A multirun is refused before anything is computed if one of its jobs cannot be run, and says what it will do."""

import os
import re
from pathlib import Path

import pytest
from commands import run_python

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = ("dataset.size=64", "metrics.lpips=false", "device=cpu")
TRAINING = ("trainer=smoke", "dataset.count=6", *SMALL)
RECORDS = "hydra.sweep.dir=records"


@pytest.fixture
def multirun(tmp_path, dsr_cache):
    """Return a runner of a multirun: the exit code, the lines of its output and those of its errors."""
    folders = {"DSR_CACHE": str(dsr_cache), "DSR_DATA": "data"}

    def call(command, *arguments):
        environment = {**os.environ, **folders, "OMP_NUM_THREADS": "1"}
        done = run_python(str(REPOSITORY / f"{command}.py"), "-m", *arguments, cwd=tmp_path, env=environment)
        return done.returncode, done.stdout.splitlines(), done.stderr.splitlines()

    return call


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_data_set_that_is_absent_refuses_the_multirun_before_anything_is_computed(multirun, tmp_path, launcher):
    if launcher == "joblib":
        pytest.importorskip("joblib")
    code, output, errors = multirun(
        "eval", "dataset=simgeo,icl", "method=bicubic", "metrics.lpips=false", f"hydra/launcher={launcher}"
    )
    assert (code, output) == (2, [])
    assert errors == [
        "error: 1 of 2 jobs cannot be run, so none is begun",
        "error: dataset=icl: expected its files in data/icl_nuim, got no such directory; get it with: dsr data get "
        "icl; or say where it is: dataset.root=DIR",
    ]
    assert list(tmp_path.iterdir()) == []


def test_every_job_that_cannot_be_run_is_named(multirun, tmp_path):
    (tmp_path / "out" / "2").mkdir(parents=True)
    (tmp_path / "out" / "2" / "thesis.tex").touch()
    code, output, errors = multirun(
        "eval", *SMALL, "method=bicubic,msg_v", "seed=1,2", "output_dir=out/${seed}", "weights=nowhere"
    )
    assert (code, output) == (2, [])
    foreign = "output_dir: out/2 holds files of something else; another output_dir keeps them"
    unfound = "weights: method=msg_v: expected a file of weights, got nowhere (no such file)"
    assert [line for line in errors if line.startswith("error")] == [
        "error: 3 of 4 jobs cannot be run, so none is begun", f"error: method=bicubic seed=2: {foreign}",
        f"error: method=msg_v seed=1: {unfound}", f"error: method=msg_v seed=2: {unfound}",
    ]  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["2"]


def test_jobs_that_would_share_a_directory_are_refused(multirun, tmp_path):
    code, output, errors = multirun("eval", *SMALL, "method=bicubic,nearest,bilinear", "output_dir=out")
    assert (code, output) == (2, [])
    assert [line.partition(" got ")[0] for line in errors] == [
        "error: 2 of 3 jobs cannot be run, so none is begun",
        "error: method=nearest: output_dir: expected a directory for each job,",
        "error: method=bilinear: output_dir: expected a directory for each job,",
    ]
    assert list(tmp_path.iterdir()) == []


def test_scenes_of_all_jobs_are_counted_and_complete_ones_are_no_work(multirun, tmp_path):
    arguments = (*SMALL, "method=dip,dip_v", "++method.steps=1", "dataset.scenes=[statue,cube_no_texture]", RECORDS)
    code, output, errors = multirun("eval", *arguments)
    assert (code, errors) == (0, [])
    assert output[0] == "2 jobs, 4 scenes"
    first, _ = (tmp_path / "outputs" / "eval").iterdir()
    (first / "predictions" / "statue.npz").unlink()
    code, output, errors = multirun("eval", *arguments)
    assert (code, errors) == (0, [])
    assert output[0] == "2 jobs, 1 scene (3 more are complete)"
    assert sum("predictions re-used" in line for line in output) == 2
    assert multirun("eval", *arguments)[1][0] == "2 jobs, 0 scenes (4 more are complete)"


def test_training_that_cannot_be_run_refuses_the_others(multirun, tmp_path):
    code, output, errors = multirun("train", "trainer=smoke", "dataset=procedural,icl", *SMALL)
    assert (code, output) == (2, [])
    assert errors[0] == "error: 1 of 2 jobs cannot be run, so none is begun"
    assert errors[-1].startswith("error: dataset=icl: expected its files in ")
    assert list(tmp_path.iterdir()) == []


def test_time_of_all_trainings_is_said_once_and_a_complete_one_is_no_work(multirun):
    code, output, errors = multirun("train", *TRAINING, "seed=0", RECORDS)
    assert (code, errors) == (0, [])
    assert re.fullmatch(r"1 job, 2 steps: about \d+ s", output[0])
    code, output, errors = multirun("train", *TRAINING, "seed=0,1", RECORDS)
    assert code == 2
    assert re.fullmatch(r"2 jobs, 2 steps \(2 more are complete\): about \d+ s", output[0])
    assert [line.partition("; ")[0].partition(" outputs")[0] for line in errors][1:] == [
        "error: 1 of 2 jobs failed", "error: seed=0: output_dir:"
    ]  # fmt: skip
    assert sum(line.startswith("weights: ") for line in output) == 1
