"""MPI Sintel: .dpt and .cam files written byte by byte, every damage refused by name."""

import struct

import cv2
import numpy as np
import pytest
from refusals import refused
from small_files import written

from dsr.data.sintel import SEQUENCES, find_frames, load_frame, read_camera, read_depth

VALUES = np.array([[1.5, 2.25, 0.125], [40.0, 999.0, 1e10]])  # Metres, exact in float32; the last is sky
INTRINSICS = [1120.0, 0.0, 511.5, 0.0, 1120.0, 217.5, 0.0, 0.0, 1.0]
SIZE = (436, 1024)


def dpt(values=VALUES, tag=202021.25, size=None):
    height, width = values.shape if size is None else size
    return struct.pack("<fii", tag, width, height) + struct.pack(f"<{values.size}f", *values.ravel())


def cam(intrinsics=INTRINSICS, tag=202021.25):
    return struct.pack("<f9d12d", tag, *intrinsics, *range(12))


def refusal(capfd, act, path):
    message = refused(act, path, capfd)
    assert message.startswith("expected ")
    return message


def frame(root, columns=40, name="training/{}/alley_1/frame_0001{}"):
    """Write a frame of 30 x 40 pixels and return its files."""
    pixels = cv2.imencode(".png", np.full((30, 40, 3), (0, 51, 255), np.uint8))[1].tobytes()
    camera = cam([50.0, 0.0, 19.5, 0.0, 60.0, 14.5, 0.0, 0.0, 1.0])
    return (
        written(root / name.format("final", ".png"), pixels),
        written(root / name.format("depth", ".dpt"), dpt(np.full((30, columns), 2.0))),
        written(root / name.format("camdata_left", ".cam"), camera),
    )


def test_depth_is_read_row_by_row_and_the_sky_is_a_hole(tmp_path):
    path = written(tmp_path / "frame_0001.dpt", dpt())
    np.testing.assert_array_equal(read_depth(path)[0], [[1.5, 2.25, 0.125], [40.0, 999.0, np.nan]])
    np.testing.assert_array_equal(read_depth(path, 30.0)[0], [[1.5, 2.25, 0.125], [np.nan, np.nan, np.nan]])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "0 bytes"), (dpt()[:4], "4 bytes"), (dpt()[:12], "got 0 bytes"), (dpt()[:20], "got 8 bytes"),
        (dpt() + b"\0", "got 25 bytes"), (dpt(tag=1.0), "tag 202021.25"),
        (struct.pack(">f", 202021.25) + dpt()[4:], "tag 202021.25"), (b"P5\n3 2\n255\nabcdef" * 3, "b'P5"),
        (dpt(size=(2**31 - 1, 2**31 - 1)), "2147483647 x 2147483647"), (dpt(size=(-2, -3)), "-2 x -3"),
        (dpt(size=(0, 0)), "0 x 0"), (dpt(size=(3, 3)), "3 x 3"), (dpt(-VALUES), "got -1e+10"),
        (dpt(np.array([[1.0, np.nan]])), "got NaN"), (dpt(np.zeros((2, 3))), "all are holes"),
        (dpt(np.full((2, 3), 1e10)), "within 1000 m"),
    ],
)  # fmt: skip
def test_damaged_depth_file_is_refused_in_one_line(tmp_path, capfd, content, reason):
    path = written(tmp_path / "frame_0001.dpt", content)
    assert reason in refusal(capfd, lambda: read_depth(path), path)


def test_camera_is_the_first_matrix_of_its_file(tmp_path):
    camera = read_camera(written(tmp_path / "frame_0001.cam", cam()), SIZE)
    assert (camera.width, camera.height) == (1024, 436)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1120.0, 1120.0, 511.5, 217.5)


def swapped(index, value):
    return [value if place == index else entry for place, entry in enumerate(INTRINSICS)]


@pytest.mark.parametrize(
    "content",
    [
        b"", cam()[:40], cam() + b"\0", cam(tag=0.0), b"x" * 172, cam(swapped(0, 0.0)), cam(swapped(0, -1120.0)),
        cam(swapped(4, np.nan)), cam(swapped(4, np.inf)), cam(swapped(0, 1e200)), cam(swapped(1, 5.0)),
        cam(swapped(2, 5000.0)), cam(swapped(8, 0.0)), cam([0.0] * 9),
    ],
)  # fmt: skip
def test_damaged_camera_file_is_refused_in_one_line(tmp_path, capfd, content):
    path = written(tmp_path / "frame_0001.cam", content)
    refusal(capfd, lambda: read_camera(path, SIZE), path)


def test_frame_has_photo_depth_and_camera(tmp_path):
    scene = load_frame(*frame(tmp_path), "sintel", "alley_1/frame_0001")
    np.testing.assert_allclose(scene.rgb[:, 3, 4], [1.0, 0.2, 0.0])
    assert scene.depth.unique().tolist() == [2.0]
    assert (scene.camera.width, scene.camera.fx, scene.camera.cy) == (40, 50.0, 14.5)


def test_depth_of_another_size_than_the_photo_is_refused(tmp_path, capfd):
    files = frame(tmp_path, columns=41)
    assert "30 x 40" in refusal(capfd, lambda: load_frame(*files, "sintel", "a"), files[1])


def test_frames_are_listed_from_the_root_or_its_training_folder(tmp_path):
    files = frame(tmp_path)
    frame(tmp_path, name="training/{}/market_2/frame_0010{}")
    written(tmp_path / "training/depth/market_2/frame_0011.dpt", b"")
    for root in (tmp_path, tmp_path / "training"):
        found = find_frames(root)
        assert list(found) == ["alley_1/frame_0001", "market_2/frame_0010"]
        assert found["alley_1/frame_0001"] == files
    assert find_frames(tmp_path, "clean") == {}


def test_sequences_have_1064_frames():
    assert (len(SEQUENCES), sum(SEQUENCES.values())) == (23, 1064)
