"""Recordings of ROS: cameras for window, binning, rectification and distortion, lone files, and RVL."""

import struct
from types import SimpleNamespace

import captures
import cv2
import numpy as np
import pytest
from captures import FRAMES, INTRINSICS, SIZE

from dsr.geometry.camera import Camera, Lens
from dsr.io.captures.bags import decode_message
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import CameraChoice, Reading

pytest.importorskip("rosbags")
CAMERA = Camera(SIZE[1], SIZE[0], *INTRINSICS)


def read_first(path):
    return read_picture(find_pairs_of_folder(path).pairs[0], Reading())


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("of_info", "expected"),
    [
        # of 200 x 120 pixels the photo shows 128 x 96 from (30, 10) on, 2 x 2 as one: the centres of the first and of
        # the 64th pair of columns are at 30.5 and 156.5
        ({"k": [100.0, 0, 93.5, 0, 102.0, 58.5, 0, 0, 1], "width": 200, "height": 120, "roi": (30, 10, 128, 96),
          "binning_x": 2, "binning_y": 2}, (50.0, 51.0, (93.5 - 30.5) / 2, (58.5 - 10.5) / 2)),
        # of a rectified topic that of P, without distortion
        ({"p": [40.0, 0, 30, -4, 0, 41, 22, 0, 0, 0, 1, 0], "d": [0.3, 0.1, 0, 0, 0],
          "image_name": "image_rect_color"}, (40.0, 41.0, 30.0, 22.0)),
    ],
)  # fmt: skip
def test_camera_is_that_of_the_part_and_the_topic_that_the_photo_is_of(tmp_path, version, of_info, expected):
    path = captures.ros(tmp_path / "a.bag" if version == 1 else tmp_path / "a", version, **of_info)
    picture = read_first(path)
    assert picture.camera == Camera(64, 48, *expected)
    np.testing.assert_array_equal(np.rint(255 * picture.rgb.permute(1, 2, 0).numpy()), captures.photo())


@pytest.mark.parametrize(
    ("model", "numbers"),
    [
        ("plumb_bob", (-0.25, 0.1, 0.002, -0.003, 0.01)),
        ("rational_polynomial", (0.3, -0.1, 0.001, 0.002, 0.02, 0.6, -0.05, 0.01)),
        ("equidistant", (-0.05, 0.02, -0.01, 0.002)),
    ],
)
def test_photos_have_the_lens_of_camera_info_which_is_undone(tmp_path, model, numbers):
    [pair, *_] = find_pairs_of_folder(captures.ros(tmp_path / "a", 2, distortion_model=model, d=numbers)).pairs
    name = "kannala_brandt" if model == "equidistant" else "brown_conrady"
    geometry = pair.capture.geometry_of(SIZE)
    assert (geometry.camera, geometry.lens) == (CAMERA, Lens(name, numbers))
    picture = read_picture(pair, Reading())
    assert picture.camera == CAMERA
    assert any(f"{numbers[0]:g}" in str(fact) for fact in picture.assumptions)


def test_camera_that_is_not_calibrated_is_assumed_or_given(tmp_path):
    """CameraInfo has zeros for it."""
    [pair, *_] = find_pairs_of_folder(captures.ros(tmp_path / "a.bag", 1, k=[0.0] * 9)).pairs
    picture = read_picture(pair, Reading())
    assert any("not calibrated" in fact.text for fact in picture.assumptions)
    assert any("none given" in fact.text for fact in picture.assumptions)
    assert picture.time == pytest.approx(100)
    assert read_picture(pair, Reading(camera=CameraChoice(intrinsics=INTRINSICS))).camera == CAMERA


@pytest.mark.parametrize(
    ("of_info", "said"),
    [
        ({"roi": (30, 10, 128, 96)}, "crop: expected a window"),
        ({"d": [np.nan, 0, 0, 0, 0]}, "lens: expected"),
        ({"d": [0.1, 0.2, 0.3]}, "lens: expected"),
        ({"width": 0}, "expected a positive width and height"),
    ],
)
def test_camera_info_that_is_none_is_one_line(tmp_path, of_info, said):
    path = captures.ros(tmp_path / "a.bag", 1, **of_info)
    with pytest.raises(ValueError, match=f"^{path}/camera/color/camera_info: {said}"):
        read_first(path)


def test_recording_without_depth_is_refused_with_its_topics(tmp_path):
    path = captures.ros(tmp_path / "a.bag", 1)
    path.write_bytes(path.read_bytes().replace(b"16UC1", b"mono8"))
    with pytest.raises(ValueError, match=f"^{path}: expected a topic of depth .* got /camera/aligned_depth"):
        find_pairs_of_folder(path)


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_file_of_ros_2_is_read_without_its_folder(tmp_path, suffix):
    folder = captures.ros(tmp_path / "whole", 2, plugin="MCAP" if suffix == ".mcap" else "SQLITE3")
    alone = tmp_path / "alone" / f"scan{suffix}"
    alone.parent.mkdir()
    (folder / f"whole{suffix}").rename(alone)
    for place in (alone, alone.parent):
        found = find_pairs_of_folder(place)
        assert len(found.pairs) == FRAMES
        picture = read_picture(found.pairs[1], Reading())
        assert picture.camera == CAMERA
        np.testing.assert_allclose(picture.depth_lr[0], captures.depth(1), atol=6e-4)
    alone.write_bytes(alone.read_bytes()[:3000])
    with pytest.raises(ValueError, match=f"^{alone}: expected a recording of ROS"):
        find_pairs_of_folder(alone)


def message(content, *, floats=False, kind="rvl"):
    """A message of compressedDepth; floats are stored as a / z + b, rounded, behind the two numbers."""
    data = struct.pack("<iff", 0, *((20_000.0, 3.0) if floats else (0.0, 0.0))) + content
    layout = f"{'32FC1' if floats else '16UC1'}; compressedDepth {kind}"
    return SimpleNamespace(format=layout, data=np.frombuffer(data, np.uint8))


def maps():
    generator = np.random.default_rng(0)
    sparse = generator.integers(0, 65536, (23, 31)) * (generator.random((23, 31)) < 0.4)
    holes = captures.millimetres()
    holes[3:6, 4:] = 0
    ends = captures.millimetres()
    ends[-1] = 0
    extremes = np.array([[1, 65535, 0, 65535, 1, 0]], np.uint16)
    found = {"sparse": sparse.astype(np.uint16), "slope": captures.millimetres(), "extremes": extremes}
    return {**found, "holes": holes, "ends": ends, "none": np.zeros((5, 7), np.uint16)}


def test_topic_of_compressed_depth_is_read(tmp_path):
    found = find_pairs_of_folder(captures.ros(tmp_path / "a", 2, rvl_depth=True)).pairs
    np.testing.assert_allclose(read_picture(found[2], Reading()).depth_lr[0], captures.depth(2), atol=6e-4)


@pytest.mark.parametrize("kind", ["rvl", "png"])
@pytest.mark.parametrize("name", maps())
def test_compressed_depth_is_decoded(name, kind):
    values = maps()[name]
    content = captures.rvl(values) if kind == "rvl" else cv2.imencode(".png", values)[1].tobytes()
    found = decode_message(message(content, kind=kind))
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, values)
    metres = decode_message(message(content, floats=True, kind=kind))
    expected = np.where(values > 0, 20_000 / np.where(values == 3, np.nan, values - 3.0), np.nan)
    np.testing.assert_allclose(metres, expected, rtol=1e-6)


def test_rvl_that_is_damaged_or_declares_more_than_it_can_hold_is_refused_before_memory_is_taken():
    content = captures.rvl(captures.millimetres())
    huge = struct.pack("<II", 60_000, 60_000) + content[8:]
    more = struct.pack("<II", 16, 13) + content[8:]
    fewer = struct.pack("<II", 16, 10) + content[8:]
    endless = content[:8] + b"\xff" * 64
    empty = struct.pack("<II", 0, 12) + content[8:]
    still = struct.pack("<II", 16, 12) + bytes(400)
    for wrong in (huge, more, fewer, endless, empty, still, content[:40], content[:6], content[:-1]):
        with pytest.raises(ValueError, match="expected ") as caught:
            decode_message(message(wrong))
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"^expected depth as a 16-bit PNG \(compressedDepth\), got 40 bytes"):
        decode_message(message(b"\x89PNG".ljust(28), kind="png"))


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_recording_whose_files_are_packed_whole_is_read_and_leaves_nothing(tmp_path, monkeypatch, plugin):
    path = captures.ros(tmp_path / "scan", 2, plugin=plugin, packed=True)
    assert [file.suffix for file in path.iterdir() if file.stem != "metadata"] == [".zstd"]
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    found = find_pairs_of_folder(path)
    assert len(found.pairs) == FRAMES
    for number, pair in enumerate(found.pairs):
        picture = read_picture(pair, Reading())
        assert picture.camera == CAMERA
        np.testing.assert_allclose(picture.depth_lr[0], captures.depth(number), atol=6e-4)
    read_first(captures.ros(tmp_path / "other.bag", 1))
    assert not any((tmp_path / "temporary").iterdir())
    [content] = path.glob("*.zstd")
    content.write_bytes(content.read_bytes()[:-40])
    with pytest.raises(ValueError, match=f"^{path}: expected a recording of ROS"):
        find_pairs_of_folder(path)


@pytest.mark.parametrize(("encoding", "order"), [("rgb8", (0, 1, 2)), ("bgr8", (2, 1, 0)), ("rgba8", (0, 1, 2, 0))])
def test_images_of_ros_have_their_channels_in_order_and_may_have_padded_rows(encoding, order):
    pixels = captures.photo()[..., list(order)]
    rows = np.pad(pixels.reshape(SIZE[0], -1), ((0, 0), (0, 5)))
    about = {"height": SIZE[0], "width": SIZE[1], "step": rows.shape[1], "is_bigendian": 0}
    message = SimpleNamespace(encoding=encoding, data=rows.reshape(-1), **about)
    np.testing.assert_array_equal(decode_message(message), captures.photo())
    message.height += 1
    with pytest.raises(ValueError, match=r"^expected an image of 64 x 49 in rows of \d+ bytes, got"):
        decode_message(message)
