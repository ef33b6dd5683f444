"""MSG and MSG-V with their authors' weights, against the disparity maps that the published networks give."""

import numpy as np
import pytest
import torch

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import from_range, to_range
from dsr.methods.networks.trained import TrainedNetwork

FILES = {
    "msg_v": ("voynov", "msg_v_x{}_clean.pth"),
    "msg": ("hui", "MSGNet_x{}.caffemodel"),
}


def _sample(scene, scale):
    """Return the scene with its box-downsampled disparity (as depth), and the true disparity, (1, 512, 512)."""
    sample = make_sample(scene, scale, Downsampling("box"), "disparity")
    return sample, to_range(scene.depth, scene.camera, "disparity")


def _upsampled(shared, method, sample, precision="float32"):
    """Return the method's disparity, (512, 512)."""
    variant, name = FILES[method]
    upsampler = TrainedNetwork(shared / "weights" / name.format(sample.scale), sample.scale, method, variant, precision)
    return to_range(upsampler(sample), sample.camera, "disparity")[0]


def _rmse_mm(sample, disparity, truth):
    """Return the RMS difference of perspective depths in mm, over the pixels that are covered."""
    lengths = sample.camera.ray_lengths()
    depths = (from_range(x, sample.camera, "disparity") * lengths for x in (disparity, truth))
    difference = 1000 * torch.sub(*depths)
    return float(difference[difference.isfinite()].square().mean().sqrt())


@pytest.mark.parametrize(
    ("scene", "scale"),
    [
        ("lucy", 4),
        ("plant", 8),
        *(pytest.param(*case, marks=pytest.mark.nightly) for case in (("lucy", 8), ("plant", 4))),
    ],
)
@pytest.mark.parametrize("method", ["msg_v", "msg"])
def test_output_is_that_of_the_published_network(shared, load_scene, method, scene, scale):
    sample, _ = _sample(load_scene(scene), scale)
    expected = torch.from_numpy(np.load(shared / "expected" / f"{method}_{scene}_x{scale}.npy")).double()
    rows, columns = expected.shape
    ours = _upsampled(shared, method, sample)
    assert bool(ours[:rows, :columns].isfinite().all())
    assert int(ours.isfinite().sum()) == expected.numel()
    difference = (ours[:rows, :columns] - expected).abs().max() / (expected.max() - expected.min())
    assert float(difference) < 2e-5  # 7e-6 measured


def test_bfloat16_changes_the_published_error_by_less_than_one_percent(shared, load_scene):
    sample, truth = _sample(load_scene("lucy"), 4)
    exact, rounded = (_upsampled(shared, "msg_v", sample, precision) for precision in ("float32", "bfloat16"))
    assert _rmse_mm(sample, exact, truth[0]) == pytest.approx(23.552, abs=0.001)
    assert _rmse_mm(sample, rounded, truth[0]) == pytest.approx(23.552, rel=0.01)
    span = float(truth.max() - truth.min())
    assert float((exact - rounded).square().mean().sqrt()) / span < 5e-4  # 2.2e-4 measured
