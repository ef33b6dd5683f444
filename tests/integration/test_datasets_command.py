"""``python eval.py`` and ``python train.py`` on data sets in their owners' formats."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK = ("metrics.lpips=false", "device=cpu")


@pytest.fixture
def run(tmp_path, dsr_cache):
    """Return a runner of a command in a fresh directory."""

    def call(script, *arguments, **environment):
        kept = {key: value for key, value in os.environ.items() if key not in ("DSR_DATA", "DSR_LPIPS_TRUNK")}
        return subprocess.run(
            [sys.executable, str(REPOSITORY / script), *arguments, *QUICK],
            cwd=tmp_path, env={**kept, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1", **environment},
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip

    return call


def test_an_absent_data_set_names_the_command_that_gets_it_and_nothing_is_written(run, tmp_path):
    done = run("eval.py", "dataset=icl", "method=bicubic")
    assert (done.returncode, done.stderr) == (
        2,
        "error: dataset=icl: expected its files in data/icl_nuim, got no such directory; "
        "get it with: dsr data get icl; or say where it is: dataset.root=DIR\n",
    )
    done = run("train.py", "dataset=paper_train", "trainer=smoke")
    assert done.returncode == 2
    assert done.stderr.startswith("error: dataset=middlebury_train: expected its files in data, got no such directory")
    assert list(tmp_path.iterdir()) == []


def test_real_scenes_of_several_data_sets_are_evaluated_by_one_command(run, tmp_path, shared):
    done = run(
        "eval.py", "-m", "dataset=icl,sunrgbd", "dataset.scenes=found", "dataset.size=64", "method=bicubic",
        DSR_DATA=str(shared / "real"),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    scores = pd.concat(pd.read_csv(path) for path in tmp_path.glob("outputs/eval/*/scores.csv"))
    assert scores.groupby("dataset")["scene"].nunique().to_dict() == {"icl": 2, "sunrgbd": 2}
    assert scores["value"].notna().all()
    assert scores[scores["metric"] == "RMSE_d"]["valid_share"].between(0.6, 1).all()
    pictures = sorted(path.stem for path in tmp_path.glob("outputs/eval/icl*/pictures/*.png"))
    assert pictures == ["living", "office_0000"]


def test_a_training_on_real_scenes_with_holes_runs(run, tmp_path, shared):
    done = run(
        "train.py", "dataset=middlebury_train", "dataset.scenes=found", "trainer=smoke", "output_dir=out",
        "trainer.scenes=4", DSR_DATA=str(shared / "real"),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert "data   3 scenes of middlebury_train to train on, 1 of middlebury_train to validate with" in done.stdout
    assert (tmp_path / "out" / "weights.safetensors").is_file()
