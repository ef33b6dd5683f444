"""``dsr report``: what it writes, what it replaces, and what it refuses."""

import json
import re

import numpy as np
import pandas as pd
import pytest
from commands import run_python
from upsampling import refused_line

from dsr.app import report
from dsr.cli import main

SCENES = ("cube_high_freq", "statue")


@pytest.fixture
def runs(make_run, tmp_path):
    """Two methods on two scenes."""
    for label in ("Bicubic", "MSG-V"):
        make_run(tmp_path / "runs" / label, label=label, method=label.lower(), scenes=SCENES)
    return tmp_path / "runs"


def refused(capsys, *arguments):
    """Return the one line of a command that is refused."""
    return refused_line(capsys, main([*map(str, arguments)]))


def test_report_of_workers_has_tables_figures_the_metric_study_and_a_page(runs, tmp_path):
    for file in runs.rglob("scenes/statue.npz"):
        file.write_bytes(b"damaged")
    files, notes = [], []
    for workers in ("1", "2"):
        command = ("-m", "dsr", "report", str(runs), "-o", workers, "--workers", workers, "--title", "Ours")
        done = run_python(*command, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        assert f"{workers}/index.html" in done.stdout
        folder = tmp_path / workers
        files.append({path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()})
        notes.append([line for line in done.stdout.splitlines() if line.startswith("note:")])
    assert files[0].keys() == files[1].keys()
    assert [name for name, path in files[0].items() if path.read_bytes() != files[1][name].read_bytes()] == []
    assert notes[0] == notes[1]
    assert any("simgeo/statue x4 box: no pictures" in note for note in notes[0])
    for name in ("tables/all.tex", "figures/errors_simgeo_x4_box_1.png", "metrics/scatter_matrix.pdf"):
        assert files[0][name].stat().st_size > 100, name
    page = files[0]["index.html"].read_text(encoding="utf-8")
    assert all(text in page for text in ("<title>Ours</title>", "tables/simgeo_x4_box.csv", "figures/lights.pdf"))
    assert "Bicubic" in files[0]["tables/all.md"].read_text(encoding="utf-8")


def test_interrupted_report_leaves_the_earlier_one_as_it_was(runs, tmp_path, monkeypatch):
    output = tmp_path / "report"
    assert main(["report", str(runs), "-o", str(output), "--only", "tables"]) == 0
    before = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "write_correlations", interrupt)
    assert main(["report", str(runs), "-o", str(output), "--only", "tables,metrics"]) == 130
    assert {path: path.read_bytes() for path in output.rglob("*") if path.is_file()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report", "runs"]


def test_directory_with_foreign_files_is_refused_and_kept(runs, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    assert "it holds something else" in refused(capsys, "report", runs, "-o", tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "years of work"


def test_report_without_truth_has_pictures_and_no_tables(runs, tmp_path, capsys):
    for folder in runs.iterdir():
        header = (folder / "scores.csv").read_text().splitlines()[0]
        (folder / "scores.csv").write_text(header + "\n")
        for file in (folder / "scenes").iterdir():
            with np.load(file) as arrays:
                rest = {name: values for name, values in arrays.items() if name != "depth"}
            np.savez_compressed(file, **rest)
    assert main(["report", str(runs), "-o", str(tmp_path / "report"), "--only", "tables,metrics,page"]) == 0
    assert "no scene has a ground truth to score against" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == ["index.html", "report.json"]
    assert "Bicubic" in (tmp_path / "report" / "index.html").read_text(encoding="utf-8")


def test_invalid_choice_is_one_line_and_nothing_is_written(runs, tmp_path, capsys):
    choices = {"methods: ": ["--methods", "DIP"], "scales: ": ["--scale", "8"], "--only: ": ["--only", "tables,graphs"],
               "absent.csv: ": ["--study", "absent.csv"]}  # fmt: skip
    for start, arguments in choices.items():
        assert refused(capsys, "report", runs, "-o", tmp_path / "report", *arguments).startswith(start)
    assert not (tmp_path / "report").exists()


@pytest.fixture
def apart(make_run, tmp_path):
    """Two methods on two scenes, with one ground truth each and with other ones of the same names."""
    for label in ("Bicubic", "MSG-V"):
        for place in ("one", "two"):
            make_run(tmp_path / "runs" / place / label, label=label, method=label.lower(), scenes=SCENES)
        path = tmp_path / "runs" / "two" / label / "summary.json"
        truths = dict.fromkeys(SCENES, "5f3c01ab")
        path.write_text(json.dumps({**json.loads(path.read_text()), "truths": truths}))
    return tmp_path / "runs"


def test_different_truths_are_reported_have_tables_of_their_own_and_strict_refuses_them(apart, tmp_path, capsys):
    assert main(["report", str(apart), "-o", str(tmp_path / "report"), "--only", "tables,page"]) == 0
    assert capsys.readouterr().out.count("warning: ") == 1
    report = tmp_path / "report"
    (warning,) = json.loads((report / "report.json").read_text())["warnings"]
    assert (warning["code"], warning["value"]) == ("truths-differ", 2)
    names = sorted(path.name for path in (report / "tables").glob("simgeo*.csv"))
    assert len(names) == 2
    for name in names:
        table = pd.read_csv(report / "tables" / name)
        assert set(table["method"]) == {"Bicubic", "MSG-V"}
        assert len(set(table["dataset"])) == 1
    strict = ("report", apart, "-o", tmp_path / "strict", "--only", "tables", "--strict")
    line = refused(capsys, *strict)
    assert "different ground truths" in line
    assert not (tmp_path / "strict").exists()
    name = re.findall(r"simgeo \(truth [0-9a-f]{8}\)", line)[0]
    assert main([*map(str, strict), "--datasets", name]) == 0


def test_leaderboard_is_a_page_that_ranks_the_methods_and_their_tables(runs, tmp_path, capsys):
    assert main(["leaderboard", str(runs), "-o", str(tmp_path / "site"), "--title", "Ours"]) == 0
    page = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    standings = json.loads(re.search(r'"standings":(\[.*?\]),"scenes"', page)[1])
    assert {row["method"] for row in standings} == {"Bicubic", "MSG-V"}
    assert {row["settings"] for row in standings} == {1}
    assert [row["rank"] for row in standings] == sorted(row["rank"] for row in standings)
    assert {path.name for path in (tmp_path / "site").iterdir()} == {"index.html", "report.json", "tables"}
    capsys.readouterr()
    assert "expected a directory with runs" in refused(
        capsys, "leaderboard", tmp_path / "nowhere", "-o", tmp_path / "other"
    )
    assert not (tmp_path / "other").exists()
