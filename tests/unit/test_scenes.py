"""Scenes are predicted into files and scored from them; what is there already and what fails keep their places."""

import contextlib
import csv
import dataclasses
import functools
import json
import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest
import torch

from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.degradation.noise import GaussianMultiplicative
from dsr.evaluation.results import load_prediction
from dsr.evaluation.scenes import Evaluation, StalePredictionError, evaluate_scene, write_tables
from dsr.geometry.camera import Camera
from dsr.methods.base import Method, NoSolutionError
from dsr.metrics.catalogue import catalogue, score_image
from dsr.sample import Scene
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


def toy_study(folder, source=None, method=None, config=None, downsampling=None, **more):
    source = source or ToySource(a=toy_scene("a"), b=toy_scene("b", RAMP + 1))
    downsampling = downsampling or Downsampling("box")
    config = {"method": {"name": "toy"}, "scale": SCALE} if config is None else config
    method = method or ToyMethod()
    return Evaluation(folder, source, downsampling, "box", SCALE, method, "toy_method", 7, config, catalogue(), **more)


def run(study, *, overwrite=False, progress=SILENT):
    """Return the results and the scores."""
    since = time.time() if overwrite else -math.inf
    results = {scene: evaluate_scene(study, scene, since, progress) for scene in study.source.scenes()}
    return results, write_tables(study, results)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def written(*scenes):
    """Return the files of a run with predictions of these scenes."""
    places = [f"{place}/{scene}.npz" for place in ("predictions", "scenes") for scene in scenes]
    return [*places, "scores.csv", "summary.json"]


def rows(folder):
    with (folder / "scores.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def replace_depth(path, depth):
    with np.load(path) as kept:
        config = kept["config"]
    np.savez(path, depth=depth, config=config, seconds=1.0)


def test_run_writes_predictions_in_metres_with_their_config_scores_and_a_summary_and_nothing_else(tmp_path):
    run(toy_study(tmp_path))
    assert files(tmp_path) == written("a", "b")
    content = summary(tmp_path)
    assert (content["dataset"], content["method"], content["scale"], content["seed"]) == ("toy", "toy_method", 2, 7)
    assert (content["scenes"], content["predicted"], content["reused"]) == (2, ["a", "b"], [])
    assert (content["failures"], content["without_truth"], list(content["seconds"])) == ({}, [], ["a", "b"])
    assert len(set(content["truths"].values())) == 2
    with np.load(tmp_path / "predictions" / "a.npz") as kept:
        depth, config = kept["depth"], json.loads(str(kept["config"]))
    blocks = RAMP[0].numpy().reshape(8, 2, 8, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(depth, np.kron(blocks, np.ones((2, 2))), rtol=1e-12)
    assert config == {"method": {"name": "toy"}, "scale": SCALE, "scene": "a", "scene_content": "a-1"}


def test_scores_are_those_of_the_stored_prediction(tmp_path):
    run(toy_study(tmp_path))
    replace_depth(tmp_path / "predictions" / "b.npz", RAMP[0].numpy() + 1.02)
    run(toy_study(tmp_path))
    prediction = load_prediction(tmp_path / "predictions" / "b.npz")
    expected = {
        (entry.metric, entry.variant): entry.value
        for entry in score_image(prediction.double(), RAMP + 1, CAMERA.rays(), catalogue())
    }
    header, first = (tmp_path / "scores.csv").read_text().splitlines()[:2]
    assert header == "dataset,scene,scale,downsampling,method,seed,metric,variant,value,valid_share"
    assert first.startswith("toy,a,2,box,toy_method,7,")
    assert first.endswith(",1.0")
    table = {(row["metric"], row["variant"]): float(row["value"]) for row in rows(tmp_path) if row["scene"] == "b"}
    assert table == pytest.approx(expected, rel=1e-12)


def test_summary_and_pictures_have_the_worst_of_four_lights(tmp_path):
    pictures = []
    run(toy_study(tmp_path, illustrate=lambda *entry: pictures.append(entry)))
    means = summary(tmp_path)["mean"]
    worst = [row for row in rows(tmp_path) if row["variant"] in ("", "max")]
    for metric in {row["metric"] for row in worst}:
        values = [float(row["value"]) for row in worst if row["metric"] == metric]
        assert len(values) == 2
        assert means.pop(metric) == pytest.approx(sum(values) / 2, rel=1e-12)
    assert means == {}
    assert [sample.scene for sample, *_ in pictures] == ["a", "b"]
    _, depth, _, scores = pictures[0]
    assert scores == pytest.approx({row["metric"]: float(row["value"]) for row in worst if row["scene"] == "a"})
    assert torch.equal(depth, load_prediction(tmp_path / "predictions" / "a.npz"))


def test_overwrite_makes_every_prediction_anew_and_replaces_it_atomically(tmp_path):
    run(toy_study(tmp_path))
    path = tmp_path / "predictions" / "a.npz"
    before = path.read_bytes()
    method = ToyMethod(a=RAMP)
    with path.open("rb") as reader:
        run(toy_study(tmp_path, method=method), overwrite=True)
        assert reader.read() == before
    assert method.calls == ["a", "b"]
    assert torch.equal(load_prediction(path), RAMP)
    assert path.stat().st_mode & 0o777 == 0o644


def test_prediction_of_another_config_is_refused_by_file_and_key_and_kept(tmp_path):
    run(toy_study(tmp_path))
    content = (tmp_path / "predictions" / "a.npz").read_bytes()
    method = ToyMethod()
    with pytest.raises(StalePredictionError, match=r"predictions/a\.npz: .*another scale; overwrite=true"):
        run(toy_study(tmp_path, method=method, config={"method": {"name": "toy"}, "scale": 4}))
    changed = toy_study(tmp_path, method=method)
    changed.source.version = "2"
    with pytest.raises(StalePredictionError, match="another scene_content"):
        run(changed)
    assert method.calls == []
    assert (tmp_path / "predictions" / "a.npz").read_bytes() == content


@pytest.mark.parametrize("damage", ["empty", "truncated", "foreign", "no config", "config no object"])
def test_damaged_prediction_is_refused_or_made_anew(tmp_path, damage):
    run(toy_study(tmp_path))
    path = tmp_path / "predictions" / "b.npz"
    if damage == "no config":
        np.savez(path, depth=RAMP[0].numpy())
    elif damage == "config no object":
        np.savez(path, depth=RAMP[0].numpy(), config="3", seconds=1.0)
    else:
        path.write_bytes({"empty": b"", "truncated": path.read_bytes()[:-60], "foreign": b"hello"}[damage])
    with pytest.raises(StalePredictionError, match=r"b\.npz: damaged; overwrite=true"):
        run(toy_study(tmp_path))
    run(toy_study(tmp_path), overwrite=True)
    load_prediction(path)


@pytest.mark.parametrize(
    ("scene", "result", "message"),
    [
        (ValueError("expected a bad\n picture"), None, "a: expected a bad picture"),
        (ValueError("data/a/rgb.png: expected a picture"), None, "data/a/rgb.png: expected a picture"),
        (OSError(28, "No space left", "x.npz"), None, "a: [Errno 28] No space left: 'x.npz'"),
        (ValueError(""), None, "a: ValueError"),
        (None, ValueError("too dark"), "a: too dark"),
        (None, torch.ones(1, SIZE, SIZE - 2), "toy_method gave depth of shape"),
        (None, torch.ones(SIZE, SIZE), "toy_method gave depth of shape"),
        (None, torch.full_like(RAMP, math.nan), "gave no finite positive depth"),
        (None, torch.full_like(RAMP, -1.0), "gave no finite positive depth"),
    ],
)
def test_bad_scene_or_failing_method_does_not_lose_the_others_results(tmp_path, scene, result, message):
    source = ToySource(a=scene or toy_scene("a"), b=toy_scene("b"))
    results, scores = run(toy_study(tmp_path, source, ToyMethod(a=result)))
    assert message in results["a"].failure
    assert summary(tmp_path)["failures"] == {"a": results["a"].failure}
    assert scores["scene"].unique().tolist() == ["b"]
    assert files(tmp_path) == written("b")


def test_depths_that_are_not_finite_and_positive_count_as_holes(tmp_path):
    wrong, holes = RAMP.clone(), RAMP.clone()
    wrong[0, 0, :3] = torch.tensor([math.inf, 0.0, -1.0])
    holes[0, 0, :3] = math.nan
    scores = [run(toy_study(tmp_path / name, method=ToyMethod(a=depth)))[1]
              for name, depth in (("wrong", wrong), ("holes", holes))]  # fmt: skip
    pd.testing.assert_frame_equal(*scores)


def test_picture_that_cannot_be_drawn_fails_its_scene_and_keeps_its_scores(tmp_path):
    def refuse(sample, depth, errors, scores):
        if sample.scene == "a":
            raise OSError(28, "No space left")

    run(toy_study(tmp_path, illustrate=refuse))
    assert list(summary(tmp_path)["failures"]) == ["a"]
    assert {row["scene"] for row in rows(tmp_path)} == {"a", "b"}


@pytest.mark.parametrize("damage", ["prediction", "sample"])
def test_stored_prediction_of_the_wrong_shape_or_beside_a_damaged_sample_is_not_scored(tmp_path, damage):
    study, sample = toy_study(tmp_path), tmp_path / "scenes" / "a.npz"
    run(study)
    if damage == "prediction":
        replace_depth(tmp_path / "predictions" / "a.npz", np.ones((3, 5)))
        message = "expected a prediction of shape (1, 16, 16), got (1, 3, 5)"
    else:
        sample.write_bytes(sample.read_bytes()[:50])
        message = f"{sample}: expected the sample of a scene, got a damaged or foreign file"
    results, scores = run(study)
    assert message in results["a"].failure
    assert scores["scene"].unique().tolist() == ["b"]


def test_scene_without_truth_is_predicted_and_drawn_but_not_scored(tmp_path):
    pictures = []
    blind = toy_scene("blind", None, measured={SCALE: torch.full((1, 8, 8), 2.0)})
    seen = toy_scene("seen", RAMP, measured={SCALE: torch.full((1, 8, 8), 2.0)})
    study = toy_study(
        tmp_path, ToySource(blind=blind, seen=seen), downsampling=Measured(),
        illustrate=lambda *entry: pictures.append(entry),
    )  # fmt: skip
    _, scores = run(study)
    assert scores["scene"].unique().tolist() == ["seen"]
    assert pictures[0][3] == {}
    assert bool((load_prediction(tmp_path / "predictions" / "blind.npz") == 2.0).all())
    content = summary(tmp_path)
    assert (content["without_truth"], list(content["truths"])) == (["blind"], ["seen"])


def half_written(error):
    """Return a writer of arrays that fails after half a file."""

    def write(path, **arrays):
        path.write_bytes(b"half a file")
        raise error

    return write


def test_interruption_keeps_the_finished_scene_and_leaves_no_temporary_file(tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        run(toy_study(tmp_path, method=ToyMethod(b=KeyboardInterrupt())))
    assert files(tmp_path) == ["predictions/a.npz", "scenes/a.npz"]
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", half_written(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            run(toy_study(tmp_path))
    assert [name for name in files(tmp_path) if name.startswith("pred")] == ["predictions/a.npz"]
    method = ToyMethod()
    run(toy_study(tmp_path, method=method))
    assert method.calls == ["b"]
    assert summary(tmp_path)["reused"] == ["a"]


def test_full_disk_ends_the_pass_and_keeps_the_former_prediction(tmp_path, monkeypatch):
    run(toy_study(tmp_path))
    before = (tmp_path / "predictions" / "a.npz").read_bytes()
    monkeypatch.setattr(np, "savez_compressed", half_written(OSError(28, "No space left on device")))
    with pytest.raises(FullDiskError, match=r"a\.npz: expected space to write the file"):
        run(toy_study(tmp_path), overwrite=True)
    assert (tmp_path / "predictions" / "a.npz").read_bytes() == before


def test_samples_of_a_study_have_its_noise_under_its_seed(tmp_path):
    clean, noise = toy_study(tmp_path), GaussianMultiplicative(0.02)
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
    run(toy_study(tmp_path, method=Iterating()), progress=Recorder(shown))
    assert shown == [("steps", done, 3) for _ in "ab" for done in (1, 2, 3)]
    assert (tmp_path / "iterations" / "a.csv").read_text() == "iteration,objective\n1.0,0.5\n3.0,0.25\n"


def test_scenes_of_several_threads_are_predicted_one_at_a_time_and_written_as_one_by_one(tmp_path):
    class Alone(ToyMethod):
        at_work = 0

        def __call__(self, sample, progress=None):
            self.at_work += 1
            time.sleep(0.01)
            assert self.at_work == 1
            self.at_work -= 1
            return super().__call__(sample)

    content = {name: toy_scene(name, RAMP + number) for number, name in enumerate("abcdefgh")}
    studies = [toy_study(tmp_path / name, ToySource(**content), Alone()) for name in ("apart", "together")]
    run(studies[0])
    with ThreadPoolExecutor(4) as pool:
        results = dict(zip(content, pool.map(functools.partial(evaluate_scene, studies[1]), content), strict=True))
    write_tables(studies[1], results)
    assert rows(tmp_path / "together") == rows(tmp_path / "apart")


def test_scene_without_a_solution_is_a_result_and_no_failure_and_its_earlier_prediction_goes(tmp_path):
    run(toy_study(tmp_path))
    method = ToyMethod(b=NoSolutionError("a map of 2 x 2 is smaller than a patch"))
    _, scores = run(toy_study(tmp_path, method=method), overwrite=True)
    content = summary(tmp_path)
    assert content["unanswered"] == {"b": "b: a map of 2 x 2 is smaller than a patch"}
    assert content["failures"] == {}
    assert set(scores["scene"]) == {"a"}
    assert not (tmp_path / "predictions" / "b.npz").exists()
