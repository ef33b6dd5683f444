"""Two passes: predictions to files, then scores from files; what is there already and what fails keep their places."""

import contextlib
import csv
import dataclasses
import json
import math

import numpy as np
import pandas as pd
import pytest
import torch

from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.noise import GaussianMultiplicative
from dsr.evaluation.predict import (
    Evaluation,
    Outcome,
    StalePredictionError,
    predict,
)
from dsr.evaluation.score import SCORE_COLUMNS, score
from dsr.evaluation.store import load_prediction, prediction_path
from dsr.geometry.camera import Camera
from dsr.methods.base import Method, NoSolutionError
from dsr.metrics.catalogue import catalogue, score_image
from dsr.sample import DepthSample, Scene
from dsr.utils.files import FullDiskError
from dsr.utils.progress import SILENT, Progress

SIZE, SCALE = 16, 2
CAMERA = Camera(SIZE, SIZE, 20.0, 20.0, 7.5, 7.5)
RAMP = 2 + 0.01 * torch.arange(SIZE * SIZE, dtype=torch.float64).view(1, SIZE, SIZE)


class ToySource:
    """Scenes in memory; one whose content is an exception cannot be loaded."""

    name = "toy"
    evaluation = True

    def __init__(self, **content):
        self.content = content
        self.version = "1"

    def scenes(self):
        return list(self.content)

    def load(self, scene):
        content = self.content[scene]
        if isinstance(content, BaseException):
            raise content
        return content

    def fingerprint(self, scene):
        return f"{scene}-{self.version}"


class ToyMethod(Method):
    """Repeats low-resolution pixels, remembers its calls, and may do something else at a scene."""

    range_type = "orthogonal"

    def __init__(self, **instead):
        self.calls = []
        self.instead = instead

    def __call__(self, sample, progress=None):
        self.calls.append(sample.scene)
        result = self.instead.get(sample.scene)
        if isinstance(result, BaseException):
            raise result
        if result is not None:
            return result
        return sample.depth_lr.repeat_interleave(SCALE, 1).repeat_interleave(SCALE, 2)


def toy_scene(name, depth=RAMP, **more):
    return Scene("toy", name, torch.full((3, SIZE, SIZE), 0.5), CAMERA, depth, **more)


def toy_study(source=None, method=None, config=None, downsampling=None):
    source = source or ToySource(a=toy_scene("a"), b=toy_scene("b", RAMP + 1))
    downsampling = downsampling or Downsampling("box")
    config = {"method": {"name": "toy"}, "scale": SCALE} if config is None else config
    return Evaluation(source, downsampling, "box", SCALE, method or ToyMethod(), "toy_method", 7, config)


def run(study, folder, *, overwrite=False):
    """Return the outcome, the scores and the scenes that were illustrated."""
    pictures = []
    outcome = predict(study, folder, overwrite=overwrite)
    scores = score(study, folder, catalogue(), outcome, SILENT, lambda *entry: pictures.append(entry))
    return outcome, scores, pictures


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def rows(folder):
    with (folder / "scores.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_run_writes_predictions_scores_and_a_summary_and_nothing_else(tmp_path):
    outcome, *_ = run(toy_study(), tmp_path)
    assert files(tmp_path) == [
        *("predictions/a.npz", "predictions/b.npz"),
        *("scenes/a.npz", "scenes/b.npz", "scores.csv", "summary.json"),
    ]
    assert (outcome.made, outcome.reused, outcome.failures, outcome.unscored) == (["a", "b"], [], {}, [])


def test_prediction_is_in_metres_with_its_config(tmp_path):
    predict(toy_study(), tmp_path)
    with np.load(tmp_path / "predictions" / "a.npz") as kept:
        depth, config = kept["depth"], json.loads(str(kept["config"]))
    blocks = RAMP[0].numpy().reshape(8, 2, 8, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(depth, np.kron(blocks, np.ones((2, 2))), rtol=1e-12)
    assert config == {"method": {"name": "toy"}, "scale": SCALE, "scene": "a", "scene_content": "a-1"}


def test_scores_csv_has_the_documented_columns_metrics_and_variants(tmp_path):
    run(toy_study(), tmp_path)
    header = (tmp_path / "scores.csv").read_text().splitlines()[0]
    assert header == "dataset,scene,scale,downsampling,method,seed,metric,variant,value,valid_share"
    assert header.split(",") == list(SCORE_COLUMNS)
    table = rows(tmp_path)
    by_light = ("e1", "e2", "e3", "e4", "max", "avg")
    expected = {(each.name, v) for each in catalogue() for v in (by_light if each.per_light else ("",))}
    for scene in ("a", "b"):
        mine = [row for row in table if row["scene"] == scene]
        assert {(row["metric"], row["variant"]) for row in mine} == expected
        assert len(mine) == len(expected)
    for row in table:
        assert (row["dataset"], row["scale"], row["downsampling"]) == ("toy", "2", "box")
        assert (row["method"], row["seed"], row["valid_share"]) == ("toy_method", "7", "1.0")


def test_scores_equal_score_image_on_the_stored_prediction(tmp_path):
    run(toy_study(), tmp_path)
    prediction = load_prediction(tmp_path / "predictions" / "b.npz")
    expected = {
        (entry.metric, entry.variant): entry.value
        for entry in score_image(prediction.double(), RAMP + 1, CAMERA.rays(), catalogue())
    }
    table = {(row["metric"], row["variant"]): float(row["value"]) for row in rows(tmp_path) if row["scene"] == "b"}
    assert table == pytest.approx(expected, rel=1e-12)


def test_rmse_d_is_the_root_mean_square_of_perspective_depth_in_metres(tmp_path):
    off = RAMP + 0.03
    run(toy_study(ToySource(a=toy_scene("a")), ToyMethod(a=off)), tmp_path)
    [value] = [float(row["value"]) for row in rows(tmp_path) if row["metric"] == "RMSE_d"]
    lengths = [math.hypot((u - 7.5) / 20, (v - 7.5) / 20, 1) for u in range(SIZE) for v in range(SIZE)]
    assert value == pytest.approx(0.03 * math.sqrt(sum(x * x for x in lengths) / len(lengths)), rel=1e-9)


def test_scores_are_computed_from_the_stored_file(tmp_path):
    study = toy_study(ToySource(a=toy_scene("a")))
    outcome = predict(study, tmp_path)
    path = tmp_path / "predictions" / "a.npz"
    with np.load(path) as kept:
        config = kept["config"]
    np.savez(path, depth=RAMP[0].numpy(), config=config, seconds=1.0)
    table = score(study, tmp_path, catalogue(), outcome, SILENT, lambda *_: None)
    assert table.loc[table["metric"] == "RMSE_d", "value"].tolist() == [0.0]


def test_valid_share_reflects_a_hole_in_the_truth(tmp_path):
    holed = RAMP.clone()
    holed[0, :4] = torch.nan
    run(toy_study(ToySource(a=toy_scene("a", holed)), ToyMethod(a=RAMP)), tmp_path)
    [row] = [row for row in rows(tmp_path) if row["metric"] == "RMSE_d"]
    assert float(row["valid_share"]) == 0.75
    assert float(row["value"]) == 0


def test_summary_has_the_means_of_the_worst_of_four_lights(tmp_path):
    run(toy_study(), tmp_path)
    content = json.loads((tmp_path / "summary.json").read_text())
    worst = [row for row in rows(tmp_path) if row["variant"] in ("", "max")]
    for metric in {row["metric"] for row in worst}:
        values = [float(row["value"]) for row in worst if row["metric"] == metric]
        assert len(values) == 2
        assert content["mean"].pop(metric) == pytest.approx(sum(values) / 2, rel=1e-12)
    assert content["mean"] == {}
    assert (content["dataset"], content["method"], content["scale"], content["seed"]) == ("toy", "toy_method", 2, 7)
    assert (content["scenes"], content["predicted"], content["reused"]) == (2, ["a", "b"], [])
    assert list(content["seconds"]) == ["a", "b"]


def test_picture_gets_the_prediction_and_its_worst_scores(tmp_path):
    _, _, pictures = run(toy_study(), tmp_path)
    assert [sample.scene for sample, *_ in pictures] == ["a", "b"]
    worst = {
        row["metric"]: float(row["value"])
        for row in rows(tmp_path)
        if row["scene"] == "a" and row["variant"] in ("", "max")
    }
    sample, depth, scores = pictures[0]
    assert scores == pytest.approx(worst, rel=1e-12)
    assert torch.equal(depth, load_prediction(tmp_path / "predictions" / "a.npz"))
    assert sample.depth is not None


def test_second_run_reuses_predictions_without_calling_the_method(tmp_path):
    _, first, _ = run(toy_study(), tmp_path)
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in files(tmp_path) if name.startswith("pred")}
    method = ToyMethod()
    outcome, second, pictures = run(toy_study(method=method), tmp_path)
    assert method.calls == []
    assert (outcome.made, outcome.reused) == ([], ["a", "b"])
    assert before == {name: (tmp_path / name).stat().st_mtime_ns for name in before}
    assert first.equals(second)
    assert len(pictures) == 2


def test_prediction_of_another_machine_is_seen_where_missing_files_are_remembered(tmp_path, monkeypatch):
    run(toy_study(), tmp_path)
    (tmp_path / "predictions").rename(tmp_path / "unseen")

    def ask_server(folder):  # as a client of NFS does when a directory is opened
        if folder.name == "predictions" and not folder.exists():
            (tmp_path / "unseen").rename(folder)

    monkeypatch.setattr("dsr.evaluation.predict.look_anew", ask_server)
    method = ToyMethod()
    outcome, *_ = run(toy_study(method=method), tmp_path)
    assert (method.calls, outcome.reused) == ([], ["a", "b"])


def test_overwrite_makes_every_prediction_anew(tmp_path):
    run(toy_study(), tmp_path)
    method = ToyMethod(a=RAMP)
    outcome, *_ = run(toy_study(method=method), tmp_path, overwrite=True)
    assert method.calls == outcome.made == ["a", "b"]
    assert torch.equal(load_prediction(tmp_path / "predictions" / "a.npz"), RAMP)


def test_prediction_of_another_config_is_refused_by_file_and_key_and_kept(tmp_path):
    run(toy_study(), tmp_path)
    content = (tmp_path / "predictions" / "a.npz").read_bytes()
    method = ToyMethod()
    study = toy_study(method=method, config={"method": {"name": "toy"}, "scale": 4})
    with pytest.raises(StalePredictionError, match=r"predictions/a\.npz: made with another scale; overwrite=true"):
        predict(study, tmp_path)
    assert method.calls == []
    assert (tmp_path / "predictions" / "a.npz").read_bytes() == content


def test_prediction_of_a_changed_scene_is_refused(tmp_path):
    study = toy_study()
    run(study, tmp_path)
    study.source.version = "2"
    with pytest.raises(StalePredictionError, match="another scene_content"):
        predict(study, tmp_path)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("damage", ["empty", "truncated", "foreign", "no config", "config no object"])
def test_damaged_prediction_is_refused_or_made_anew(tmp_path, damage, overwrite):
    run(toy_study(), tmp_path)
    path = tmp_path / "predictions" / "b.npz"
    if damage == "no config":
        np.savez(path, depth=RAMP[0].numpy())
    elif damage == "config no object":
        np.savez(path, depth=RAMP[0].numpy(), config="3", seconds=1.0)
    else:
        path.write_bytes({"empty": b"", "truncated": path.read_bytes()[:-60], "foreign": b"hello"}[damage])
    if overwrite:
        outcome, *_ = run(toy_study(), tmp_path, overwrite=True)
        assert outcome.made == ["a", "b"]
        load_prediction(path)
    else:
        with pytest.raises(StalePredictionError, match=r"b\.npz: damaged; overwrite=true makes it again"):
            predict(toy_study(), tmp_path)


@pytest.mark.parametrize(
    ("failure", "message"),
    [
        (ValueError("expected a bad\n picture"), "bad: expected a bad picture"),
        (ValueError("data/bad/rgb.png: expected a picture"), "data/bad/rgb.png: expected a picture"),
        (ValueError("bad: no depth"), "bad: no depth"),
        (OSError(28, "No space left", "x.npz"), "bad: [Errno 28] No space left: 'x.npz'"),
        (ValueError(""), "bad: ValueError"),
    ],
)
def test_bad_scene_does_not_lose_the_others_results(tmp_path, failure, message):
    source = ToySource(a=toy_scene("a"), bad=failure, c=toy_scene("c"))
    outcome, scores, pictures = run(toy_study(source), tmp_path)
    assert (outcome.made, outcome.failures) == (["a", "c"], {"bad": message})
    assert scores["scene"].unique().tolist() == ["a", "c"]
    assert [sample.scene for sample, *_ in pictures] == ["a", "c"]
    assert json.loads((tmp_path / "summary.json").read_text())["failures"] == outcome.failures
    assert files(tmp_path) == [
        *("predictions/a.npz", "predictions/c.npz"),
        *("scenes/a.npz", "scenes/c.npz", "scores.csv", "summary.json"),
    ]


def test_scene_that_the_method_refuses_does_not_lose_the_others_results(tmp_path):
    study = toy_study(method=ToyMethod(a=ValueError("too dark")))
    outcome, scores, _ = run(study, tmp_path)
    assert outcome.failures == {"a": "a: too dark"}
    assert scores["scene"].unique().tolist() == ["b"]


def test_picture_that_cannot_be_drawn_fails_its_scene_and_keeps_its_scores(tmp_path):
    def refuse(sample, depth, scores):
        if sample.scene == "a":
            raise OSError(28, "No space left")

    study = toy_study()
    outcome = predict(study, tmp_path)
    score(study, tmp_path, catalogue(), outcome, SILENT, refuse)
    assert list(outcome.failures) == ["a"]
    assert {row["scene"] for row in rows(tmp_path)} == {"a", "b"}


def test_score_file_has_its_header_alone_where_every_scene_fails(tmp_path):
    outcome, scores, _ = run(toy_study(ToySource(a=ValueError("no"), b=ValueError("no"))), tmp_path)
    assert len(outcome.failures) == 2
    assert scores.empty
    assert (tmp_path / "scores.csv").read_text().strip() == ",".join(SCORE_COLUMNS)
    assert json.loads((tmp_path / "summary.json").read_text())["mean"] == {}


@pytest.mark.parametrize("shape", [(1, SIZE, SIZE - 2), (SIZE, SIZE), (1, 1, SIZE, SIZE)])
def test_prediction_of_the_wrong_shape_is_refused_and_not_written(tmp_path, shape):
    outcome = predict(toy_study(method=ToyMethod(a=torch.ones(shape))), tmp_path)
    assert "toy_method gave depth of shape" in outcome.failures["a"]
    assert files(tmp_path) == ["predictions/b.npz", "scenes/b.npz"]


def test_stored_prediction_of_the_wrong_shape_is_not_scored(tmp_path):
    study = toy_study()
    predict(study, tmp_path)
    path = tmp_path / "predictions" / "a.npz"
    with np.load(path) as kept:
        config = kept["config"]
    np.savez(path, depth=np.ones((3, 5)), config=config, seconds=1.0)
    outcome, scores, _ = run(study, tmp_path)
    assert "expected a prediction of shape (1, 16, 16), got (1, 3, 5)" in outcome.failures["a"]
    assert scores["scene"].unique().tolist() == ["b"]


def test_scene_without_truth_is_predicted_and_drawn_but_not_scored(tmp_path):
    blind = toy_scene("blind", None, measured={SCALE: torch.full((1, 8, 8), 2.0)})
    seen = toy_scene("seen", RAMP, measured={SCALE: torch.full((1, 8, 8), 2.0)})
    study = toy_study(ToySource(blind=blind, seen=seen), downsampling=Measured())
    outcome, scores, pictures = run(study, tmp_path)
    assert (outcome.made, outcome.unscored, outcome.failures) == (["blind", "seen"], ["blind"], {})
    assert scores["scene"].unique().tolist() == ["seen"]
    assert pictures[0][2] == {}
    assert bool((load_prediction(tmp_path / "predictions" / "blind.npz") == 2.0).all())
    assert json.loads((tmp_path / "summary.json").read_text())["without_truth"] == ["blind"]


def test_cropped_scene_is_noted(tmp_path):
    camera = Camera(SIZE + 1, SIZE, 20.0, 20.0, 7.5, 7.5)
    odd = Scene(
        "toy", "odd", torch.full((3, SIZE, SIZE + 1), 0.5), camera, torch.full((1, SIZE, SIZE + 1), 2.0).double()
    )
    outcome, *_ = run(toy_study(ToySource(odd=odd)), tmp_path)
    assert outcome.notes == {"odd": ["cropped from 16 x 17 to 16 x 16, which 2 divides"]}


def test_interruption_keeps_the_finished_scene_and_leaves_no_temporary_file(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        predict(toy_study(method=ToyMethod(b=KeyboardInterrupt())), tmp_path)
    assert files(tmp_path) == ["predictions/a.npz", "scenes/a.npz"]
    method = ToyMethod()
    outcome, *_ = run(toy_study(method=method), tmp_path)
    assert (method.calls, outcome.made, outcome.reused) == (["b"], ["b"], ["a"])


def test_interruption_while_a_prediction_is_written_leaves_no_partial_file(tmp_path, monkeypatch):
    whole = np.savez_compressed

    def cut(path, **arrays):
        if path.name.startswith(".b"):
            path.write_bytes(b"half a file")
            raise KeyboardInterrupt
        whole(path, **arrays)

    monkeypatch.setattr(np, "savez_compressed", cut)
    with pytest.raises(KeyboardInterrupt):
        predict(toy_study(), tmp_path)
    assert files(tmp_path) == ["predictions/a.npz", "scenes/a.npz"]


def test_full_disk_ends_the_pass_and_keeps_the_former_prediction(tmp_path, monkeypatch):
    run(toy_study(), tmp_path)
    before = (tmp_path / "predictions" / "a.npz").read_bytes()

    def full(path, **arrays):
        path.write_bytes(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(FullDiskError, match=r"a\.npz: expected space to write the file"):
        predict(toy_study(), tmp_path, overwrite=True)
    assert (tmp_path / "predictions" / "a.npz").read_bytes() == before


def test_missing_prediction_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"a\.npz: expected a prediction"):
        load_prediction(tmp_path / "a.npz")


def test_scene_that_failed_is_not_scored_from_an_older_file(tmp_path):
    run(toy_study(), tmp_path)
    outcome = Outcome(seconds={"b": 1.0}, failures={"a": "a: broken"})
    table = score(toy_study(), tmp_path, catalogue(), outcome, SILENT, lambda *_: None)
    assert table["scene"].unique().tolist() == ["b"]


def test_prediction_is_replaced_atomically(tmp_path):
    run(toy_study(), tmp_path)
    path = tmp_path / "predictions" / "a.npz"
    before = path.read_bytes()
    with path.open("rb") as reader:
        run(toy_study(method=ToyMethod(a=RAMP)), tmp_path, overwrite=True)
        assert reader.read() == before
    assert path.read_bytes() != before
    assert path.stat().st_mode & 0o777 == 0o644


def test_samples_of_a_study_have_its_noise_under_its_seed():
    clean, noise = toy_study(), GaussianMultiplicative(0.02)
    noisy = dataclasses.replace(clean, noise=noise)
    expected = make_sample(toy_scene("a"), SCALE, Downsampling("box"), "orthogonal", noise, 7)
    torch.testing.assert_close(noisy.sample("a").depth_lr, expected.depth_lr, rtol=0, atol=0)
    assert not torch.equal(noisy.sample("a").depth_lr, clean.sample("a").depth_lr)
    reseeded = dataclasses.replace(noisy, seed=8).sample("a")
    assert not torch.equal(reseeded.depth_lr, expected.depth_lr)
    assert torch.equal(reseeded.depth, clean.sample("a").depth)


class Recorder(Progress):
    """Keeps what the tasks report: name, done and total."""

    def __init__(self, shown):
        self.shown = shown

    @contextlib.contextmanager
    def task(self, name, total=None, *, done=0, unit="items"):
        yield lambda done, total: self.shown.append((name, done, total))


class Iterating(ToyMethod):
    """Tells its steps, and how they went."""

    def __call__(self, sample, progress=None):
        for step in range(3):
            if progress is not None:
                progress(step + 1, 3)
        self.history = [{"iteration": 1.0, "objective": 0.5}, {"iteration": 3.0, "objective": 0.25}]
        return super().__call__(sample)


def test_iteration_progress_is_shown_and_stored(tmp_path):
    shown = []

    predict(toy_study(method=Iterating()), tmp_path, Recorder(shown))
    assert shown == [("steps", done, 3) for _ in "ab" for done in (1, 2, 3)]
    assert (tmp_path / "iterations" / "a.csv").read_text() == "iteration,objective\n1.0,0.5\n3.0,0.25\n"


def test_scene_without_a_solution_is_a_result_and_no_failure(tmp_path):
    method = ToyMethod(b=NoSolutionError("a map of 2 x 2 is smaller than a patch"))
    outcome, scores, _ = run(toy_study(method=method), tmp_path)
    reason = "b: a map of 2 x 2 is smaller than a patch"
    assert outcome.unsolved == {"b": reason}
    assert outcome.failures == {}
    assert set(scores["scene"]) == {"a"}
    assert json.loads((tmp_path / "summary.json").read_text())["unanswered"] == {"b": reason}
    assert not (tmp_path / "predictions" / "b.npz").exists()


def test_earlier_prediction_is_not_scored_where_there_is_no_solution_now(tmp_path):
    run(toy_study(), tmp_path)
    _, scores, _ = run(toy_study(method=ToyMethod(b=NoSolutionError("none"))), tmp_path, overwrite=True)
    assert set(scores["scene"]) == {"a"}
    assert not (tmp_path / "predictions" / "b.npz").exists()


def test_score_reads_the_run_directory_alone(tmp_path):
    _, expected, _ = run(toy_study(), tmp_path)
    gone = toy_study(ToySource(a=ValueError("gone"), b=ValueError("gone")))
    outcome = predict(toy_study(), tmp_path)
    again = score(gone, tmp_path, catalogue(), outcome, SILENT, lambda *_: None)
    assert outcome.failures == {}
    pd.testing.assert_frame_equal(again, expected, check_exact=True)


def test_predict_stores_a_sample_that_is_missing_beside_its_prediction(tmp_path):
    run(toy_study(), tmp_path)
    before = DepthSample.load(tmp_path / "scenes" / "a.npz")
    (tmp_path / "scenes" / "a.npz").unlink()
    method = ToyMethod()
    outcome, scores, _ = run(toy_study(method=method), tmp_path)
    assert (method.calls, outcome.reused, outcome.failures) == ([], ["a", "b"], {})
    assert torch.equal(DepthSample.load(tmp_path / "scenes" / "a.npz").depth_lr, before.depth_lr)
    assert set(scores["scene"]) == {"a", "b"}


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -1.0])
def test_prediction_without_a_finite_positive_depth_is_a_failure_of_the_scene(tmp_path, value):
    outcome, scores, pictures = run(toy_study(method=ToyMethod(a=torch.full_like(RAMP, value))), tmp_path)
    said = f"a: toy_method gave no finite positive depth in any of the {RAMP.numel()} pixels"
    assert outcome.failures == {"a": said}
    assert set(scores["scene"]) == {"b"}
    assert not prediction_path(tmp_path, "a").exists()
    assert len(pictures) == 1


def test_depths_that_are_not_finite_and_positive_count_as_holes(tmp_path):
    wrong, holes = RAMP.clone(), RAMP.clone()
    wrong[0, 0, :3] = torch.tensor([math.inf, 0.0, -1.0])
    holes[0, 0, :3] = math.nan
    scores = [run(toy_study(method=ToyMethod(a=depth)), tmp_path / name)[1]
              for name, depth in (("wrong", wrong), ("holes", holes))]  # fmt: skip
    pd.testing.assert_frame_equal(*scores)


def test_score_names_a_damaged_sample_and_keeps_the_other_scenes(tmp_path):
    outcome = predict(toy_study(), tmp_path)
    path = tmp_path / "scenes" / "a.npz"
    path.write_bytes(path.read_bytes()[:50])
    scores = score(toy_study(), tmp_path, catalogue(), outcome, SILENT, lambda *_: None)
    assert outcome.failures == {"a": f"{path}: expected the sample of a scene, got a damaged or foreign file"}
    assert set(scores["scene"]) == {"b"}
