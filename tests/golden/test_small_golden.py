"""Downsampling, interpolation and all metrics on a small scene of the project, against independent computations.

What is expected is computed by NumPy, SciPy and scikit-image, nothing by the package: block means, the spline through
these, and the metrics of :mod:`reference_metrics`.
"""

import numpy as np
import pytest
import torch
from reference_metrics import Reference
from scipy import ndimage
from small_golden import INTRINSICS, SIZE, trace

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, to_range
from dsr.methods.classical.interpolation import Interpolation
from dsr.metrics.catalogue import catalogue, score_image
from dsr.sample import Scene

CAMERA = Camera(SIZE, SIZE, *INTRINSICS)
LENGTHS = np.linalg.norm(INTRINSICS.rays(SIZE, SIZE), axis=-1)
DEPTH, _ = trace()
LIGHTS = ("e1", "e2", "e3", "e4")


def block_means(scale):
    """Return the low-resolution perspective depth: means over blocks."""
    blocks = (DEPTH.astype(np.float64) * LENGTHS).reshape(SIZE // scale, scale, SIZE // scale, scale)
    return blocks.mean(axis=(1, 3))


def bicubic(scale):
    """Return the orthogonal depth of the cubic spline through perspective depths."""
    perspective = ndimage.zoom(block_means(scale), scale, order=3, grid_mode=True, mode="nearest")
    return (perspective / LENGTHS).astype(np.float32)


def incomplete():
    """Return the depth with noise, single holes and a larger one."""
    random = np.random.default_rng(0)
    depth = (DEPTH + 0.01 * random.normal(size=DEPTH.shape)).astype(np.float32)
    depth[random.random(DEPTH.shape) < 0.02] = np.nan
    depth[20:27, 30:36] = np.nan
    return depth


@pytest.mark.parametrize("scale", [4, 8])
def test_box_downsampling_and_bicubic_are_block_means_and_their_spline(scale):
    scene = Scene("golden", "small", torch.zeros(3, SIZE, SIZE), CAMERA, torch.from_numpy(DEPTH).double()[None])
    sample = make_sample(scene, scale, Downsampling("box"), "perspective")
    perspective = to_range(sample.depth_lr, sample.camera_lr, "perspective")
    np.testing.assert_allclose(perspective[0].numpy(), block_means(scale), rtol=1e-12)
    np.testing.assert_allclose(Interpolation("bicubic")(sample)[0].numpy(), bicubic(scale), rtol=1e-6)


@pytest.mark.parametrize("made", [lambda: bicubic(4), lambda: bicubic(8), incomplete], ids=["x4", "x8", "incomplete"])
def test_metrics_are_those_of_the_reference(made):
    prediction, target = made().astype(np.float64), DEPTH.astype(np.float64)
    scores = list(score_image(*(torch.from_numpy(each)[None] for each in (prediction, target)), CAMERA.rays(),
                              catalogue()))  # fmt: skip
    values = {(score.metric, score.variant): score.value for score in scores}
    for metric, expected in Reference(prediction, target, INTRINSICS).all_metrics().items():
        if not isinstance(expected, list):
            assert values[metric, ""] == pytest.approx(expected, rel=1e-4), metric
            continue
        variants = dict(zip(LIGHTS, expected, strict=True)) | {"max": max(expected), "avg": sum(expected) / 4}
        for variant, number in variants.items():
            assert values[metric, variant] == pytest.approx(number, rel=1e-4), (metric, variant)
    [share] = [score.valid_share for score in scores if score.metric == "RMSE_d"]
    assert share == pytest.approx(float(np.isfinite(prediction).mean()))
