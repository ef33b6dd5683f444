"""The stereo camera before a board: its plane as the lens shows it, its regions, every damage named."""

import json

import cv2
import numpy as np
import pytest
from data_set_files import SETS
from small_files import written

from dsr.data.stereo_board import BOARDS, CAMERA, LENS, StereoBoard, find_frames, load_frame


def frame(root, name="14", suffix="png"):
    """Write a frame."""
    color, depth = SETS["stereo_board"].files.values()
    return written(root / f"color/{name}.{suffix}", color), written(root / f"depth/{name}.png", depth)


@pytest.mark.parametrize("name", BOARDS)
def test_points_of_the_truth_lie_on_the_plane_and_are_seen_where_the_lens_shows_them(tmp_path, name):
    scene, board = load_frame(*frame(tmp_path, name), name, "stereo_board", name), BOARDS[name]
    assert np.linalg.norm(board.normal) == pytest.approx(1, abs=1e-5)
    depth = scene.depth[0].numpy()
    rows, columns = (each[::997] for each in np.nonzero(np.isfinite(depth)))
    u, v = (columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy
    x, y = u.copy(), v.copy()
    k1, k2, *_ = LENS.coefficients
    for _ in range(100):  # the lens, turned around by a fixed point
        square = x**2 + y**2
        radial = 1 + k1 * square + k2 * square**2
        x, y = u / radial, v / radial
    z = depth[rows, columns]
    assert abs(np.stack([x * z, y * z, z], axis=1) @ board.normal - board.distance).max() < 1e-5


def test_planes_and_the_lens_are_those_that_were_measured(shared):
    facts = json.loads((shared / "real/stereo_board/board.json").read_text())
    planes = {name: (list(each.normal), each.distance) for name, each in BOARDS.items()}
    assert planes == {name: (each["normal"], each["distance"]) for name, each in facts["frames"].items()}
    assert list(facts["distortion"].values()) == list(LENS.coefficients[:2])
    assert {name: getattr(CAMERA, name) for name in facts["camera"]} == facts["camera"]


def test_regions_are_the_board_from_12_pixels_inside_its_outline_and_of_that_up_to_36(tmp_path):
    scene = load_frame(*frame(tmp_path), "14", "stereo_board", "14")
    board, border = (scene.regions[name][0].numpy() for name in ("board", "border"))
    assert board.dtype == border.dtype == np.uint8
    assert set(np.unique(board)) == set(np.unique(border)) == {0, 1}
    assert not (border & ~board & 1).any()
    assert np.isfinite(scene.depth[0].numpy())[board > 0].all()
    outline = np.round(BOARDS["14"].outline).astype(np.float32)[:, None]
    for row, column in np.argwhere(board)[::4999]:
        inside = cv2.pointPolygonTest(outline, (float(column), float(row)), measureDist=True)
        assert inside > 12 - 2
        assert abs(inside - 36) < 2 or (inside < 36) == bool(border[row, column])


def test_frames_are_those_of_the_boards(tmp_path):
    for name in ("8", "31", "9"):
        frame(tmp_path / "realsense", name, "jpg" if name == "31" else "png")
    assert list(find_frames(tmp_path)) == ["8", "31"]
    assert StereoBoard(str(tmp_path), "found").scenes() == ["8", "31"]
    with pytest.raises(ValueError, match=r"dataset=stereo_board: expected 14, 19, 25 in .* got 2 of 5 scenes"):
        StereoBoard(str(tmp_path))
