"""What single data sets have of their own: confidence, sky, rays, levels and layouts; and their real frames."""

import re
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from data_set_files import LEVELS, VGA, dpt, npy, opened, ramp, rays, turned, write_frame
from refusals import refused
from small_files import encoded_png as png
from small_files import png_by_its_specification, touch, written

from dsr.data import arkitscenes, icl, sintel, sunrgbd, tartanair
from dsr.data.eight_bit import EightBit
from dsr.geometry.camera import to_range


def test_uncertain_pixels_of_the_lidar_become_holes(tmp_path, capfd):
    kind = write_frame("arkitscenes", tmp_path)
    confidence = (np.arange(256) % 3 * np.ones((192, 1))).astype(np.uint8)
    path = tmp_path / f"Validation/41069021/confidence/{kind.name}.png"
    measured = path.parents[1] / f"lowres_depth/{kind.name}.png"
    lacking = opened(kind, tmp_path, min_confidence=1)
    assert "confidence in the folder confidence" in refused(lambda: lacking.load(kind.name), measured, capfd)
    written(path, png(confidence))
    for least in (1, 2):
        known = opened(kind, tmp_path, min_confidence=least).load(kind.name).measured[7.5][0].isfinite()
        np.testing.assert_array_equal(known, confidence >= least)
    for content, message in (
        (png(ramp(192, 256, 1)), "expected one channel of 8 bits"), (png(confidence[1:]), "expected 192 x 256 pixels"),
        (png(confidence + 1), "expected confidence from 0 to 2, got 3"),
        (png(confidence * 0), "expected a pixel of confidence 1, there is none"),
    ):  # fmt: skip
        path.write_bytes(content)
        assert message in refused(lambda: opened(kind, tmp_path, min_confidence=1).load(kind.name), path, capfd)
    with pytest.raises(ValueError, match="min_confidence: expected 0, 1 or 2, got 3"):
        opened(kind, tmp_path, min_confidence=3)


def test_intrinsics_of_the_tablet_may_be_a_millisecond_off_or_missing(tmp_path, capfd):
    kind = write_frame("arkitscenes", tmp_path)
    [path] = tmp_path.rglob("*.pincam")
    path = path.rename(path.with_name("41069021_305.245.pincam"))
    scene = opened(kind, tmp_path).load(kind.name)
    assert (scene.camera.fx, scene.notes) == (1590.25, ())
    for text in (b"256 192 212 212 127 96", b"1920 1440 0 1590 960 720"):
        path.write_bytes(text)
        assert "expected" in refused(lambda: opened(kind, tmp_path).load(kind.name), path, capfd)
    path.rename(path.with_name("41069021_305.246.pincam"))
    scene = opened(kind, tmp_path).load(kind.name)
    assert (scene.camera.fx, scene.notes) == (pytest.approx(960 * np.sqrt(3)), (arkitscenes.NOTE,))


def test_frames_of_the_tablet_are_found_in_both_splits_and_spellings(tmp_path):
    for place, photos in (("Validation/1", "wide"), ("Validation/3", "color"), ("Training/2", "wide")):
        name = f"{place[-1]}_1.500.png"
        touch(tmp_path / place, f"{photos}/{name}", f"highres_depth/{name}", f"lowres_depth/{name}")
    assert list(arkitscenes.find_frames(tmp_path, "validation")) == ["1_1.500", "3_1.500"]
    assert list(arkitscenes.find_frames(tmp_path, "training")) == ["2_1.500"]
    assert list(arkitscenes.find_frames(tmp_path / "Training", "training")) == ["2_1.500"]
    assert len(arkitscenes.find_frames(tmp_path)) == 3
    assert not arkitscenes.ARKitScenes(str(tmp_path), "training").evaluation


SKY = VGA / 1024
SKY[0, :3] = 0, 1e10, 10000


@pytest.mark.parametrize("name", ["tartanair", "sintel"])
def test_what_is_farther_than_the_sky_is_a_hole(tmp_path, name):
    kind = write_frame(name, tmp_path, npy=npy(SKY.astype(np.float32)), dpt=dpt(SKY))
    for farthest in (1000.0, 1.5):
        depth = opened(kind, tmp_path, farthest=farthest).load(kind.name).depth[0]
        np.testing.assert_array_equal(depth, np.where((SKY > 0) & (farthest >= SKY), SKY, np.nan))


@pytest.mark.parametrize(
    ("find", "files", "expected"),
    [
        (tartanair.find_frames, (
            "sea/Easy/P001/image_left/000001_left.png", "sea/Easy/P001/depth_left/000001_left_depth.npy",
            "sea/Easy/P001/image_left/000000_left.png", "sea/Easy/P001/depth_left/000000_left_depth.npy",
            "sea/Easy/P001/image_left/000002_left.png", "sea/Easy/P001/image_right/000000_right.png",
            "flat/000007_left.png", "flat/000007_left_depth.npy",
        ), {".": ["flat/000007", "sea/Easy/P001/000000", "sea/Easy/P001/000001"], "flat": ["000007"],
            "sea/Easy/P001": ["000000", "000001"]}),
        (sintel.find_frames, (
            *(f"training/{part}/{name}.{end}" for name in ("alley_1/frame_0001", "market_2/frame_0010")
              for part, end in (("final", "png"), ("depth", "dpt"), ("camdata_left", "cam"))),
            "training/depth/market_2/frame_0011.dpt",
        ), {root: ["alley_1/frame_0001", "market_2/frame_0010"] for root in (".", "training")}),
        (icl.find_frames, (
            "icl/b/rgb/0.png", "icl/b/depth/0.png", "icl/b/rgb/10.png", "icl/b/depth/10.png", "icl/b/rgb/2.png",
            "icl/b/depth/2.png", "icl/b/rgb/3.png", "icl/b/associations.txt", "icl/a/scene_00_0001.png",
            "icl/a/scene_00_0001.depth", "icl/a/scene_00_0002.depth", "icl/c/d/rgb.png", "icl/c/d/depth.png",
            "icl/.trash/rgb.png", "icl/.trash/depth.png", "icl/b/rgb/thumbnail.png", "icl/b/depth/thumbnail.png",
        ), {"icl": ["a/0001", "b/0000", "b/0002", "b/0010", "c/d"], "icl/c/d": ["d"]}),
        (sunrgbd.find_frames, (
            *(f"{name}/{file}" for name in ("kv1/NYUdata/NYU0002", "kv1/NYUdata/NYU0001", "xtion/sun3ddata/a/b/c")
              for file in ("image/1.jpg", "depth/1.png", "inner/image/1.jpg", "inner/depth/1.png")),
            "realsense/lg/x/image/1.jpg", "realsense/lg/x/depth_bfx/1.png", "SUNRGBDtoolbox/image/1.jpg",
        ), {".": ["kv1/NYUdata/NYU0001", "kv1/NYUdata/NYU0002", "realsense/lg/x", "xtion/sun3ddata/a/b/c"],
            "kv1/NYUdata/NYU0002": ["NYU0002"]}),
    ],
    ids=["tartanair", "sintel", "icl", "sunrgbd"],
)  # fmt: skip
def test_frames_of_every_layout_are_listed_by_folder_and_number(tmp_path, monkeypatch, find, files, expected):
    touch(tmp_path, *files)
    monkeypatch.chdir(tmp_path)
    for root, names in expected.items():
        found = find(tmp_path / root)
        assert list(found) == list(find(Path(root))) == names
        for paths in found.values():  # each of one number
            assert len({tuple(re.findall(r"\d+", path.name)) for path in paths}) == 1


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (dpt(SKY) + b"\0", "got 1228801 bytes"), (b"P5 6" + dpt(SKY)[4:], "b'P5 6'"), (dpt(-SKY), "got -1e+10"),
        (struct.pack("<fii", 202021.25, 2**31 - 1, 2**31 - 1) + bytes(8), "2147483647 x 2147483647"),
        (struct.pack("<fii", 202021.25, -2, -3) + bytes(24), "-3 x -2"), (dpt(SKY * np.nan), "got NaN"),
        (dpt(SKY[1:]), "480 x 640"), (dpt(0 * SKY + 1e10), "within 1000 m"),
    ],
)  # fmt: skip
def test_depth_of_sintel_that_cannot_be_is_refused(tmp_path, capfd, content, reason):
    kind = write_frame("sintel", tmp_path, dpt=content)
    path = tmp_path / list(kind.files)[-1]
    assert reason in refused(lambda: opened(kind, tmp_path).load(kind.name), path, capfd)


def test_ray_of_icl_of_length_0_or_beyond_the_rooms_is_a_hole(tmp_path):
    distances = VGA.astype(float)
    distances[0, :3] = 0, 10001, np.inf
    kind = write_frame("icl as rendered", tmp_path, depth=rays(distances))
    assert opened(kind, tmp_path).load(kind.name).depth.isnan().nonzero().tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 2]]


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole + b"1.0", lambda whole: whole + b"1.0 " * 5_000_000, lambda whole: b"-1" + whole,
        lambda whole: b"nan" + whole[1:], lambda whole: b"1e30 " * 307200,
    ],
)  # fmt: skip
def test_damaged_text_of_distances_is_refused_in_one_line(tmp_path, capfd, damage):
    kind = write_frame("icl as rendered", tmp_path)
    [path] = tmp_path.rglob("*.depth")
    path.write_bytes(damage(path.read_bytes()))
    assert "expected " in refused(lambda: opened(kind, tmp_path).load(kind.name), path, capfd)


def test_16_bit_picture_of_icl_keeps_its_values(tmp_path):
    colours = np.zeros((480, 640, 3))
    colours[5, 6] = 65535, 257, 1
    kind = write_frame("icl as rendered", tmp_path, png=png_by_its_specification(colours, colour=2))
    rgb = opened(kind, tmp_path).load(kind.name).rgb
    torch.testing.assert_close(rgb[:, 5, 6], torch.tensor([1, 257 / 65535, 1 / 65535]))


@pytest.mark.parametrize(("dataset", "near", "far"), [("lu", 0.7955, 3.5), ("middlebury8", 1.3152, 2.992)])
def test_disparity_and_unit_of_8_bit_benchmarks_are_the_level(tmp_path, dataset, near, far):
    levels = LEVELS.copy()
    levels[3, :2] = 0, 255
    name = {"lu": "RGBD_01", "middlebury8": "Middlebury_01"}[dataset]
    write_frame("lu", tmp_path, depth_png=png(levels))
    for path in list(tmp_path.rglob("*.png")):
        path.rename(path.with_name(path.name.replace("RGBD_01", name)))
    scene = EightBit(str(tmp_path), dataset, "found").load(name)
    assert (scene.dataset, scene.name, scene.unit.name, scene.unit.limits) == (dataset, name, "levels", (0, 255))
    for found in (to_range(scene.depth, scene.camera, "disparity"), scene.unit.convert(scene.depth)):
        np.testing.assert_allclose(found[0], levels, rtol=0, atol=1e-10)
    assert (scene.depth.min().item(), scene.depth.max().item()) == pytest.approx((near, far), abs=1e-4)


def test_depth_of_sun_rgbd_is_the_sensors_or_the_refined_one_of_one_picture_each(tmp_path, capfd):
    kind = write_frame("sunrgbd", tmp_path)
    refined = written(tmp_path / "kv2/x/depth_bfx/2.png", png(turned(ramp(384, 512, 8181))))
    assert opened(kind, tmp_path, refined=True).load(kind.name).depth[0, 10, 20].item() == 8.221
    refined.with_name("3.png").write_bytes(b"")
    data = opened(kind, tmp_path, refined=True)
    assert "got 2" in refused(lambda: data.load(kind.name), refined.parent, capfd)


@pytest.mark.parametrize(
    "text",
    [
        "350 0 255 0 355 190 0 0", "fx = 3", "1" * 5000, "nan 0 255 0 355 190 0 0 1",
        "-3 0 255 0 355 190 0 0 1", "350 0 999 0 355 190 0 0 1", "350 0 255 0 355 -9 0 0 1",
        "350 2 255 0 355 190 0 0 1", "350 0 255 0 355 0 1 1 1", "1e300 0 255 0 1e300 190 0 0 1",
    ],
)  # fmt: skip
def test_invalid_intrinsics_are_refused(tmp_path, capfd, text):
    kind = write_frame("sunrgbd", tmp_path, txt=text.encode())
    path = tmp_path / "kv2/x/intrinsics.txt"
    assert "expected " in refused(lambda: opened(kind, tmp_path).load(kind.name), path, capfd)


def test_folder_of_sun_rgbd_without_intrinsics_needs_given_ones(tmp_path, capfd):
    kind = write_frame("sunrgbd", tmp_path)
    (tmp_path / "kv2/x/intrinsics.txt").unlink()
    message = refused(lambda: opened(kind, tmp_path).load(kind.name), tmp_path / "kv2/x", capfd)
    assert "intrinsics=(fx, fy, cx, cy)" in message
    assert opened(kind, tmp_path, intrinsics=(300, 301, 1, 2)).load(kind.name).camera.cy == 2
    data = opened(kind, tmp_path, intrinsics=(300, 301, 1, 2000))
    assert "expected " in refused(lambda: data.load(kind.name), "intrinsics", capfd)
