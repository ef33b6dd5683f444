"""Runs are read from their directories alone: ordered, distinguished, and what cannot be read is left out and said."""

import json
import os

import pytest

from dsr.evaluation.results import BenchmarkSetting
from dsr.evaluation.run_files import load_results


def change(folder, name, **entries):
    path = folder / name
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, **entries}))


def change_method(folder, **entries):
    identity = json.loads((folder / "versions.json").read_text())["identity"]
    change(folder, "versions.json", identity={**identity, "method": {**identity["method"], **entries}})


def test_run_is_read_with_its_scenes_predictions_and_scores(make_run, tmp_path):
    make_run(tmp_path / "a", scenes=("b", "c"))
    (run,) = load_results([tmp_path]).runs
    assert (run.problem, run.label, run.scenes) == (BenchmarkSetting("simgeo", 4, "box"), "Bicubic", ("b", "c"))
    assert run.prediction("b").shape == (1, 32, 32)
    assert set(run.scores["scene"]) == {"b", "c"}
    assert run.seconds == {"b": 0.25, "c": 0.25}
    assert run.versions["python"] == "3.11.7"
    assert "identity" not in run.versions
    assert run.settings["method"]["name"] == "bicubic"


def test_methods_and_settings_come_in_the_order_of_the_paper(make_run, tmp_path):
    for number, (label, dataset) in enumerate(
        [("Facets", "icl"), ("MSG-V", "icl"), ("DIP", "icl"), ("Bicubic", "simgeo")]
    ):
        make_run(tmp_path / str(number), label=label, method=label, dataset=dataset, scenes=("a",))
    results = load_results([tmp_path])
    assert results.methods() == ["Bicubic", "DIP", "MSG-V", "Facets"]
    assert [problem.dataset for problem in results.problems()] == ["simgeo", "icl"]
    assert [run.label for run in results.runs] == ["Bicubic", "DIP", "MSG-V", "Facets"]


def test_runs_of_one_method_are_labelled_by_their_settings(make_run, tmp_path):
    for name, ensemble in (("a", 1), ("b", 4)):
        make_run(tmp_path / name, scenes=("s",))
        change_method(tmp_path / name, ensemble=ensemble, order="cubic")
    assert load_results([tmp_path]).methods() == ["Bicubic (ensemble=1)", "Bicubic (ensemble=4)"]


def test_runs_that_differ_in_the_seed_have_one_label(make_run, tmp_path):
    for seed in (0, 1):
        make_run(tmp_path / str(seed), seed=seed, scenes=("s",))
    results = load_results([tmp_path])
    assert results.methods() == ["Bicubic"]
    assert [run.seed for run in results.runs] == [0, 1]
    assert not results.notes


def test_newer_of_two_predictions_counts_with_a_note(make_run, tmp_path):
    for age, (name, scenes) in enumerate([("new", ("s",)), ("old", ("s", "t"))]):
        make_run(tmp_path / name, scenes=scenes)
        os.utime(tmp_path / name / "scores.csv", (1e9 - age, 1e9 - age))
    results = load_results([tmp_path])
    assert {run.folder.name: run.scenes for run in results.runs} == {"new": ("s",), "old": ("t",)}
    assert set(results.runs[1].scores["scene"] if results.runs[1].folder.name == "old" else []) <= {"t"}
    (note,) = results.notes
    assert "old" in note
    assert ": s; " in note


def test_directory_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"expected runs of eval.py .*found none"):
        load_results([tmp_path])
    with pytest.raises(ValueError, match="there is none"):
        load_results([tmp_path / "absent"])


def test_scene_without_prediction_is_left_out_of_the_run(make_run, tmp_path):
    make_run(tmp_path, scenes=("s", "t"))
    (tmp_path / "predictions" / "t.npz").unlink()
    (run,) = load_results([tmp_path]).runs
    assert run.scenes == ("s",)
    assert set(run.scores["scene"]) == {"s"}


def test_runs_can_be_chosen_and_unknown_ones_are_refused(make_run, tmp_path):
    for label, scale in (("Bicubic", 4), ("MSG", 4), ("MSG", 2)):
        make_run(tmp_path / f"{label}{scale}", label=label, method=label, scale=scale, scenes=("s",))
    results = load_results([tmp_path])
    assert [(run.label, run.scale) for run in results.only(["MSG"], scales=[]).runs] == [("MSG", 2), ("MSG", 4)]
    with pytest.raises(ValueError, match="methods: expected some of MSG, Bicubic, got DIP"):
        results.only(["DIP"])
    with pytest.raises(ValueError, match="there is none"):
        results.only(["Bicubic"], scales=[2])
