"""Cubic convolution, against Pillow's bicubic interpolation, with holes and in each range type."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.methods.classical.interpolation import CubicConvolution
from dsr.sample import DepthSample, Scene

CAMERA = Camera(48, 40, 50.0, 50.0, 22.0, 21.0, baseline=0.3, doffs=4.0)


def _sample(range_type: RangeType, scale: int, kernel: str = "bicubic") -> DepthSample:
    depth = torch.from_numpy(1 + np.random.default_rng(0).random((1, 40, 48)))
    scene = Scene("set", "random", torch.zeros(3, 40, 48), CAMERA, depth)
    return make_sample(scene, scale, Downsampling(kernel), range_type)  # type: ignore[arg-type]


def _pillow(values: torch.Tensor, height: int, width: int) -> np.ndarray:
    image = Image.fromarray(values[0].numpy().astype(np.float32))
    return np.array(image.resize((width, height), Image.Resampling.BICUBIC))


@pytest.mark.parametrize("scale", [2, 4, 8])
@pytest.mark.parametrize("range_type", ["disparity", "orthogonal"])
def test_down_and_up_is_pillows_bicubic(range_type: RangeType, scale: int) -> None:
    sample = _sample(range_type, scale)
    assert sample.depth is not None
    true = to_range(sample.depth, CAMERA, range_type)
    small = _pillow(true, 40 // scale, 48 // scale)
    found = to_range(CubicConvolution(range_type)(sample), CAMERA, range_type)[0].numpy()
    np.testing.assert_allclose(found, _pillow(torch.from_numpy(small)[None], 40, 48), rtol=2e-5)


def test_perspective_depth_is_interpolated_along_the_rays() -> None:
    sample = _sample("perspective", 4)
    small = to_range(sample.depth_lr, sample.camera_lr, "perspective")
    found = to_range(CubicConvolution("perspective")(sample), CAMERA, "perspective")[0].numpy()
    np.testing.assert_allclose(found, _pillow(small, 40, 48), rtol=2e-5)


def test_pixels_are_matched_through_the_cameras() -> None:
    camera = Camera(48, 40, 50.0, 50.0, 22.0, 21.0)
    slope = (2 + 0.01 * torch.arange(48, dtype=torch.float64)).repeat(1, 40, 1)
    scene = Scene("set", "slope", torch.zeros(3, 40, 48), camera, slope)
    found = CubicConvolution("orthogonal")(make_sample(scene, 4, Downsampling("nearest"), "orthogonal"))
    torch.testing.assert_close(found[..., 8:-8], slope[..., 8:-8])


def test_hole_stays_a_hole_and_does_not_spread() -> None:
    sample = _sample("orthogonal", 4)
    flat = torch.full_like(sample.depth_lr, 2.0)
    flat[0, 4, 5] = torch.nan
    found = CubicConvolution()(DepthSample(**{**vars(sample), "depth_lr": flat}))
    holes = torch.zeros(1, 40, 48, dtype=torch.bool)
    holes[0, 16:20, 20:24] = True
    assert torch.equal(found.isnan(), holes)
    torch.testing.assert_close(found[~holes], torch.full((1920 - 16,), 2.0, dtype=torch.float64))


def test_disparity_below_infinity_is_a_hole() -> None:
    sample = _sample("disparity", 4)
    far = from_range(torch.full((1, 10, 12), -0.999, dtype=torch.float64), sample.camera_lr, "disparity")
    far[0, 5, 5] = 1.0
    found = CubicConvolution()(DepthSample(**{**vars(sample), "depth_lr": far}))
    assert 0 < int(found.isnan().sum()) < 800
    assert bool((found[found.isfinite()] > 0).all())


def test_unknown_range_type_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"^range_type: expected one of orthogonal, perspective, disparity, got 'depth'$"
    ):
        CubicConvolution("depth")  # type: ignore[arg-type]


def test_map_of_the_photos_own_size_is_returned_and_any_ratio_is_taken() -> None:
    depth = torch.from_numpy(1 + np.random.default_rng(0).random((1, 40, 48)))
    sample = DepthSample("set", "random", torch.zeros(3, 40, 48), depth, CAMERA, CAMERA, 1)
    torch.testing.assert_close(CubicConvolution("orthogonal")(sample), depth)
    small = CAMERA.rescale(18, 15)
    sample = DepthSample("set", "random", torch.zeros(3, 40, 48), depth[:, :15, :18], CAMERA, small, 48 / 18)
    expected = _pillow(depth[:, :15, :18], 40, 48)
    np.testing.assert_allclose(CubicConvolution("orthogonal")(sample)[0].numpy(), expected, rtol=2e-5)
