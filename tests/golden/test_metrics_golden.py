"""All metrics of bicubic interpolation and of the published networks' maps, against independently computed values.

``expected/metrics.json`` was computed by other code than ours, from the same protocol.
"""

import json

import numpy as np
import pytest
import torch

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import from_range
from dsr.methods.classical.interpolation import Interpolation
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.formats import in_tables
from dsr.report.paper import published_row

METHODS = {"Bicubic": None, "MSG-V": "msg_v", "MSG": "msg"}
COVERED = {"Bicubic": 512, "MSG-V": 512, "MSG": 511}
LIGHTS = ("e1", "e2", "e3", "e4")
EVERY_CASE = [pytest.param(*case, marks=pytest.mark.nightly) for case in (("lucy", 8), ("plant", 4))]
EVERY_CASE += [("lucy", 4), ("plant", 8)]


def _prediction(shared, scene, method, scale):
    """Return the method's high-resolution depth; MSG's published networks leave out the last row and column."""
    stem = METHODS[method]
    if stem is None:
        return Interpolation("bicubic")(make_sample(scene, scale, Downsampling("box"), Interpolation.range_type))
    stored = torch.from_numpy(np.load(shared / "expected" / f"{stem}_{scene.name}_x{scale}.npy").astype(np.float64))
    disparity = torch.full((1, 512, 512), torch.nan, dtype=torch.float64)
    disparity[0, : stored.shape[0], : stored.shape[1]] = stored
    return from_range(disparity, scene.camera, "disparity")


@pytest.mark.parametrize(("scene", "scale"), EVERY_CASE)
@pytest.mark.parametrize("method", METHODS)
def test_metrics_equal_the_golden_file(shared, load_scene, network, method, scene, scale):
    expected = json.loads((shared / "expected" / "metrics.json").read_text())[scene][f"x{scale}"][method]
    loaded = load_scene(scene)
    prediction = _prediction(shared, loaded, method, scale)
    scores = score_image(prediction, loaded.depth, loaded.camera.rays(), catalogue(network))
    rows = {(score.metric, score.variant): score for score in scores}
    for name, value in expected.items():
        variants = {"": value}
        if isinstance(value, list):
            variants = dict(zip(LIGHTS, value, strict=True)) | {"max": max(value), "avg": sum(value) / 4}
        for variant, number in variants.items():
            tolerance = 1e-3 if name == "LPIPS_v" else 1e-4
            assert rows[name, variant].value == pytest.approx(number, rel=tolerance), (name, variant)
    assert {round(row.valid_share, 9) for row in rows.values()} == {round((COVERED[method] / 512) ** 2, 9)}


@pytest.mark.parametrize(("scene", "scale"), [("lucy", 4), ("plant", 8)])
def test_interpolation_over_triangles_has_the_papers_scores_of_bicubic(load_scene, network, scene, scale):
    loaded = load_scene(scene)
    sample = make_sample(loaded, scale, Downsampling("box"), Interpolation.range_type)
    scores = score_image(Interpolation("clough_tocher")(sample), loaded.depth, loaded.camera.rays(), catalogue(network))
    paper = published_row(scene, "Bicubic", scale)
    formats = in_tables({metric.name: metric.format for metric in catalogue(network)})
    found = {row.metric: formats[row.metric].factor * row.value for row in scores
             if row.metric in formats and row.variant in ("", "max")}  # fmt: skip
    compared = {name: value for name, value in found.items() if name in paper}
    assert len(compared) == 7
    assert compared == pytest.approx({name: float(paper[name]) for name in compared}, rel=0.015)
