"""TensorBoard's table of runs over trainings, evaluations and DIP runs in one folder, as TensorBoard itself answers."""

import csv
import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
from commands import run_python

REPOSITORY = Path(__file__).resolve().parents[2]
TRAINING = (
    "trainer=smoke", "dataset.count=6", "dataset.size=64", "metrics.lpips=false", "device=cpu", "loss.w=0.72",
)  # fmt: skip
EVALUATION = ("dataset.scenes=[statue]", "dataset.size=48", "metrics.lpips=false", "device=cpu")
COMMANDS = (
    ("train.py", *TRAINING, "output_dir=one"),
    ("train.py", *TRAINING, "output_dir=two", "scale=2", "seed=1", "noise=gaussian_multiplicative"),
    ("eval.py", *EVALUATION, "output_dir=bicubic", "method=bicubic", "noise=gaussian_multiplicative"),
    ("eval.py", *EVALUATION, "output_dir=msg_v"),
    ("eval.py", *EVALUATION, "output_dir=dip", "method=dip_v", "method.steps=4", "method.validate_every=2",
     "method.widths=[8,16]", "method.skips=[2,2]"),
)  # fmt: skip
COLUMNS = ["dataset", "degradation", "method", "scale", "w", "kind", "seed", "steps"]
NOISY = "box+gaussian_multiplicative-0.003"
ROWS = {
    "one/tensorboard": ["procedural", "box", "msg_v", 4, "0.72", "training", 0, "2"],
    "two/tensorboard": ["procedural", NOISY, "msg_v", 2, "0.72", "training", 1, "2"],
    "bicubic": ["simgeo", NOISY, "Bicubic", 4, "-", "evaluation", 0, "-"],
    "msg_v": ["simgeo", "box", "MSG-V", 4, "-", "evaluation", 0, "-"],
    "dip": ["simgeo", "box", "DIP-V", 4, "auto", "evaluation", 0, "4"],
    "dip/optimisation/statue": ["simgeo", "box", "DIP-V", 4, "1", "optimisation", 0, "4"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory, dsr_cache):
    """Return the folder with the directories of all runs."""
    folder = tmp_path_factory.mktemp("runs")
    environment = {**os.environ, "DSR_CACHE": str(dsr_cache), "OMP_NUM_THREADS": "1"}
    for name, *arguments in COMMANDS:
        done = run_python(str(REPOSITORY / name), *arguments, cwd=folder, env=environment)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def ask(runs):
    """Return a function that asks TensorBoard's table of runs, once it has read all of them."""
    command = (sys.executable, "-m", "tensorboard.main", "--logdir", str(runs), "--port", "0")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        try:
            url = next(found[0] for line in server.stderr if (found := re.search(r"http://\S+:\d+/", line)))

            def post(name, content):
                request = urllib.request.Request(f"{url}data/plugin/hparams/{name}", json.dumps(content).encode(),
                                                 {"Content-Type": "application/json"})  # fmt: skip
                with urllib.request.urlopen(request, timeout=60) as answer:
                    return json.load(answer)

            deadline = time.monotonic() + 60
            while len(groups_of(post)) < len(ROWS) and time.monotonic() < deadline:
                time.sleep(0.2)
            yield post
        finally:
            server.terminate()


def groups_of(ask):
    """Return what TensorBoard knows of each run."""
    infos = ask("experiment", {"experimentName": ""}).get("metricInfos", [])
    asked = {"startIndex": 0, "sliceSize": 100, "allowedStatuses": ["STATUS_SUCCESS", "STATUS_UNKNOWN"],
             "colParams": [{"metric": info["name"]} for info in infos]}  # fmt: skip
    return {group["name"]: group for group in ask("session_groups", asked).get("sessionGroups", [])}


def test_trainings_evaluations_and_dip_runs_share_their_columns(ask):
    experiment = ask("experiment", {"experimentName": ""})
    assert [info["name"] for info in experiment["hparamInfos"]] == COLUMNS
    assert [info["name"]["tag"] for info in experiment["metricInfos"]] == [
        f"score/{name}" for name in ("RMSE_v", "RMSE_v1", "DSSIM_v", "LPIPS_v", "RMSE_d", "BadPix_v_5", "Bumpiness_d")
    ]
    found = {name: [group["hparams"][column] for column in COLUMNS] for name, group in groups_of(ask).items()}
    assert found == ROWS


def test_scores_are_those_of_the_result_in_the_units_of_tables(ask, runs):
    factors = {"RMSE_v": 1000, "RMSE_v1": 1000, "DSSIM_v": 1000, "RMSE_d": 1000, "BadPix_v_5": 100, "Bumpiness_d": 1}
    for name, group in groups_of(ask).items():
        raw = scores_of(runs / name)
        shown = {value["name"]["tag"]: value["value"] for value in group["metricValues"]}
        assert shown == pytest.approx({f"score/{metric}": factor * raw[metric] for metric, factor in factors.items()},
                                      rel=1e-4), name  # fmt: skip


def scores_of(folder):
    """Return a run's scores: of its only scene, or of the best validation of a training, or the last of an image."""
    if (folder / "scores.csv").is_file():
        with (folder / "scores.csv").open(newline="") as file:
            return {row["metric"]: float(row["value"]) for row in csv.DictReader(file) if row["variant"] in ("", "max")}
    path = folder / "validation.csv" if (folder / "validation.csv").is_file() else folder.parent / "validation.csv"
    by_step = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            by_step.setdefault(int(row["step"]), {})[row["metric"]] = float(row["value"])
    if path.parent == folder:
        return by_step[max(by_step)]
    return min(by_step.values(), key=lambda scores: scores["RMSE_v"])
