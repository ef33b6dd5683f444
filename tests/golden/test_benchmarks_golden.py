"""The protocols of real sensors and of the field's benchmarks, through the data sets, against independent figures.

``expected/real_sensor.json`` and ``expected/peers.csv`` were computed by other code than ours.
"""

import csv
import json
from functools import cache

import cv2
import numpy as np
import pytest
import torch

from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.eight_bit import EightBit
from dsr.data.rgbdd import RGBDD
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.classical.interpolation import CubicConvolution
from dsr.methods.recipe import read_recipe
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.formats import HEADLINES

FRAMES = ("frame_000001", "frame_000011")
SENSOR_UNITS = {
    "Sensor_covered": ("covered", 1), "Sensor_offset": ("offset_mm", 1e3), "Sensor_RMSE_d": ("RMSE_d_mm", 1e3),
    "Sensor_RMSE_v": ("RMSE_v", 1), "Sensor_DSSIM_v": ("DSSIM_v", 1), "Sensor_angle_mean": ("angle_mean", 1),
    "Sensor_angle_median": ("angle_median", 1),
}  # fmt: skip
IMAGES = {
    "Middlebury": ("Middlebury_01", "Middlebury_18"),
    "Lu": ("RGBD_03",),
    "RGBDD": ("20200509112638", "20200720133636"),
}  # A few images of each benchmark; ``experiment=field_benchmarks`` evaluates all


@pytest.mark.parametrize("frame", FRAMES)
def test_sensor_scores_equal_the_golden_file(shared, frame):
    expected = json.loads((shared / "expected" / "real_sensor.json").read_text())["frames"][frame]
    scene = DDRNetFrames(str(shared / "real" / "ddrnet"), "found").load(frame)
    raw = scene.measured[1]
    filtered = cv2.bilateralFilter(raw[0].nan_to_num(0).float().numpy(), 19, 0.03, 3).astype(np.float64)
    maps = {"input": raw, "bilateral_19_0.03_3": torch.from_numpy(np.where(filtered > 0, filtered, np.nan))[None]}
    for name, depth in maps.items():
        rows = score_image(depth.double(), scene.depth, scene.camera.rays(), catalogue(protocols=("sensor",)))
        found = {row.metric: row.value for row in rows if row.variant in HEADLINES}
        assert found.keys() == SENSOR_UNITS.keys()
        shown = {key: factor * found[metric] for metric, (key, factor) in SENSOR_UNITS.items()}
        assert shown == pytest.approx(expected[name], rel=1e-3, abs=1e-5), name


@cache
def _published(shared, benchmark, method, scale):
    """Return the RMSE of each image, by its name."""
    part = (f"protocol:{benchmark}", method, str(scale), "pillow-bicubic", "RMSE")
    with (shared / "expected" / "peers.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if (row[0], row[1], *row[3:6]) == part]
    return {row[2].partition("_output")[0].partition("_HR")[0]: float(row[6]) for row in rows}


def _source(shared, benchmark, images):
    """Return a benchmark's images, and the range type that it downsamples."""
    root = str(shared / "modern" / benchmark)
    if benchmark == "RGBDD":
        return RGBDD(root, real=False, scenes=images), "orthogonal"
    return EightBit(root, "lu" if benchmark == "Lu" else "middlebury8", images), "disparity"


def _rmse(source, kind, method, scale):
    """Return the RMSE of each image in the benchmark's unit."""
    found = {}
    for name in source.scenes():
        sample = make_sample(source.load(name), scale, Downsampling("bicubic"), kind)
        maps, metrics = (method(sample).double(), sample.depth.double()), catalogue(protocols=("field",))
        rows = score_image(*maps, sample.camera.rays(), metrics, sample.unit)
        found[name] = next(row.value for row in rows if row.metric in ("RMSE_levels", "RMSE_cm"))
    return found


@pytest.mark.parametrize("scale", [4, 8])
@pytest.mark.parametrize("benchmark", IMAGES)
def test_bicubic_has_the_errors_of_the_fields_protocol(shared, benchmark, scale):
    source, kind = _source(shared, benchmark, IMAGES[benchmark])
    published = _published(shared, benchmark, "bicubic", scale)
    expected = {name: published[name] for name in IMAGES[benchmark]}
    assert _rmse(source, kind, CubicConvolution(kind), scale) == pytest.approx(expected, rel=1e-3)


def test_network_has_its_authors_errors_with_the_true_range(shared):
    source, kind = _source(shared, "Lu", ("RGBD_03",))
    recipe = read_recipe("dctnet", {"range": "truth", "range_type": kind})
    upsampler = recipe.with_weights(shared / "weights" / "peers").build(8)  # at 4 its depth is in test_peers_golden
    assert upsampler.flag == "true-range"
    expected = {"RGBD_03": _published(shared, "Lu", "DCTNet", 8)["RGBD_03"]}
    assert _rmse(source, kind, upsampler, 8) == pytest.approx(expected, rel=1e-4)
