"""DIP-V on a part of the paper's Lucy, in few steps."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.dip.upsampler import DeepImagePrior
from dsr.metrics.functional import SurfacePair, dssim_v, rmse_d, rmse_v
from dsr.sample import DepthSample
from dsr.utils.compute_device import fast_precision

BOX = Downsampling("box")


@pytest.fixture(scope="module")
def sample(shared: Path) -> DepthSample:
    """Rows 112:176, columns 200:264, at x4."""
    whole = Folder(str(shared / "scenes"), ["lucy"]).load("lucy")
    return make_sample(replace(whole.crop(112, 200, 64, 64), dataset="crop"), 4, BOX, "orthogonal")


def _scores(depth: Tensor, sample: DepthSample) -> dict[str, float]:
    assert sample.depth is not None
    pair = SurfacePair(depth[None], sample.depth[None], sample.camera.rays()[None])
    return {
        "RMSE_d": float(rmse_d(pair)),
        "RMSE_v": float(rmse_v(pair)),
        "DSSIM_v": float(dssim_v(pair).max()),
    }


def test_dip_v_is_better_than_bicubic_in_depth_and_in_looks(sample: DepthSample) -> None:
    bicubic = _scores(Interpolation("bicubic")(sample), sample)
    precision = fast_precision(torch.device("cpu"))
    prior = DeepImagePrior(scale=4, downsampling=BOX, steps=120, average=0.96, validate_every=0, precision=precision)
    ours = _scores(prior(sample), sample)
    assert ours["RMSE_v"] < 0.85 * bicubic["RMSE_v"]
    assert ours["RMSE_d"] < 0.9 * bicubic["RMSE_d"]
    assert ours["DSSIM_v"] < bicubic["DSSIM_v"]
