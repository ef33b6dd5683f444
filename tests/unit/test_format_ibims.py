"""iBims-1 in both of its layouts: truth, planes and edges; matrices that do not fit."""

import re

import numpy as np
import pytest
from data_set_files import mat
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.ibims import IBims, find_matrices, find_pictures, load_matrices, load_pictures

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
LEVELS = (2000 + 20 * ROWS + 3 * COLUMNS).astype(np.uint16)
DEPTH = LEVELS / 65535 * 50
RGB = np.dstack([ROWS % 256, COLUMNS % 256, ROWS * 0 + 51]).astype(np.uint8)
MASKS = {
    "mask_invalid": (COLUMNS >= 3).astype(np.uint8),
    "mask_transp": (ROWS >= 2).astype(np.uint8),
    "edges": (COLUMNS == 320).astype(np.uint8),
    "mask_wall": np.where(ROWS < 100, 1, np.where(ROWS < 200, 2, 0)).astype(np.uint8),
    "mask_table": np.where(ROWS >= 400, 0, ROWS >= 300).astype(np.uint8),
    "mask_floor": (ROWS >= 400).astype(np.uint8),
}
INTRINSICS = np.array([[560.5, 0, 321], [0, 561.25, 239.5], [0, 0, 1]])


def matrices(root, name="corridor_01", **changes):
    """Write a scene's MATLAB file."""
    data = {"rgb": RGB, "depth": DEPTH, "calib": INTRINSICS.T, **MASKS, "mask_table_paras": np.zeros((1, 7)),
            "mask_wall_paras": np.zeros((0, 0)), "note": "text", **changes}  # fmt: skip
    return written(root / f"{name}.mat", mat(**{key: value for key, value in data.items() if value is not None}))


def pictures(root, name="corridor_01", without=()):
    """Write a scene's pictures and return the arguments that they are loaded with."""
    white = dict.fromkeys(("mask_invalid", "mask_transp", "edges"), 255)
    masks = {key: png(mask * white.get(key, 1)) for key, mask in MASKS.items() if key not in without}
    for key, content in {"rgb": png(RGB[..., ::-1]), "depth": png(LEVELS), **masks}.items():
        written(root / key / f"{name}.png", content)
    written(root / "calib" / f"{name}.txt", b"560.5,561.25,321,239.5\n")
    return find_pictures(root)[name]


def test_both_layouts_have_the_truth_in_metres_planes_numbered_through_and_edges(tmp_path):
    for scene in (
        load_matrices(matrices(tmp_path), "ibims", "a"), load_pictures(*pictures(tmp_path), "ibims", "a")
    ):  # fmt: skip
        np.testing.assert_array_equal((scene.rgb * 255).round().permute(1, 2, 0), RGB)
        counted = (COLUMNS >= 3) & (ROWS >= 2)  # without what is invalid or behind glass
        np.testing.assert_allclose(scene.depth[0], np.where(counted, DEPTH, np.nan), rtol=1e-12)
        assert sorted(scene.regions) == ["edges", "planes"]
        planes, rows = scene.regions["planes"][0].numpy(), (0, 99, 100, 199, 200, 299, 300, 399, 400, 479)
        assert [planes[row, 5] for row in rows] == [1, 1, 2, 2, 0, 0, 3, 3, 4, 4]
        np.testing.assert_array_equal(scene.regions["edges"][0], COLUMNS == 320)


def test_scenes_without_some_planes_or_edges_are_read(tmp_path):
    empty = {"edges": COLUMNS * 0, "mask_wall": np.zeros((0, 0)), "mask_table": None}
    of_matrices = load_matrices(matrices(tmp_path, **empty), "ibims", "a")
    of_pictures = load_pictures(*pictures(tmp_path, without=("edges", "mask_wall", "mask_table")), "ibims", "a")
    for each in (of_matrices, of_pictures):
        assert list(each.regions) == ["planes"]
        np.testing.assert_array_equal(each.regions["planes"][0], ROWS >= 400)


def test_scenes_are_found_in_both_layouts_and_results_are_none(tmp_path):
    for name in ("office_02", "office_02_results", "office_10"):
        matrices(tmp_path / "ibims1_core_mat", name)
    pictures(tmp_path / "ibims1_core_raw", "corridor_01")
    written(tmp_path / "ibims1_core_raw/rgb/kitchen_01.png", png(RGB))
    assert list(find_matrices(tmp_path)) == ["office_02", "office_10"]
    assert list(find_pictures(tmp_path)) == ["corridor_01"]
    assert sorted(IBims(str(tmp_path), "found").scenes()) == ["corridor_01", "office_02", "office_10"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": None, "mask_transp": None}, "expected .* in a structure data, got no depth, mask_transp"),
        ({"depth": DEPTH[1:]}, r"depth: expected shape \(480, 640\), got \(479, 640\)"),
        ({"mask_floor": ROWS[1:]}, r"mask_floor: expected shape \(480, 640\), got \(479, 640\)"),
        ({"rgb": RGB / 255}, "rgb: expected 8 bits a channel, got float64"),
        ({"calib": INTRINSICS}, "expected fx 0 cx 0 fy cy 0 0 1 of a 480 x 640 picture"),
        ({"depth": -DEPTH}, "expected positive depth"),
        ({"mask_transp": ROWS * 0}, "expected at least one known pixel, all are holes"),
        ({"mask_wall": ROWS + 1}, "expected up to 255 planes, got 482"),
    ],
)
def test_matrices_that_do_not_fit_are_refused_in_one_line(tmp_path, capfd, changes, message):
    path = matrices(tmp_path, **changes)
    assert re.match(message, refused(lambda: load_matrices(path, "ibims", "a"), path, capfd))
