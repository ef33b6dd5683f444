"""``python eval.py method=dip_v``: what it says, writes, logs, and how it goes on."""

import csv
import json
import re

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

QUICK = (
    "dataset.size=48", "metrics.lpips=false", "method.steps=40", "method.widths=[8,16]", "method.skips=[2,2]",
    "method.validate_every=20",
)  # fmt: skip
SCENES = ("statue", "cube_no_texture")

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def run(in_process):
    """Return a runner of the command in this process."""
    return lambda *arguments: in_process("eval", *QUICK, *arguments)


def depth(home, scene):
    with np.load(home / "predictions" / f"{scene}.npz") as arrays:
        return arrays["depth"]


def rows(home):
    with (home / "scores.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_scores_and_logs_of_each_validation_and_a_result_of_the_scene_alone(tmp_path, run):
    two = ("method=dip_v", f"dataset.scenes=[{','.join(SCENES)}]", "output_dir=out")
    code, output, errors = run(*two)
    assert (code, errors) == (0, [])
    for scene in SCENES:
        scores = r"RMSE_d \d+\.\d mm  RMSE_v \d+\.\d  DSSIM_v \d+\.\d"
        assert re.search(rf"^{scene}: step +40  loss \d\.\d+  validation: {scores}$", output, re.M)
        assert re.search(rf"^evaluate {scene}: \d of 2, ", output, re.M)
    assert "DIP-V on simgeo, x4, box downsampling" in output
    home = tmp_path / "out"
    assert {row["method"] for row in rows(home)} == {"dip_v"}
    log = EventAccumulator(str(home / "optimisation" / "statue")).Reload()
    names = set(log.Tags()["scalars"])
    assert {"train/loss", "train/data_lap1", "train/mse_v", "train/intensity", "val/DSSIM_v", "val/RMSE_v"} <= names
    assert [event.step for event in log.Scalars("val/RMSE_v")] == [20, 40]
    assert [event.step for event in log.Images("renderings")] == [20, 40]
    assert [event.step for event in log.Scalars("train/loss")] == [10, 20, 30, 40]
    [scored] = [row for row in rows(home) if (row["scene"], row["metric"]) == ("statue", "RMSE_v")]
    assert log.Scalars("val/RMSE_v")[-1].value == pytest.approx(1000 * float(scored["value"]), rel=1e-4)
    assert "40,val,DSSIM_v," in (home / "optimisation" / "statue" / "validation.csv").read_text()
    code, output, _ = run(*two)
    assert (code, "predictions re-used: 2" in output, "validation" in output) == (0, True, False)
    other = f"dataset.scenes=[{','.join(reversed(SCENES))}]"
    assert run("method=dip_v", other, "output_dir=turned", "method.validate_every=0")[0] == 0
    for scene in SCENES:
        assert np.array_equal(depth(home, scene), depth(tmp_path / "turned", scene))


def test_oracle_is_named_in_scores_and_table(tmp_path, run):
    code, output, errors = run("method=dip", "dataset.scenes=[statue]", "method.oracle=true", "output_dir=out")
    assert (code, errors) == (0, [])
    assert "DIP (oracle) on simgeo" in output
    assert {row["method"] for row in rows(tmp_path / "out")} == {"dip_oracle"}
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["method"] == "dip_oracle"


def test_holes_and_a_wrong_model_are_part_of_the_setting_name(tmp_path, run):
    given = ("method=dip", "dataset.scenes=[statue]", "method.validate_every=0", "holes=blobs", "holes.size=3")
    assert run(*given, "output_dir=out", "downsampling.assumed=nearest")[::2] == (0, [])
    table = rows(tmp_path / "out")
    assert {row["downsampling"] for row in table} == {"box+assumed-nearest+blobs-0.1-3"}
    assert {row["valid_share"] for row in table} == {"1.0"}  # filled
    assert np.isfinite(depth(tmp_path / "out", "statue")).all()
    assert run(*given, "output_dir=right")[0] == 0
    assert not np.array_equal(depth(tmp_path / "out", "statue"), depth(tmp_path / "right", "statue"))
