"""Situations that people reported of programs like this one, each with the values that must come out."""

from __future__ import annotations

import re
import shutil
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import dsr
from dsr.cli import main
from dsr.data import detection
from dsr.evaluation.run_files import load_results
from dsr.metrics.boundaries import METRICS
from dsr.metrics.catalogue import score_image
from dsr.report.leaderboard import standings
from dsr.report.page.content import problem_data
from dsr.report.tables import build_tables
from dsr.utils import versions

WIDTH, HEIGHT, FOCAL = 320, 240, 288.0
CAMERA = ["--intrinsics", "288", "288", "159.5", "119.5"]


def scene(width=WIDTH, height=HEIGHT, focal=FOCAL, shift=0.0):
    """Return the exact depth (height, width) in metres and the photo (height, width, 3), uint8 RGB.

    A chequered slanted wall with a box and a ball in front of it, seen by a camera ``shift`` metres to the right.
    """
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    depth = (3.2 - 0.15 * shift) / (1 + 0.15 * x)
    squares = np.floor(4 * (shift + x * depth)) + np.floor(4 * y * depth)
    photo = np.stack([150 + 50 * (squares % 2)] * 3, -1) * (1.0, 0.9, 0.75)
    box = (np.abs(shift + 1.7 * x + 0.6) < 0.3) & (np.abs(1.7 * y - 0.2) < 0.4)
    depth, photo = np.where(box, 1.7, depth), np.where(box[..., None], (60, 90, 200), photo)
    centre, radius = np.array([0.45 - shift, 0.3, 2.0]), 0.45
    along = x * centre[0] + y * centre[1] + centre[2]
    norm = x * x + y * y + 1
    root = along**2 - norm * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(root, 0))) / norm
    depth, photo = np.where(root > 0, near, depth), np.where((root > 0)[..., None], (220, 60, 50), photo)
    return depth, photo.astype(np.uint8)


def coarse(depth, by=4):
    """Return the means of squares of ``by`` pixels."""
    height, width = depth.shape
    return depth.reshape(height // by, by, width // by, by).mean((1, 3))


def millimetres(depth):
    return np.round(1000 * depth).astype(np.uint16)


def write(path: Path, picture):
    """Write a depth map, or a photo in RGB, in the format that the name has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)
    return path


def upsample(out: Path, *options, method="bicubic"):
    """Run ``dsr upsample`` and return its exit code."""
    return main(["upsample", *map(str, options), "-o", str(out), "--method", method, "--only", "depth"])


def mean_error(out: Path, truth):
    """Return the mean absolute error in millimetres of the pixels that both know, and the known fraction."""
    depth = cv2.imread(str(next(out.rglob("depth_metres.tiff"))), cv2.IMREAD_UNCHANGED)
    assert depth.shape == truth.shape
    known = np.isfinite(depth) & np.isfinite(truth)
    return 1000 * np.abs(depth - truth)[known].mean(), np.isfinite(depth).mean()


@pytest.mark.parametrize(
    ("runs", "shared", "seeds"),
    [
        ([("One", 0, "abc"), ("One", 0, "ab"), ("Two", 0, "ab")], "ab", 1),
        ([("One", 0, "ab"), ("One", 1, "abc"), ("Two", 0, "abc")], "abc", 1),
        ([("One", 0, "ab"), ("One", 1, "abc"), ("Two", 0, "ab")], "ab", 2),
        ([("One", 0, "ab"), ("One", 1, "bc"), ("Two", 0, "bc")], "bc", 1),
        ([("One", 0, "a"), ("Two", 0, "bc")], "", 1),
    ],
)
def test_report_averages_over_the_scenes_that_all_methods_have(make_run, tmp_path, runs, shared, seeds):
    for number, (label, seed, scenes) in enumerate(runs):
        make_run(tmp_path / str(number), label=label, seed=seed, scenes=tuple(scenes))
    results = load_results([tmp_path])
    page = problem_data(results, results.problems()[0])
    average = build_tables(results)[-1].groups[-1]
    for method, mean, row in zip(("One", "Two"), page["means"], average.rows, strict=True):
        own = {each["scene"]: each["values"]["RMSE_d"][0] for each in page["rows"] if each["method"] == method}
        cell = row.cells["RMSE_d"]
        assert mean["counts"].get("RMSE_d", len(page["scenes"])) == cell.scenes == len(shared)
        assert mean["seeds"] == row.seeds == (seeds if method == "One" else 1)
        assert (cell.spread is None) == (row.seeds == 1)
        if shared:
            expected = pytest.approx(np.mean([own[scene] for scene in shared]))
            [place] = [each for each in standings(results) if each["method"] == method]
            assert mean["values"]["RMSE_d"][0] == cell.mean == place["values"]["RMSE_d"][0] == expected
        else:
            assert mean["values"] == {}


def test_nobody_is_sent_to_the_dsr_of_pypi(monkeypatch):
    root = Path(__file__).resolve().parents[2]
    texts = [path for name in ("src", "conf", "docs") for path in (root / name).rglob("*.[pym][yda]*")]
    found = [str(path) for path in (*texts, root / "README.md") if re.search(r"\bdsr\[[a-z]+[],]", path.read_text())]
    assert len(texts) > 400
    assert found == []
    name = tomllib.loads((root / "pyproject.toml").read_text())["project"]["name"]
    assert (name, distribution(name).version) == (versions.DISTRIBUTION, versions.package_versions()["dsr"])
    assert versions.how_to_install("mesh") == "pip install -e '.[mesh]' in a checkout"
    monkeypatch.setattr(versions, "__file__", "/site-packages/dsr/utils/versions.py")
    assert versions.how_to_install("onnx") == f"pip install '{name}[onnx]'"


def test_make_benchmark_runs_the_scripts_that_need_no_arguments():
    root = Path(__file__).resolve().parents[2]
    [names] = re.findall(r"for name in ([\w ]+); do \$\(BIN\)/python benchmarks/", (root / "Makefile").read_text())
    ratios = (root / "docs/speed.md").read_text().partition("## Ratios")[2].partition("\n## ")[0]
    assert set(names.split()) == set(re.findall(r"benchmarks/(\w+)_speed\.py", ratios))
    texts = [(root / f"benchmarks/{name}_speed.py").read_text() for name in names.split()]
    assert not any("required=True" in text for text in texts)


def test_doctor_knows_every_data_set_of_recorded_scenes(shared, tmp_path):
    root = Path(__file__).resolve().parents[2]
    known = {name for *_, name in detection._FRAMES}
    own = {"folder", "simgeo", "procedural", "mixture", "paper_train", "rgbdd_real"}  # of the user, rendered, of others
    choices = {path.stem for path in (root / "conf/dataset").glob("*.yaml") if not path.stem.startswith("middlebury")}
    assert choices - own <= known
    board = shared / "real/stereo_board"
    assert [name for name, _ in detection.find_scenes(board)] == ["8", "14", "19", "25", "31"]
    for folder in ("color", "depth"):  # a recording of somebody else
        (tmp_path / folder).mkdir()
        shutil.copy(board / folder / "14.png", tmp_path / folder / "8.png")
    write(tmp_path / "color/8.png", np.zeros((1080, 1920, 3), np.uint8))
    assert list(detection.find_scenes(tmp_path)) == []


def boundary_errors(prediction, truth, edges=None):
    """Return accuracy and completeness of depth boundaries as eval.py scores them."""
    maps = [torch.from_numpy(each)[None] for each in (prediction, truth)]
    regions = {} if edges is None else {"edges": torch.from_numpy(edges.astype(np.uint8))[None]}
    rays = dsr.Camera.from_fov(60, width=WIDTH, height=HEIGHT).rays()
    found = {each.metric: each.value for each in score_image(*maps, rays, METRICS, regions=regions)}
    return found["DBE_accuracy"], found["DBE_completeness"]


def test_boundary_errors_are_to_the_annotated_boundaries():
    """Executed: ``compute_depth_boundary_error`` of Koch's v0.9 in bulatko/DepthART b2bc093, 0 for holes."""
    truth, _ = scene()
    prediction = cv2.resize(coarse(truth), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    edges = np.zeros(truth.shape, bool)
    edges[:, 1:] = np.abs(np.diff(truth)) > 0.4
    edges[60, 20:200] = edges[60:200, 200] = True  # a picture on the wall
    assert boundary_errors(prediction, truth, edges) == pytest.approx((1.0701604531461808, 11.598171099980945))
    truth[:40], prediction[60:180, 60:140] = np.nan, np.nan
    assert boundary_errors(prediction, truth, edges) == pytest.approx((1.0172272469100552, 19.141785662587306))
    band = cv2.dilate(edges.astype(np.uint8), np.ones((9, 9), np.uint8))  # about outlines, as that of ClearGrasp
    for others in (band, np.zeros_like(edges)):
        assert boundary_errors(prediction, truth, others) == boundary_errors(prediction, truth)
