"""HAMMER, of files of our own: three cameras, the split by scene, sequences without objects, every damage named."""

import re

import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.hammer import Hammer, find_frames, load_frame

ROWS, COLUMNS = np.mgrid[0:52, 0:68]
TRUTH = (700 + 2 * ROWS + COLUMNS).astype(np.uint16)
OFFSETS = {"d435": 5, "tof": 20, "l515": 9}
CAMERA = b"44.17 0 34.1\n0 44.22 24.37\n0 0 1\n"


def frame(root, sequence="scene12_traj1_1", name="000000"):
    """Write a frame; each camera is off by its own distance and has a hole in one corner, the truth in the opposite."""
    place = root / sequence / "polarization"
    truth = TRUTH.copy()
    truth[51, 67] = 0
    written(place / f"rgb/{name}.png", png(np.dstack([ROWS] * 3).astype(np.uint8)))
    written(place / f"_gt/{name}.png", png(truth))
    for sensor, offset in OFFSETS.items():
        measured = TRUTH + np.uint16(offset)
        measured[0, 0] = 0
        written(place / f"depth_{sensor}/{name}.png", png(measured))
    written(place / "intrinsics.txt", CAMERA)
    return place


@pytest.mark.parametrize("sensor", OFFSETS)
def test_measured_map_is_the_cameras_and_the_truth_has_its_own_holes(tmp_path, sensor):
    frame(tmp_path)
    data = Hammer(str(tmp_path), sensor)
    scene = data.load("scene12_traj1_1_000000")
    assert (scene.dataset, list(scene.measured)) == ("hammer", [1])
    assert scene.measured[1].isnan().nonzero().tolist() == [[0, 0, 0]]
    assert scene.depth.isnan().nonzero().tolist() == [[0, 51, 67]]
    assert scene.depth[0, 3, 4].item() == pytest.approx(0.710)
    assert (scene.measured[1] - scene.depth)[0, 3, 4].item() == pytest.approx(OFFSETS[sensor] / 1000)
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (44.17, 44.22, 34.1, 24.37)


def test_scenes_12_to_14_are_to_test_on_and_naked_ones_are_left_out(tmp_path):
    for sequence in ("scene14_traj2_2", "scene2_traj1_1", "scene12_traj1_1", "scene12_traj1_naked_1"):
        frame(tmp_path / "_dataset_processed", sequence)
    frame(tmp_path, "scene13_traj1_1", "000001")
    (tmp_path / "scene13_traj1_1/polarization/depth_tof/000001.png").unlink()
    frame(tmp_path, "table12_traj1_1")
    names = ["scene12_traj1_1/000000", "scene13_traj1_1/000001", "scene14_traj2_2/000000"]
    assert list(find_frames(tmp_path, split="test")) == names
    assert list(find_frames(tmp_path, "tof", "test")) == [names[0], names[2]]
    assert list(find_frames(tmp_path, split="train")) == ["scene2_traj1_1/000000"]
    assert list(find_frames(tmp_path, naked=True)) == ["scene12_traj1_naked_1/000000"]
    assert len(find_frames(tmp_path / "_dataset_processed/scene12_traj1_1")) == 1
    assert (Hammer(str(tmp_path)).evaluation, Hammer(str(tmp_path), split="train").evaluation) == (True, False)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sensor": "d415"}, "sensor: expected one of d435, tof, l515, got d415"),
        ({"split": "val"}, "split: expected one of test, train, got val"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        Hammer(str(tmp_path), **settings)


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"", "expected a picture"),
        (1, png(TRUTH[1:]), "expected 52 x 68 pixels"),
        (1, png(TRUTH * 0), "expected at least one known pixel, all are holes"),
        (1, png(ROWS.astype(np.uint8)), "expected one channel of 16 bits"),
        (2, png(TRUTH)[:99], "expected a picture"),
        (2, png(TRUTH[:, 1:]), "expected 52 x 68 pixels"),
        (3, b"44.17 0 34.1 0 44.22 24.37", "expected 9 numbers, got 6"),
        (3, b"44.17 0 340 0 44.22 24.37 0 0 1", "expected fx 0 cx 0 fy cy 0 0 1 of a 52 x 68 picture"),
        *((which, None, "expected") for which in range(4)),
    ],
)
def test_damaged_or_missing_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    frame(tmp_path)
    files = find_frames(tmp_path)["scene12_traj1_1/000000"]
    files[which].unlink() if content is None else files[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_frame(*files, "hammer", "a"), files[which], capfd))
