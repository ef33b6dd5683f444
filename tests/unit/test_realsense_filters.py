"""RealSense's filters are those of its SDK, to a fraction of a disparity step."""

import numpy as np
import pytest
import realsense_sdk
import torch

from dsr.geometry.camera import Camera
from dsr.methods.classical.realsense import RealSense, fill_from_farthest, filter_frames, filter_lines
from dsr.sample import DepthSample

CONSTANT = 32 * realsense_sdk.FOCAL * realsense_sdk.BASELINE
STEP = 0.01  # Of disparity; the SDK computes in float32


def _in_metres(frames):
    depth = torch.from_numpy(frames * realsense_sdk.UNIT)
    return depth.masked_fill(depth == 0, torch.nan)


def _expect_like(results, frames):
    """Compare each filter's result, NaN in holes, with the SDK's, 0 in holes."""
    temporal = filter_frames(filter_lines(CONSTANT / _in_metres(frames)))
    filled = fill_from_farthest(CONSTANT / temporal) / realsense_sdk.UNIT
    for name, ours, tolerance in (("temporal", temporal, STEP), ("filled", filled, 0.501)):
        assert 0 < (results[name] == 0).mean() < 0.5
        np.testing.assert_allclose(ours.nan_to_num(0).numpy(), results[name], rtol=0, atol=tolerance, err_msg=name)


def test_filters_over_lines_and_frames_and_of_holes_are_the_sdks():
    results = dict(np.load(realsense_sdk.FILE))
    _expect_like(results, results["frames"])


def test_sdk_itself_agrees_on_other_frames():
    pytest.importorskip("pyrealsense2", reason="RealSense's SDK is not installed", exc_type=ImportError)
    frames = realsense_sdk.frames()[::-1, ::-1]
    _expect_like(realsense_sdk.run(frames), frames)


@pytest.mark.parametrize("scale", [1, 2])
def test_method_is_the_first_frames_result_by_the_baseline_of_the_camera_or_its_own(scale):
    """At x2 the map is interpolated, so that what is compared lies on its pixels."""
    results = dict(np.load(realsense_sdk.FILE))
    camera_lr = Camera.centred(48, 32, realsense_sdk.FOCAL)
    camera = camera_lr.rescale(48 * scale, 32 * scale)
    photo = torch.zeros(3, camera.height, camera.width)
    sample = DepthSample("set", "hall", photo, _in_metres(results["frames"][:1]), camera, camera_lr, scale)
    known = torch.from_numpy(results["filled"][0] > 0)
    found = RealSense()(sample)
    assert bool(found.isfinite().all())
    if scale == 1:
        expected = _in_metres(results["filled"][0])
        torch.testing.assert_close(found[0][known], expected[known], rtol=0, atol=0.00051)
    holes = RealSense(fill_holes=False)(sample)[0, ::scale, ::scale].isnan()
    assert torch.equal(holes, torch.from_numpy(results["frames"][0] == 0))
    assert not torch.equal(found, RealSense(baseline=0.5)(sample))  # so that fewer neighbours are alike
