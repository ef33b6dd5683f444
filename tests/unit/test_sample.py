"""The records' checks: each says whose value is wrong, what was expected and what came."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, baseline_times_focal
from dsr.sample import DepthSample, Scene, Unit

CAMERA = Camera(width=8, height=4, fx=9.0, fy=9.0, cx=3.5, cy=1.5)


def _scene(**changes):
    fields = {"dataset": "set", "name": "hall", "rgb": torch.rand(3, 4, 8), "camera": CAMERA}
    return Scene(**(fields | {"depth": torch.full((1, 4, 8), 2.0)} | changes))


def _sample(**changes):
    fields = {
        "dataset": "set",
        "scene": "hall",
        "rgb": torch.rand(3, 4, 8),
        "depth_lr": torch.full((1, 2, 4), 2.0),
        "camera": CAMERA,
        "camera_lr": CAMERA.rescale(4, 2),
        "scale": 2,
        "depth": torch.full((1, 4, 8), 2.0),
    }
    return DepthSample(**(fields | changes))


def _with(shape, value):
    depth = torch.full(shape, 2.0)
    depth[0, 1, 2] = value
    return depth


def test_valid_records_are_accepted_with_holes_and_without_truth():
    _scene(depth=_with((1, 4, 8), torch.nan))
    _scene(depth=None, measured={2: torch.ones(1, 2, 4), 4: torch.ones(1, 1, 2).double()})
    sample = _sample(depth=None, depth_lr=_with((1, 2, 4), torch.nan), scale=2.0)
    assert sample.notes == ()
    assert isinstance(sample.scale, int)
    assert isinstance(*_scene(measured={2.0: torch.ones(1, 2, 4)}).measured, int)


def test_crop_takes_the_window_of_every_map_and_of_the_camera():
    depth = torch.arange(1.0, 33.0).view(1, 4, 8)
    measured = {2: torch.arange(1.0, 9.0).view(1, 2, 4), 4: torch.ones(1, 1, 2)}
    scene = _scene(depth=depth, measured=measured, notes=("estimated",))
    window = scene.crop(2, 4, torch.tensor(2), torch.tensor(4))  # whole numbers of any kind
    assert torch.equal(window.rgb, scene.rgb[:, 2:, 4:])
    assert torch.equal(window.depth, depth[:, 2:, 4:])
    assert window.camera == CAMERA.crop(2, 4, 2, 4)
    assert window.notes == ("estimated",)
    assert list(window.measured) == [2]  # 4 does not divide the window
    assert torch.equal(window.measured[2], torch.tensor([[[7.0, 8.0]]]))


PHOTOS = [torch.zeros(shape) for shape in ((4, 8), (1, 4, 8), (3, 8, 4), (1, 3, 4, 8), (3, 4, 7))]
PHOTOS += [torch.full((3, 4, 8), value) for value in (1, 1.01, -0.01, torch.nan, 255.0)]


@pytest.mark.parametrize("make", [_scene, _sample])
@pytest.mark.parametrize("photo", PHOTOS)
def test_photo_of_another_shape_or_with_values_out_of_range_is_refused(make, photo):
    with pytest.raises(ValueError, match=r"^hall: rgb: expected"):
        make(rgb=photo)


POSITIVE = "expected positive depth, and NaN where a pixel is a hole; got"
BAD_DEPTHS = [
    (lambda shape: torch.ones(shape[1:]), "expected shape"),
    (lambda shape: torch.ones(1, shape[2], shape[1]), "expected shape"),
    (lambda shape: torch.ones(shape, dtype=torch.int32), "expected floating point metres, got torch.int32"),
    (lambda shape: _with(shape, 0.0), f"{POSITIVE} 0$"),
    (lambda shape: _with(shape, -1.5), f"{POSITIVE} -1.5$"),
    (lambda shape: _with(shape, torch.inf), f"{POSITIVE} inf$"),
    (lambda shape: torch.full(shape, torch.nan), "expected at least one known pixel"),
]


@pytest.mark.parametrize(("bad", "message"), BAD_DEPTHS)
def test_invalid_depth_map_is_refused_by_name(bad, message):
    fine, coarse = (1, 4, 8), (1, 2, 4)
    for name, make in (
        ("depth", lambda: _scene(depth=bad(fine))),
        ("measured depth at x2", lambda: _scene(measured={2: bad(coarse)})),
        ("depth", lambda: _sample(depth=bad(fine))),
        ("depth_lr", lambda: _sample(depth_lr=bad(coarse))),
    ):
        with pytest.raises(ValueError, match=f"^hall: {name}: {message}"):
            make()


def test_scene_without_any_depth_is_refused():
    with pytest.raises(ValueError, match=r"^hall: expected"):
        _scene(depth=None)


def test_low_and_high_resolution_sizes_must_differ_by_the_scale():
    wide = {"camera_lr": CAMERA.rescale(3, 2), "depth_lr": torch.ones(1, 2, 3)}
    for changes, got in (({"scale": 4}, "expected 1 x 2 .* got 2 x 4"), (wide, "expected 2 x 4 .* got 2 x 3")):
        with pytest.raises(ValueError, match=f"^hall: depth_lr: {got}"):
            _sample(**changes)


@pytest.mark.parametrize("scale", [0, -2, 0.5, math.nan, math.inf])
def test_scale_below_1_is_refused(scale):
    with pytest.raises(ValueError, match=r"^hall: measured: expected"):
        _scene(measured={scale: torch.ones(1, 2, 4)})
    with pytest.raises(ValueError, match=r"^hall: scale: expected"):
        _sample(scale=scale)


def test_map_at_a_ratio_that_is_not_whole_may_miss_the_photo_by_a_pixel():
    camera = Camera(width=16, height=11, fx=9.0, fy=9.0, cx=7.5, cy=5.0)
    fields = {"rgb": torch.rand(3, 11, 16), "camera": camera, "depth": None}
    for height in (4, 5):  # 11 / (16 / 6) is 4.1
        scene = _scene(**fields, measured={16 / 6: torch.ones(1, height, 6)})
        low = camera.rescale(6, height)
        sample = _sample(**fields, depth_lr=torch.ones(1, height, 6), camera_lr=low, scale=16 / 6)
        assert scene.camera.reduce(6, height) == low
        assert sample.disparity_lr()[0, 0, 0] == pytest.approx(baseline_times_focal(camera))
    with pytest.raises(ValueError, match=r"measured depth at x2.667: expected"):
        _scene(**fields, measured={16 / 6: torch.ones(1, 6, 6)})
    with pytest.raises(ValueError, match=r"depth_lr: expected"):
        _sample(**fields, depth_lr=torch.ones(1, 4, 8), camera_lr=camera.rescale(8, 4), scale=16 / 6)


def test_crop_keeps_a_map_at_any_ratio_where_the_window_has_whole_pixels_of_it():
    camera = Camera(width=24, height=16, fx=9.0, fy=9.0, cx=11.5, cy=7.5)
    depth_lr = torch.arange(1.0, 55.0).view(1, 6, 9)
    scene = _scene(rgb=torch.rand(3, 16, 24), camera=camera, depth=None, measured={24 / 9: depth_lr})
    window = scene.crop(8, 0, 8, 16)
    assert torch.equal(window.measured[24 / 9], depth_lr[:, 3:, :6])
    with pytest.raises(ValueError, match="expected a window with a depth map"):
        scene.crop(0, 0, 12, 24)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("levels", [255, 65535, None])
def test_sample_is_read_with_the_same_bits(tmp_path, dtype, levels):
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(3, 4, 8, generator=generator, dtype=dtype)
    rgb = rgb if levels is None else (rgb * levels).round() / levels
    depth = 1 + torch.rand(1, 4, 8, generator=generator, dtype=dtype)
    depth[0, 1, 2] = torch.nan
    depth_lr = 1 + torch.rand(1, 2, 4, generator=generator, dtype=dtype)
    unit = Unit("levels", inverse=True, factor=300.0, offset=64.0, limits=(0.0, 255.0))
    sample = _sample(rgb=rgb, depth=depth, depth_lr=depth_lr, notes=("cropped",), unit=unit)
    sample.save(tmp_path / "hall.npz")
    read = DepthSample.load(tmp_path / "hall.npz")
    for name in ("rgb", "depth", "depth_lr"):
        torch.testing.assert_close(getattr(read, name), getattr(sample, name), rtol=0, atol=0, equal_nan=True)
    for name in ("dataset", "scene", "scale", "camera", "camera_lr", "notes", "unit"):
        assert getattr(read, name) == getattr(sample, name)
    with np.load(tmp_path / "hall.npz") as stored:
        assert stored["rgb"].dtype == {255: np.uint8, 65535: np.uint16}.get(levels or 0, str(dtype)[6:])


def test_sample_without_truth_and_at_any_ratio_is_read_as_it_was_written(tmp_path):
    camera = Camera(width=16, height=11, fx=9.0, fy=9.0, cx=7.5, cy=5.0)
    maps = {"rgb": torch.zeros(3, 11, 16), "depth": None, "depth_lr": torch.ones(1, 4, 6)}
    _sample(**maps, camera=camera, camera_lr=camera.rescale(6, 4), scale=16 / 6).save(tmp_path / "hall.npz")
    read = DepthSample.load(tmp_path / "hall.npz")
    assert (read.scale, read.depth) == (16 / 6, None)


def test_regions_are_cropped_handed_on_and_read(tmp_path):
    planes = torch.arange(32, dtype=torch.uint8).view(1, 4, 8)
    window = _scene(regions={"planes": planes}).crop(2, 4, 2, 4)
    assert torch.equal(window.regions["planes"], planes[:, 2:, 4:])
    sample = make_sample(window, 2, Downsampling("box"), "orthogonal")
    sample.save(tmp_path / "hall.npz")
    assert torch.equal(DepthSample.load(tmp_path / "hall.npz").regions["planes"], planes[:, 2:, 4:])
    for region, message in ((planes[:, 1:], "expected shape"), (planes.bool(), "expected uint8")):
        with pytest.raises(ValueError, match=f"hall: region planes: {message}"):
            _scene(regions={"planes": region})


def test_disparity_lr_is_in_pixels_of_the_high_resolution_camera():
    camera = replace(CAMERA, doffs=1.5)
    sample = _sample(camera=camera, camera_lr=camera.rescale(4, 2), depth_lr=_with((1, 2, 4), math.nan))
    disparity = sample.disparity_lr(torch.float64)
    assert disparity.dtype == torch.float64
    assert sample.disparity_lr().dtype == torch.float32
    expected = baseline_times_focal(camera) / 2.0 - 1.5
    torch.testing.assert_close(disparity[sample.mask_lr], torch.full((7,), expected).double())
    assert bool(disparity[~sample.mask_lr].isnan().all())
