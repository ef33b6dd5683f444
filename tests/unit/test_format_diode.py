"""DIODE, of files of our own: depth where the mask has it, splits and places, every damage named."""

import io
import re

import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.diode import Diode, find_frames, load_frame

ROWS, COLUMNS = np.mgrid[0:768, 0:1024]
DEPTH = (1 + ROWS / 512 + COLUMNS / 2048).astype(np.float32)
MASK = ((ROWS > 1) & (COLUMNS > 2)).astype(np.float32)
PHOTO = png(np.full((768, 1024, 3), 51, np.uint8))
NAME = "00019_00183_indoors_000_010"


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def frame(folder, name=NAME):
    """Write a frame, the depth with an axis of length 1 at its end and with values where the mask has none."""
    return (
        written(folder / f"{name}.png", PHOTO),
        written(folder / f"{name}_depth.npy", npy(DEPTH[..., None])),
        written(folder / f"{name}_depth_mask.npy", npy(MASK)),
    )


def test_frame_has_depth_where_the_scanner_saw_something(tmp_path):
    scene = load_frame(*frame(tmp_path), "diode", NAME)
    np.testing.assert_array_equal(scene.depth[0], np.where(MASK > 0, DEPTH, np.nan))
    camera = scene.camera
    assert (camera.width, camera.height) == (1024, 768)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (886.81, 927.06, 512, 384)


def test_frames_are_found_by_split_and_place_and_need_all_their_files(tmp_path):
    outdoor, third = "00022_00193_outdoor_010_020", "00000_00001_indoors_000_000"
    frame(tmp_path / "val/indoors/scene_00019/scan_00183")
    frame(tmp_path / "val/outdoor/scene_00022/scan_00193", outdoor)
    frame(tmp_path / "train/indoors/scene_00000/scan_00001", third)
    frame(tmp_path / "val/indoors/scene_00019/scan_00183", "00019_00183_indoors_000_020")[2].unlink()
    assert list(find_frames(tmp_path)) == [third, NAME, outdoor]
    assert list(find_frames(tmp_path, "val")) == [NAME, outdoor]
    assert list(find_frames(tmp_path, "val", "outdoor")) == [outdoor]
    assert Diode(str(tmp_path), scenes="found").scenes() == [NAME]
    train = Diode(str(tmp_path), "train", scenes="found")
    assert (train.scenes(), train.evaluation) == ([third], False)
    with pytest.raises(ValueError, match=r"dataset=diode: expected .* got 1 of 325 scenes"):
        Diode(str(tmp_path))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"split": "test"}, "split: expected one of val, train, got test"),
        ({"place": "indoor"}, "place: expected one of indoors, outdoor, got indoor"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        Diode(str(tmp_path), **settings)


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"", "expected a picture"),
        (0, png(np.zeros((76, 102, 3), np.uint8)), "expected 768 x 1024 pixels"),
        (1, b"text", "expected a NumPy array"),
        (1, npy(DEPTH)[:5000], "expected a NumPy array"),
        (1, npy(DEPTH[1:]), "expected 768 x 1024 pixels"),
        (1, npy(-DEPTH), "expected positive depth"),
        (1, npy(np.full_like(DEPTH, np.nan)), "expected positive depth, and 0 where a pixel is a hole; got NaN"),
        (1, npy(DEPTH.astype("S4")), "expected numbers, got"),
        (2, npy(MASK[:, 1:]), "expected 768 x 1024 pixels"),
        (2, npy(np.dstack([MASK] * 3)), "expected 768 x 1024 pixels"),
        (2, b"", "expected a NumPy array"),
        *((which, None, "expected") for which in range(3)),
    ],
)
def test_damaged_or_missing_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = frame(tmp_path)
    files[which].unlink() if content is None else files[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_frame(*files, "diode", NAME), files[which], capfd))
