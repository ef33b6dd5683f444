"""``python eval.py`` and ``python train.py`` on data sets in their owners' formats."""

import os
import sys
from pathlib import Path

import cv2
import pandas as pd
import pytest
from commands import run_python

from dsr.app.entry import run_command
from dsr.app.evaluate import evaluate
from dsr.app.train import train
from dsr.cli import main

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK = ("metrics.lpips=false", "device=cpu")


@pytest.fixture
def run(tmp_path, dsr_cache):
    """Return a runner of a command in a fresh directory."""

    def call(script, *arguments, **environment):
        kept = {key: value for key, value in os.environ.items() if key not in ("DSR_DATA", "DSR_LPIPS_TRUNK")}
        env = {**kept, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1", **environment}
        return run_python(str(REPOSITORY / script), *arguments, *QUICK, cwd=tmp_path, env=env)

    return call


@pytest.mark.parametrize(
    ("name", "command", "arguments", "message"),
    [
        ("eval", evaluate, ("dataset=icl", "method=bicubic"), "icl: expected its files in data/icl_nuim, "),
        ("train", train, ("dataset=paper_train", "trainer=smoke"), "middlebury_train: expected its files in data, "),
    ],
)
def test_missing_dataset_names_the_command_that_fetches_it_and_nothing_is_written(
    tmp_path, monkeypatch, capfd, name, command, arguments, message
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_DATA", raising=False)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments, *QUICK])
    with pytest.raises(SystemExit) as ended:
        run_command(name, command)
    assert ended.value.code == 2
    which = message.partition(":")[0]
    assert capfd.readouterr().err == (
        f"error: dataset={message}got no such directory; get it with: dsr data get {which}; "
        "or say where it is: dataset.root=DIR\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_real_scenes_of_several_datasets_are_evaluated_by_one_command(run, tmp_path, shared):
    done = run(
        "eval.py", "-m", "dataset=icl,sunrgbd", "dataset.scenes=found", "dataset.size=64", "method=bicubic",
        DSR_DATA=str(shared / "real"),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    scores = pd.concat(pd.read_csv(path) for path in tmp_path.glob("outputs/eval/*/scores.csv"))
    assert scores.groupby("dataset")["scene"].nunique().to_dict() == {"icl": 2, "sunrgbd": 2}
    assert scores["value"].notna().all()
    assert scores[scores["metric"] == "RMSE_d"]["valid_share"].between(0.6, 1).all()
    pictures = sorted(path.stem for path in tmp_path.glob("outputs/eval/*_icl*/pictures/*.png"))
    assert pictures == ["living", "office_0000"]


def test_training_on_real_scenes_with_holes_and_procedural_ones_runs(run, tmp_path, shared):
    done = run(
        "train.py", "dataset=paper_train", "trainer=smoke", "output_dir=out", "patches.scenes=4",
        "dataset.parts.middlebury_train.scenes=found", "dataset.shares.sintel=0",
        "dataset.parts.procedural.count=2", "dataset.parts.procedural.size=64", DSR_DATA=str(shared / "real"),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    split = "data   4 scenes of paper_train to train on, 1 of middlebury_train, 1 of procedural to validate with"
    assert split in done.stdout
    assert (tmp_path / "out" / "weights.safetensors").is_file()


def test_prepare_draws_a_contact_sheet_and_errors_are_one_line(tmp_path, monkeypatch, capsys, shared, dsr_cache):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DSR_DATA", str(shared / "real"))
    assert main(["data", "prepare", "icl", "dataset.scenes=found", "dataset.size=64"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "contact sheet: outputs/data/icl/sheet.png"
    assert cv2.imread("outputs/data/icl/sheet.png").shape[1] > 1000
    monkeypatch.setenv("DSR_DATA", "nowhere")
    wrong = {
        ("icl",): "dataset=icl: expected its files in nowhere/icl_nuim, got no such directory; get it with",
        ("icll",): "dataset=icll: unknown; expected one of arkitscenes, cleargrasp, ",
        ("icl", "dataset.sizes=3"): "dataset.sizes: unknown key; expected one of ",
        ("paper_train",): "dataset=paper_train: expected one data set, it has the parts middlebury_train, sintel, pro",
    }
    for arguments, message in wrong.items():
        assert main(["data", "prepare", *arguments]) == 2
        errors = capsys.readouterr().err.splitlines()
        assert len(errors) == 1
        assert errors[0].startswith(f"error: {message}")
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]
