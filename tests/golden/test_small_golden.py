"""Downsampling, interpolation and all metrics on a small scene of the project, against independent files."""

import json
from pathlib import Path

import numpy as np
import pytest
import small_golden
import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, to_range
from dsr.methods.classical.interpolation import Interpolation
from dsr.metrics.catalogue import catalogue, score_image
from dsr.sample import DepthSample, Scene

CAMERA = Camera(small_golden.SIZE, small_golden.SIZE, *small_golden.INTRINSICS)
LIGHTS = ("e1", "e2", "e3", "e4")
with np.load(small_golden.FOLDER / "maps.npz") as stored:
    MAPS = dict(stored)
METRICS = json.loads((small_golden.FOLDER / "metrics.json").read_text(encoding="utf-8"))


def _depth(name: str) -> Tensor:
    return torch.from_numpy(MAPS[name].astype(np.float64))[None]


def _sample(scale: int) -> DepthSample:
    rgb = torch.from_numpy(MAPS["rgb"]).permute(2, 0, 1) / 255
    scene = Scene("golden", "small", rgb, CAMERA, _depth("depth"))
    return make_sample(scene, scale, Downsampling("box"), "perspective")


@pytest.mark.parametrize("scale", [4, 8])
def test_box_downsampling_equals_the_golden_map(scale: int) -> None:
    sample = _sample(scale)
    perspective = to_range(sample.depth_lr, sample.camera_lr, "perspective")
    np.testing.assert_allclose(perspective[0].numpy(), MAPS[f"perspective_x{scale}"], rtol=1e-12)


@pytest.mark.parametrize("scale", [4, 8])
def test_bicubic_equals_the_golden_map(scale: int) -> None:
    result = Interpolation("bicubic")(_sample(scale))
    np.testing.assert_allclose(result[0].numpy(), MAPS[f"bicubic_x{scale}"], rtol=1e-6)


@pytest.mark.parametrize("name", METRICS)
def test_metrics_equal_the_golden_file(name: str) -> None:
    scores = list(score_image(_depth(name), _depth("depth"), CAMERA.rays(), catalogue()))
    values = {(score.metric, score.variant): score.value for score in scores}
    for metric, expected in METRICS[name].items():
        if not isinstance(expected, list):
            assert values[metric, ""] == pytest.approx(expected, rel=1e-4), metric
            continue
        variants = dict(zip(LIGHTS, expected, strict=True)) | {"max": max(expected), "avg": sum(expected) / 4}
        for variant, number in variants.items():
            assert values[metric, variant] == pytest.approx(number, rel=1e-4), (metric, variant)
    complete = float(np.isfinite(MAPS[name]).mean())
    [share] = [score.valid_share for score in scores if score.metric == "RMSE_d"]
    assert share == pytest.approx(complete)


def test_golden_files_are_those_of_their_script(tmp_path: Path) -> None:
    small_golden.write(tmp_path)
    with np.load(tmp_path / "maps.npz") as again:
        assert set(again) == set(MAPS)
        for name, values in again.items():
            np.testing.assert_allclose(values, MAPS[name], rtol=1e-6)
    written = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    for name, scores in written.items():
        for metric, value in scores.items():
            assert value == pytest.approx(METRICS[name][metric], rel=1e-6), (name, metric)
