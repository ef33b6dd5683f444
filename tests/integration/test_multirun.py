"""A multirun is refused before anything is computed if one of its jobs cannot be run."""

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
    assert ": dataset=icl: " in errors[1]
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
    assert all("weights: method=msg_v: " in line for line in named[1:])
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
