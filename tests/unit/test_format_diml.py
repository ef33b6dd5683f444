"""DIML's indoor sample data, of files of our own: layout, splits and resolutions, millimetres, every damage named."""

import math
import re

import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.diml import DIML, find_frames
from dsr.data.frame_files import NO_CAMERA, load_pair

DEPTH = (1000 + 2 * np.arange(16)[:, None] + np.arange(28)).astype(np.uint16)


def frame(room, name="in_01_160217_123138"):
    return (
        written(room / f"color/{name}_c.png", png(np.full((16, 28, 3), 51, np.uint8))),
        written(room / f"depth_filled/{name}_depth_filled.png", png(DEPTH)),
    )


def test_frame_is_metres_with_sixty_degrees_of_view(tmp_path):
    scene = load_pair(*frame(tmp_path), "diml", "in_01")
    assert scene.depth[0, 10, 20].item() == pytest.approx(1.040)
    assert math.degrees(2 * math.atan(14 / scene.camera.fx)) == pytest.approx(60)
    assert scene.rgb.unique().tolist() == pytest.approx([0.2])
    assert (scene.name, scene.unit.name) == ("in_01", "cm")


def test_frames_are_found_by_split_and_resolution(tmp_path):
    frame(tmp_path / "test/HR/12. Livingroom", "in_01")
    small = frame(tmp_path / "test/LR/12. Livingroom", "in_01")
    frame(tmp_path / "test/LR/01. Warehouse", "in_00")
    frame(tmp_path / "train/HR/01. Warehouse", "in_02")
    frame(tmp_path / "train/HR/01. Warehouse", "in_03")[1].unlink()
    assert list(find_frames(tmp_path, "test", "HR")) == ["in_01"]
    assert find_frames(tmp_path, "test", "LR")["in_01"] == small
    assert list(find_frames(tmp_path / "train/HR", "train", "HR")) == ["in_02"]
    assert list(find_frames(tmp_path)) == ["in_00", "in_01", "in_02"]
    assert find_frames(tmp_path)["in_01"] != small


def test_all_scenes_of_the_split_or_the_found_ones(tmp_path):
    frame(tmp_path / "test/HR/12. Livingroom")
    frame(tmp_path / "train/HR/12. Livingroom", "in_02")
    data = DIML(str(tmp_path), scenes="found")
    assert (data.scenes(), data.evaluation) == (["in_01_160217_123138"], True)
    assert data.load("in_01_160217_123138").notes == (NO_CAMERA,)
    assert not DIML(str(tmp_path), "train", scenes="found").evaluation
    with pytest.raises(ValueError, match=r"got 1 of 503 scenes; .*dataset\.scenes=found"):
        DIML(str(tmp_path))
    with pytest.raises(ValueError, match="split: expected one of test, train, got val"):
        DIML(str(tmp_path), "val")
    with pytest.raises(ValueError, match="resolution: expected one of HR, LR, got MR"):
        DIML(str(tmp_path), resolution="MR")


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"text", "expected a picture"),
        (1, png(DEPTH)[:60], "expected a picture"),
        (1, png(DEPTH[:, 1:]), "expected 16 x 28 pixels"),
        (1, png(DEPTH.astype(np.uint8)), "expected one channel of 16 bits"),
        (1, png(DEPTH * 0), "expected at least one known pixel"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = frame(tmp_path)
    files[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_pair(*files, "diml", "in_01"), files[which], capfd))
