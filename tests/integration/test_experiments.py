"""An experiment runs as its file says, in small: every job of its sweep, and the report of them."""

import csv
import sys

import pytest

from dsr.app.entry import run_eval
from dsr.cli import main


@pytest.fixture
def _folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DSR_DATA", str(tmp_path / "data"))
    monkeypatch.setattr(sys, "argv", ["eval.py"])


@pytest.mark.usefixtures("_folder")
def test_paper_tables_in_small_are_evaluated_and_reported(tmp_path, capfd):
    small = ["dataset.size=64", "dataset.scenes=[statue]", "metrics.lpips=false"]
    run_eval(["-m", "+experiment=paper_tables", "method=bicubic,nearest", *small])
    runs = sorted((tmp_path / "outputs" / "eval").iterdir())
    assert [run.name for run in runs] == [
        f"{method}_x{scale}_simgeo_scenes-statue_size64_seed0" for method in ("bicubic", "nearest") for scale in (4, 8)
    ]
    [note] = capfd.readouterr().err.splitlines()
    assert note.startswith("note: left out, as not in")
    assert "icl" in note
    assert main(["report", "outputs/eval", "-o", "report", "--only", "tables"]) == 0
    with (tmp_path / "report" / "tables" / "simgeo_x4_box.csv").open(newline="", encoding="utf-8") as file:
        assert {"Bicubic", "Nearest"} <= {row["method"] for row in csv.DictReader(file)}
