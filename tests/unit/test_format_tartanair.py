"""TartanAir: known numbers in both layouts, the sky a hole, every damage refused by name."""

import struct

import numpy as np
import pytest
from refusals import refused
from small_files import written

from dsr.data.tartanair import find_frames, load_frame, read_depth

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
VALUES = 1.0 + ROWS + COLUMNS / 1024  # Metres, exact in float32, not symmetric under any flip


def npy(values=VALUES, descr="<f4", shape=None, order=False):
    """Return a version 1.0 .npy file."""
    values = np.asarray(values)
    header = f"{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape or values.shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode() + values.astype(descr).tobytes()


def changed(index, value):
    values = VALUES.copy()
    values[index] = value
    return values


def test_depth_is_read_as_orthogonal_metres_and_the_sky_is_a_hole(tmp_path):
    path = written(tmp_path / "000000_left_depth.npy", npy(changed((0, slice(3)), [10000.0, np.inf, 0.0])))
    depth = read_depth(path)
    assert depth.isnan().nonzero().tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 2]]
    assert depth[0, 7, 512].item() == 8.5
    assert read_depth(path, farthest=50.0).isfinite().sum().item() == 49 * 640 - 3 + 1


@pytest.mark.parametrize(
    "content",
    [
        b"", b"\x93NUMPY", npy()[:100], npy()[:1000], npy()[:-4], b"text, no array", b"PK\x03\x04" * 50,
        npy(VALUES[:, :639]), npy(VALUES.T), npy(VALUES[None]), npy(VALUES, "<f8"), npy(VALUES, "<u2"),
        npy(VALUES, ">f4"),
        npy(VALUES[:1], shape=(480, 640)), npy(VALUES, shape=(10**9, 10**9)), npy(VALUES, shape=(-480, -640)),
        npy(VALUES, "|O")[:500], npy(changed((5, 5), np.nan)), npy(changed((5, 5), -1.0)), npy(VALUES * 0),
        npy(VALUES * 0 + 1e6),
    ],
)  # fmt: skip
def test_damaged_depth_file_is_refused_in_one_line(tmp_path, capfd, content):
    path = written(tmp_path / "000000_left_depth.npy", content)
    assert refused(lambda: read_depth(path), path, capfd).startswith("expected ")


def test_frames_of_both_layouts_are_listed_by_folder_and_number(tmp_path):
    for name in ("sea/Easy/P001/image_left/000001_left.png", "sea/Easy/P001/depth_left/000001_left_depth.npy",
                 "sea/Easy/P001/image_left/000000_left.png", "sea/Easy/P001/depth_left/000000_left_depth.npy",
                 "sea/Easy/P001/image_left/000002_left.png", "sea/Easy/P001/image_right/000000_right.png",
                 "flat/000007_left.png", "flat/000007_left_depth.npy"):  # fmt: skip
        written(tmp_path / name, b"")
    found = find_frames(tmp_path)
    assert list(found) == ["flat/000007", "sea/Easy/P001/000000", "sea/Easy/P001/000001"]
    place = tmp_path / "sea/Easy/P001"
    expected = (place / "image_left/000001_left.png", place / "depth_left/000001_left_depth.npy")
    assert found["sea/Easy/P001/000001"] == expected
    assert list(find_frames(tmp_path / "flat")) == ["000007"]
    assert list(find_frames(place)) == ["000000", "000001"]


def test_real_frame_is_read(shared):
    frames = find_frames(shared / "real/tartanair")
    assert list(frames) == ["000000"]
    scene = load_frame(*frames["000000"], "tartanair", "000000")
    assert not scene.depth.isnan().any()
    assert scene.depth.median().item() == pytest.approx(1.838, abs=0.001)
