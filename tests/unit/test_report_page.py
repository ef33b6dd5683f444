"""The page of a report: what it holds of scores and pictures, and that it holds nothing else."""

import base64
import dataclasses
import json
import math
import re

import cv2
import numpy as np
import pytest
import torch
from small_runs import made_up_run

from dsr.evaluation.results import Results
from dsr.evaluation.run_files import load_results
from dsr.geometry.surface import render
from dsr.metrics.formats import MetricFormat
from dsr.pictures.depth_views import normals_seen_by
from dsr.report.page import Pictures, save_page, standings
from dsr.report.page_scenes import PictureStore
from dsr.report.worker_pool import WorkerPool


def blocks(path):
    """Return the page's blocks of data by name."""
    text = path.read_text(encoding="utf-8")
    return dict(re.findall(r'<script type="[a-z/]+" id="(\w+)">(.*?)</script>', text, flags=re.DOTALL))


def picture(content, name):
    """Return a stored picture; grey ones as (H, W)."""
    image = cv2.imdecode(np.frombuffer(base64.b64decode(content[name]), np.uint8), cv2.IMREAD_COLOR)
    return image[..., 0]


def shadings(content, surface):
    """Return e1, e2, e3 as the page holds them, (3, H, W) in [-1, 1]."""
    width, height = surface["size"]
    tiles = picture(content, surface["normals"]).astype(float) / 127.5 - 1
    return tiles.reshape(height, 3, width).transpose(1, 0, 2)


def saved(folder, results):
    """Write the page and return its blocks, the data and the first scene."""
    path = folder / "report" / "index.html"
    save_page(path, Pictures(WorkerPool(results)))
    content = blocks(path)
    return content, json.loads(content["data"]), json.loads(content["s0"]) if "s0" in content else None


def changed(run, **predictions):
    """Return a run with other predictions or scenes, which lie in no file."""
    run = dataclasses.replace(run)
    for name, value in predictions.items():
        object.__setattr__(run, name, value)
    return run


def test_page_holds_renderings_input_and_errors_of_a_run_to_a_level(make_run, tmp_path):
    results = load_results([make_run(tmp_path / "run", confident=True)])
    content, _, scene = saved(tmp_path, results)
    run = results.runs[0]
    stored = run.sample("cube_no_texture")
    depths = {"Bicubic": run.prediction("cube_no_texture"), "truth": stored.depth}
    for surface in scene["surfaces"][1:]:
        expected = render(normals_seen_by(stored.camera, depths[surface["label"]]))[0].numpy()
        e1, e2, e3 = shadings(content, surface)
        found = np.stack([e1, e2, e3, (e1 + e2 + e3) / math.sqrt(3)]).clip(0, 1)
        assert np.abs(found[:3] - expected[:3]).max() <= 1.001 / 255
        assert np.abs(found[3] - expected[3]).max() <= math.sqrt(3) * 1.001 / 255
    surface, result = scene["surfaces"][:2]
    assert (surface["kind"], surface["size"]) == ("input", [8, 8])
    expected = render(normals_seen_by(stored.camera_lr, stored.depth_lr))[0, 0].numpy()
    assert np.abs(shadings(content, surface)[0].clip(0, 1) - expected).max() <= 1.001 / 255
    expected = (run.prediction("cube_no_texture") - stored.depth)[0].numpy()
    largest = scene["error"]["largest"]
    levels = picture(content, result["error"]["values"]).astype(float) - 128
    found = np.sign(levels) * levels**2 / 127**2 * largest
    assert np.abs(found - expected.clip(-largest, largest)).max() <= 0.01 * largest
    assert largest == pytest.approx(np.percentile(np.abs(expected), 99.9))
    for name, expected in zip(("depth", "angle"), run.expected_errors("cube_no_texture"), strict=True):
        largest = scene["expected"][name]
        assert largest == pytest.approx(np.percentile(expected, 99.9))
        found = (picture(content, result["expected"][name]) / 255.0) ** 2 * largest
        assert np.abs(found - expected[0].clamp(max=largest).numpy()).max() <= 1.001 * largest / 255
    assert not any("mask" in each for each in (result, result["error"], result["expected"]))


def test_holes_of_a_result_are_masked_and_their_neighbours_have_no_normal(make_run, tmp_path):
    [run] = load_results([make_run(tmp_path / "run", confident=True)]).runs
    depth = run.prediction("cube_no_texture").clone()
    depth[0, 10, 20] = torch.nan
    depth_error, angle_error = run.expected_errors("cube_no_texture")
    depth_error[0, 3, 5] = torch.nan
    with_holes = changed(run, prediction=lambda _: depth, expected_errors=lambda _: (depth_error, angle_error))
    content, _, scene = saved(tmp_path, Results((with_holes,)))
    result = scene["surfaces"][1]
    for stored, missing in ((result, {(10, 20)}), (result["expected"], {(3, 5), (10, 20)})):
        mask = picture(content, stored["mask"])
        assert set(map(tuple, np.argwhere(mask == 0))) == missing
        assert set(map(tuple, np.argwhere(mask == 128))) == {(10, 19), (9, 20)}
    assert picture(content, result["error"]["mask"])[10, 20] == 0
    assert "mask" not in scene["surfaces"][2]


def test_calibration_compares_expected_and_measured_errors_of_all_scenes(make_run, tmp_path):
    make_run(tmp_path / "runs" / "plain", scenes=("a", "b"))
    make_run(tmp_path / "runs" / "sure", method="sure", label="Sure", scenes=("a", "b"), confident=True)
    results = load_results([tmp_path / "runs"])
    _, data, _ = saved(tmp_path, results)
    [row] = data["problems"][0]["calibration"]
    assert (row["method"], row["scenes"]) == ("Sure", 2)
    run = results.runs[-1]
    expected = np.concatenate([run.expected_errors(scene)[0].numpy().ravel() for scene in "ab"])
    measured = np.concatenate([(run.prediction(s) - run.sample(s).depth).abs().numpy().ravel() for s in "ab"])
    order = np.argsort(expected, kind="stable")
    ratios = [measured[part].mean() / expected[part].mean() for part in np.array_split(order, 10)]
    assert row["depth"]["ratios"] == pytest.approx(ratios, rel=1e-5)
    kept = order[: round(0.8 * len(order))]
    assert row["depth"]["share"] == pytest.approx((measured[kept] ** 2).sum() / (measured**2).sum(), rel=1e-5)
    best = np.sort(measured)[: len(kept)]
    assert row["depth"]["least"] == pytest.approx((best**2).sum() / (measured**2).sum(), rel=1e-5)
    assert len(row["angle"]["ratios"]) == 10


def test_large_pictures_are_reduced_and_the_page_says_so(make_run, tmp_path):
    workers = WorkerPool(load_results([make_run(tmp_path / "run", size=64)]))
    notes = save_page(tmp_path / "small.html", Pictures(workers, 20))
    assert notes[0].startswith("pictures: lossless, 8 bits, reduced to 20 pixels at most;")
    assert notes[0] in json.loads(blocks(tmp_path / "small.html")["data"])["notes"]
    assert json.loads(blocks(tmp_path / "small.html")["s0"])["surfaces"][1]["size"] == [16, 16]
    assert save_page(tmp_path / "large.html", Pictures(workers))[0].startswith("pictures: lossless, 8 bits;")


def test_reduced_values_are_averages_of_valid_pixels():
    store = PictureStore(2)
    values = torch.tensor([[1.0, 3, 5, np.nan], [1, 3, 7, 9], [np.nan, np.nan, 2, 2], [np.nan, 4, 2, 2]])
    fitted, known = store.fit(values[None])
    assert store.reduced
    assert fitted[known].ravel().tolist() == [2, 7, 2]
    assert known.tolist() == [[True, True], [False, True]]


def test_page_has_mean_and_standard_deviation_of_several_seeds(make_run, tmp_path):
    results = load_results([make_run(tmp_path / "runs" / str(seed), seed=seed) for seed in range(3)])
    scores = results.scores
    own = scores[scores["metric"] == "RMSE_d"]["value"] * 1000
    [problem] = saved(tmp_path, results)[1]["problems"]
    for row in (problem["means"][0], problem["rows"][0]):
        assert (row["seeds"], row["values"]["RMSE_d"]) == (3, pytest.approx([own.mean(), own.std()]))


def test_run_without_stored_scenes_has_tables_and_says_why_no_pictures(make_run, tmp_path):
    folder = make_run(tmp_path / "run")
    (folder / "scenes" / "cube_no_texture.npz").unlink()
    content, data, scene = saved(tmp_path, load_results([folder]))
    assert scene is None
    assert data["scenes"] == []
    assert data["problems"][0]["rows"]
    assert any("cube_no_texture x4 box: no pictures" in note for note in data["notes"])
    assert not any(name.startswith("p") for name in content)


def test_predictions_that_are_damaged_or_of_another_size_are_left_out_and_named(make_run, tmp_path):
    runs = [make_run(tmp_path / name, method=name, label=name) for name in ("a", "b", "c")]
    results = load_results(runs)
    (runs[1] / "predictions" / "cube_no_texture.npz").write_bytes(b"PK")
    np.savez(runs[2] / "predictions" / "cube_no_texture.npz", depth=np.ones((7, 24)), config="{}", seconds=1.0)
    _, data, scene = saved(tmp_path, results)
    assert [surface["label"] for surface in scene["surfaces"]] == ["input", "a", "truth"]
    for text in (f"{runs[1]}/predictions/cube_no_texture.npz: expected a prediction", "32 x 32 pixels, got 7 x 24"):
        assert any(text in note for note in data["notes"]), data["notes"]


# The standings


FORMATS = {
    "RMSE_d": MetricFormat("RMSE_d", "mm", 1e3, 1, position=1),
    **{name: MetricFormat(name, digits=2, higher_is_better=True, family="sharp") for name in ("F1", "F2", "F3")},
}


def run(label, values, dataset="mine"):
    return made_up_run(label, values, dataset=dataset, formats=FORMATS)


def test_families_weigh_the_same_and_directions_are_heard():
    near = run("Near", {"hall": {"RMSE_d": 0.01, "F1": 0.1, "F2": 0.1, "F3": 0.1}})
    sharp = run("Sharp", {"hall": {"RMSE_d": 0.02, "F1": 0.9, "F2": 0.9, "F3": 0.9}})
    rows = standings(Results((near, sharp)))
    assert [row["rank"] for row in rows] == [1.5, 1.5]
    assert rows[0]["values"]["RMSE_d"] == [pytest.approx(10)]


def test_method_without_a_setting_stands_last_and_without_means():
    one, two = (run(name, {"hall": {"RMSE_d": value}}) for name, value in (("One", 0.03), ("Two", 0.02)))
    more = run("One", {"lake": {"RMSE_d": 0.05}}, dataset="other")
    rows = standings(Results((one, two, more)))
    assert [(row["method"], row["settings"]) for row in rows] == [("One", 2), ("Two", 1)]
    assert rows[0]["values"]["RMSE_d"] == [pytest.approx(40)]
    assert rows[1]["values"] == {}
