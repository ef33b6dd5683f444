"""``python eval.py method=dip_v``: what it says, writes, logs, and how it goes on."""

import csv
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Program, run_python
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK = (
    "dataset.size=48", "metrics.lpips=false", "method.steps=40", "method.widths=[8,16]", "method.skips=[2,2]",
    "method.validate_every=20",
)  # fmt: skip


Run = Callable[..., tuple[int, str, str]]


def _command(*arguments: str) -> list[str]:
    return [sys.executable, str(REPOSITORY / "eval.py"), *QUICK, *arguments]


@pytest.fixture
def run(in_process: Run, monkeypatch: pytest.MonkeyPatch, one_thread: None) -> Run:
    """Return a runner of the command in this process, with one thread as in those that results are compared with."""

    def call(folder: Path, *arguments: str, quick: Sequence[str] = QUICK) -> tuple[int, str, str]:
        monkeypatch.chdir(folder)
        code, output, errors = in_process("eval", *quick, *arguments)
        return code, output, "\n".join(errors)

    return call


def _depth(home: Path, scene: str) -> Any:
    with np.load(home / "predictions" / f"{scene}.npz") as arrays:
        return arrays["depth"]


def _rows(home: Path) -> list[dict[str, str]]:
    with (home / "scores.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The run's directory and the finished process of an evaluation of two scenes."""
    folder = tmp_path_factory.mktemp("both")
    _, *command = _command("method=dip_v", "dataset.scenes=[statue,cube_no_texture]", "output_dir=out")
    done = run_python(*command, cwd=folder)
    return folder / "out", done


def test_scores_of_each_validation_are_printed_and_the_run_ends_in_a_table(
    both: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    home, done = both
    assert (done.returncode, done.stderr) == (0, "")
    for scene in ("statue", "cube_no_texture"):
        scores = r"RMSE_d \d+\.\d mm  RMSE_v \d+\.\d  DSSIM_v \d+\.\d"
        assert re.search(rf"^{scene}: step +40  loss \d\.\d+  validation: {scores}$", done.stdout, re.M)
        assert re.search(rf"^evaluate {scene}: \d of 2, ", done.stdout, re.M)
    assert "DIP-V on simgeo, x4, box downsampling" in done.stdout
    assert {row["method"] for row in _rows(home)} == {"dip_v"}


def test_log_has_the_losses_all_scores_and_renderings(
    both: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    home, _ = both
    log = EventAccumulator(str(home / "optimisation" / "statue"))
    log.Reload()
    names = set(log.Tags()["scalars"])
    assert {"train/loss", "train/data_lap1", "train/mse_v", "train/intensity", "val/DSSIM_v", "val/RMSE_v"} <= names
    assert [event.step for event in log.Scalars("val/RMSE_v")] == [20, 40]
    assert [event.step for event in log.Images("renderings")] == [20, 40]
    assert [event.step for event in log.Scalars("train/loss")] == [10, 20, 30, 40]
    logged = log.Scalars("val/RMSE_v")[-1].value
    [scored] = [row for row in _rows(home) if (row["scene"], row["metric"]) == ("statue", "RMSE_v")]
    assert logged == pytest.approx(1000 * float(scored["value"]), rel=1e-4)
    table = (home / "optimisation" / "statue" / "validation.csv").read_text()
    assert "40,val,DSSIM_v," in table


def test_result_does_not_depend_on_the_other_scenes_nor_on_their_order(
    both: tuple[Path, subprocess.CompletedProcess[str]], tmp_path: Path, run: Run
) -> None:
    home, _ = both
    assert run(tmp_path, "method=dip_v", "dataset.scenes=[cube_no_texture]", "output_dir=one")[0] == 0
    assert np.array_equal(_depth(home, "cube_no_texture"), _depth(tmp_path / "one", "cube_no_texture"))
    order = "dataset.scenes=[cube_no_texture,statue]"
    assert run(tmp_path, "method=dip_v", order, "output_dir=turned", "method.validate_every=0")[0] == 0
    for scene in ("statue", "cube_no_texture"):
        assert np.array_equal(_depth(home, scene), _depth(tmp_path / "turned", scene))


def test_second_run_reuses_what_is_there(both: tuple[Path, subprocess.CompletedProcess[str]], run: Run) -> None:
    home, _ = both
    code, output, _ = run(home.parent, "method=dip_v", "dataset.scenes=[statue,cube_no_texture]", "output_dir=out")
    assert code == 0
    assert "predictions re-used: 2" in output
    assert "validation" not in output


def test_interrupted_run_begins_the_image_again(tmp_path: Path, run: Run) -> None:
    arguments = ("method=dip_v", "dataset.scenes=[statue]", "method.steps=60", "method.validate_every=10")
    with Program(*_command(*arguments, "output_dir=out")[1:], cwd=tmp_path) as process:
        table, deadline = tmp_path / "out" / "optimisation" / "statue" / "validation.csv", time.monotonic() + 60
        while not table.is_file() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 143, errors
    assert len(errors.splitlines()) == 1
    assert run(tmp_path, *arguments, "output_dir=out")[0] == 0
    assert run(tmp_path, *arguments, "output_dir=whole")[0] == 0
    assert np.array_equal(_depth(tmp_path / "out", "statue"), _depth(tmp_path / "whole", "statue"))
    tables = [(tmp_path / name / "optimisation" / "statue" / "validation.csv").read_text() for name in ("out", "whole")]
    assert tables[0] == tables[1]
    assert not (tmp_path / "out" / "optimisation" / "statue" / "last.ckpt").exists()


def test_oracle_is_named_in_scores_and_table(tmp_path: Path, run: Run) -> None:
    given = ("method=dip", "dataset.scenes=[statue]", "method.oracle=true", "output_dir=out")
    code, output, errors = run(tmp_path, *given)
    assert code == 0, errors
    assert "DIP (oracle) on simgeo" in output
    assert {row["method"] for row in _rows(tmp_path / "out")} == {"dip_oracle"}
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["method"] == "dip_oracle"


def test_holes_and_a_wrong_model_are_part_of_the_setting_name(tmp_path: Path, run: Run) -> None:
    given = ("method=dip", "dataset.scenes=[statue]", "method.validate_every=0", "output_dir=out")
    code, _, errors = run(tmp_path, *given, "holes=blobs", "holes.size=3", "downsampling.assumed=nearest")
    assert code == 0, errors
    table = _rows(tmp_path / "out")
    assert {row["downsampling"] for row in table} == {"box+assumed-nearest+blobs-0.1-3"}
    assert {row["valid_share"] for row in table} == {"1.0"}  # filled
    assert np.isfinite(_depth(tmp_path / "out", "statue")).all()
    assert run(tmp_path, *given[:-1], "output_dir=right", "holes=blobs", "holes.size=3")[0] == 0
    assert not np.array_equal(_depth(tmp_path / "out", "statue"), _depth(tmp_path / "right", "statue"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("method=dip_v", "method.steps=0"), "method.steps: "),
        (("method=dip", "holes=blobs", "holes.share=2"), "holes.share: "),
        (("method=dip", "downsampling.assumed=cubic"), "downsampling.assumed: "),
        (("method=bicubic", "downsampling.assumed=nearest"), "downsampling.assumed: "),
    ],
)
def test_usage_error_is_one_line_and_writes_nothing(
    tmp_path: Path, run: Run, arguments: tuple[str, ...], message: str
) -> None:
    quick = QUICK if arguments[0].startswith("method=dip") else QUICK[:2]
    code, _, errors = run(tmp_path, *arguments, quick=quick)
    assert code == 2
    [line] = errors.splitlines()
    assert line.startswith(f"error: {message}")
    assert not list(tmp_path.iterdir())
