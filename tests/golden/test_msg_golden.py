"""MSG and MSG-V with their authors' weights, against the disparity maps that the published networks give."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dsr.data.folder import Folder
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import from_range, to_range
from dsr.methods.images import upsample_bicubic
from dsr.methods.networks.msg_net import VariantName
from dsr.methods.networks.network import Precision
from dsr.methods.networks.trained import TrainedNetwork
from dsr.sample import DepthSample

FILES: dict[str, tuple[VariantName, str]] = {
    "msg_v": ("voynov", "msg_v_x{}_clean.pth"),
    "msg": ("hui", "MSGNet_x{}.caffemodel"),
}


def _sample(shared: Path, scene: str, scale: int) -> tuple[DepthSample, Tensor]:
    """Return the scene with its box-downsampled disparity (as depth), and the true disparity, (1, 512, 512)."""
    loaded = Folder(str(shared / "scenes"), [scene]).load(scene)
    assert loaded.depth is not None
    disparity = to_range(loaded.depth, loaded.camera, "disparity")
    return make_sample(loaded, scale, Downsampling("box"), "disparity"), disparity


def _upsampled(shared: Path, method: str, sample: DepthSample, precision: Precision = "float32") -> Tensor:
    """Return the method's disparity, (512, 512)."""
    variant, name = FILES[method]
    upsampler = TrainedNetwork(shared / "weights" / name.format(sample.scale), sample.scale, method, variant, precision)
    return to_range(upsampler(sample), sample.camera, "disparity")[0]


def _rmse_mm(sample: DepthSample, disparity: Tensor, truth: Tensor) -> float:
    """Return the RMS difference of perspective depths in mm, over the pixels that are covered."""
    lengths = sample.camera.ray_lengths()
    depths = (from_range(x, sample.camera, "disparity") * lengths for x in (disparity, truth))
    difference = 1000 * torch.sub(*depths)
    return float(difference[difference.isfinite()].square().mean().sqrt())


@pytest.mark.parametrize("scale", [4, 8])
@pytest.mark.parametrize("scene", ["lucy", "plant"])
@pytest.mark.parametrize("method", ["msg_v", "msg"])
def test_output_is_that_of_the_published_network(shared: Path, method: str, scene: str, scale: int) -> None:
    sample, _ = _sample(shared, scene, scale)
    expected = torch.from_numpy(np.load(shared / "expected" / f"{method}_{scene}_x{scale}.npy")).double()
    rows, columns = expected.shape
    ours = _upsampled(shared, method, sample)
    assert bool(ours[:rows, :columns].isfinite().all())
    assert int(ours.isfinite().sum()) == expected.numel()
    difference = (ours[:rows, :columns] - expected).abs().max() / (expected.max() - expected.min())
    assert float(difference) < 2e-5  # 7e-6 measured


@pytest.mark.parametrize("scale", [2, 16])
def test_other_published_networks_are_better_than_bicubic_too(shared: Path, scale: int) -> None:
    sample, truth = _sample(shared, "lucy", scale)
    bicubic = upsample_bicubic(functional.avg_pool2d(truth, scale)[None], scale)[0, 0]
    assert _rmse_mm(sample, _upsampled(shared, "msg", sample), truth[0]) < 0.9 * _rmse_mm(sample, bicubic, truth[0])


def test_network_trained_on_noise_loads_and_stays_near_the_truth(shared: Path) -> None:
    sample, truth = _sample(shared, "lucy", 4)
    upsampler = TrainedNetwork(shared / "weights" / "msg_v_x4_noise_std0.003.pth", 4, "msg_v", "voynov")
    assert _rmse_mm(sample, to_range(upsampler(sample), sample.camera, "disparity")[0], truth[0]) < 60


def test_bfloat16_changes_the_published_error_by_less_than_one_percent(shared: Path) -> None:
    sample, truth = _sample(shared, "lucy", 4)
    exact, rounded = (_upsampled(shared, "msg_v", sample, precision) for precision in ("float32", "bfloat16"))
    assert _rmse_mm(sample, exact, truth[0]) == pytest.approx(23.552, abs=0.001)
    assert _rmse_mm(sample, rounded, truth[0]) == pytest.approx(23.552, rel=0.01)
    span = float(truth.max() - truth.min())
    assert float((exact - rounded).square().mean().sqrt()) / span < 5e-4  # 2.2e-4 measured


def test_published_file_of_the_other_variant_or_scale_is_refused(shared: Path) -> None:
    with pytest.raises(ValueError, match="expected weights of variant voynov, got those of variant hui"):
        TrainedNetwork(shared / "weights" / "MSGNet_x4.caffemodel", 4, "msg_v", "voynov")
    with pytest.raises(ValueError, match="weights are for scale 8, the run is at scale 4"):
        TrainedNetwork(shared / "weights" / "msg_v_x8_clean.pth", 4, "msg_v", "voynov")
