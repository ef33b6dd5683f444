"""The 8-bit benchmarks: levels are disparity of the invented cameras, and the field's bicubic rows come out."""

import re

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from refusals import refused

from dsr.data.eight_bit import BENCHMARKS, NOTE, EightBit, find_frames, load_frame
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import to_range

LEVELS = (np.arange(12 * 20) * 7 % 256).astype(np.uint8).reshape(12, 20)
"""Has 0 and 255, and is not symmetric under any flip."""
assert {0, 255} <= set(LEVELS.ravel().tolist())


def written(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)
    return path


def pair(root, name="RGBD_01", spelling="ouput", levels=LEVELS):
    photo = np.zeros((12, 20, 3), np.uint8)
    photo[..., 2] = LEVELS
    return (
        written(root / f"RGB/{name}_{spelling}_color.png", photo),
        written(root / f"Depth/{name}_output_depth.png", levels),
    )


@pytest.mark.parametrize("dataset", BENCHMARKS)
def test_disparity_and_unit_of_the_depth_are_the_level(tmp_path, dataset):
    scene = load_frame(*pair(tmp_path), dataset, "RGBD_01")
    assert (scene.dataset, scene.name, scene.unit.name, scene.unit.limits) == (dataset, "RGBD_01", "levels", (0, 255))
    for levels in (to_range(scene.depth, scene.camera, "disparity"), scene.unit.convert(scene.depth)):
        np.testing.assert_allclose(levels[0], LEVELS, rtol=0, atol=1e-10)
    np.testing.assert_allclose(scene.rgb[0] * 255, LEVELS, rtol=0, atol=1e-4)
    assert scene.depth.dtype == torch.float64


@pytest.mark.parametrize(("dataset", "near", "far"), [("lu", 0.7955, 3.5), ("middlebury8", 1.3152, 2.992)])
def test_cameras_are_those_of_the_documentation(tmp_path, dataset, near, far):
    scene = load_frame(*pair(tmp_path), dataset, "RGBD_01")
    assert (scene.camera.cx, scene.camera.cy) == (9.5, 5.5)
    assert scene.depth.min().item() == pytest.approx(near, abs=1e-4)
    assert scene.depth.max().item() == pytest.approx(far, abs=1e-4)


def test_frames_are_found_by_name_below_any_folder(tmp_path):
    pair(tmp_path / "a/Lu", "RGBD_02")
    pair(tmp_path / "a/Lu", "RGBD_01")
    pair(tmp_path / "b", "Middlebury_07", "output")
    written(tmp_path / "b/RGB/Middlebury_08_output_color.png", np.zeros((2, 2, 3), np.uint8))
    assert list(find_frames(tmp_path, "lu")) == ["RGBD_01", "RGBD_02"]
    assert list(find_frames(tmp_path, "middlebury8")) == ["Middlebury_07"]


def test_all_scenes_of_the_benchmark_or_the_found_ones(tmp_path):
    pair(tmp_path, "RGBD_03")
    assert EightBit(str(tmp_path), "lu", "found").scenes() == ["RGBD_03"]
    with pytest.raises(ValueError, match=r"expected RGBD_01, RGBD_02, RGBD_04, .* got 1 of 6 scenes; .*scenes=found"):
        EightBit(str(tmp_path), "lu")
    with pytest.raises(ValueError, match="benchmark: expected one of lu, middlebury8, got nyu"):
        EightBit(str(tmp_path), "nyu")
    data = EightBit(str(tmp_path), "lu", ["RGBD_03"])
    assert data.load("RGBD_03").notes == (NOTE,)
    before = data.fingerprint("RGBD_03")
    pair(tmp_path, "RGBD_03", levels=LEVELS[:, ::-1])
    assert EightBit(str(tmp_path), "lu", "found").fingerprint("RGBD_03") != before


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (1, b"", "expected a picture, got a damaged or foreign file of 0 bytes"),
        (1, cv2.imencode(".png", LEVELS.astype(np.uint16))[1].tobytes(), "expected one channel of 8 bits, got uint16"),
        (1, cv2.imencode(".png", LEVELS[:, :19])[1].tobytes(), "expected 12 x 20 pixels .* got 12 x 19"),
        (1, cv2.imencode(".png", np.dstack([LEVELS] * 3))[1].tobytes(), "expected one channel of 8 bits"),
        (0, b"text", "expected a picture, got a damaged or foreign file of 4 bytes"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = pair(tmp_path)
    files[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_frame(*files, "lu", "RGBD_01"), files[which], capfd))


@pytest.mark.parametrize(("scale", "expected"), [(4, 2.4185), (8, 4.5383)])
def test_bicubic_row_of_the_field_comes_out_on_lu(shared, scale, expected):
    data = EightBit(str(shared / "modern/Lu"), "lu")
    errors = []
    for name in data.scenes():
        sample = make_sample(data.load(name), scale, Downsampling("bicubic"), "disparity")
        width, height = sample.camera.width, sample.camera.height
        levels_lr = Image.fromarray(sample.disparity_lr()[0].float().numpy())
        levels = np.asarray(levels_lr.resize((width, height), Image.Resampling.BICUBIC)).clip(0, 255)
        errors.append(np.sqrt(np.mean((levels - sample.unit.convert(sample.depth)[0].numpy()) ** 2)))
    assert np.mean(errors) == pytest.approx(expected, abs=1e-3)


def test_thirty_pairs_of_middlebury_are_read(shared):
    data = EightBit(str(shared / "modern"), "middlebury8")
    assert len(data.scenes()) == 30
    scene = data.load("Middlebury_30")
    assert tuple(scene.depth.shape) == (1, 381, 432)
    assert (scene.unit.convert(scene.depth).min().item(), scene.unit.convert(scene.depth).max().item()) == (
        pytest.approx(24),
        pytest.approx(134),
    )
