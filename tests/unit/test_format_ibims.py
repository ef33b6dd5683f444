"""iBims-1, of files of our own in both of its layouts: camera, truth, planes and edges, every damage named."""

import re

import numpy as np
import pytest
import scipy.io
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.ibims import IBims, find_matrices, find_pictures, load_matrices, load_pictures

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
LEVELS = (2000 + 20 * ROWS + 3 * COLUMNS).astype(np.uint16)
LEVELS[0, 0] = 0
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
    path = root / f"{name}.mat"
    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(path, {"data": {key: value for key, value in data.items() if value is not None}})
    return path


def pictures(root, name="corridor_01", without=()):
    """Write a scene's pictures and return the arguments that they are loaded with."""
    masks = {
        key: png(mask * (255 if key in ("mask_invalid", "mask_transp", "edges") else 1)) for key, mask in MASKS.items()
    }
    contents = {"rgb": png(RGB[..., ::-1]), "depth": png(LEVELS), **masks}
    for key, content in contents.items():
        if key not in without:
            written(root / key / f"{name}.png", content)
    written(root / "calib" / f"{name}.txt", b"560.5,561.25,321,239.5\n")
    return find_pictures(root)[name]


@pytest.fixture(params=["matrices", "pictures"])
def scene(request, tmp_path):
    if request.param == "matrices":
        return load_matrices(matrices(tmp_path), "ibims", "a")
    return load_pictures(*pictures(tmp_path), "ibims", "a")


def test_camera_counts_pixels_from_0(scene):
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (560.5, 561.25, 320, 238.5)
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_array_equal((scene.rgb * 255).round().permute(1, 2, 0), RGB)


def test_truth_is_metres_without_what_is_invalid_or_behind_glass(scene):
    counted = (COLUMNS >= 3) & (ROWS >= 2)
    np.testing.assert_allclose(scene.depth[0], np.where(counted, DEPTH, np.nan), rtol=1e-12)
    assert scene.measured == {}


def test_planes_are_numbered_through_and_edges_are_lines(scene):
    assert sorted(scene.regions) == ["edges", "planes"]
    planes = scene.regions["planes"][0].numpy()
    assert [planes[row, 5] for row in (0, 99, 100, 199, 200, 299, 300, 399, 400, 479)] == [1, 1, 2, 2, 0, 0, 3, 3, 4, 4]
    np.testing.assert_array_equal(scene.regions["edges"][0], COLUMNS == 320)


def test_scenes_without_some_planes_or_edges_are_read(tmp_path):
    empty = {"edges": COLUMNS * 0, "mask_wall": np.zeros((0, 0)), "mask_table": None}
    of_matrices = load_matrices(matrices(tmp_path, **empty), "ibims", "a")
    of_pictures = load_pictures(*pictures(tmp_path, without=("edges", "mask_wall", "mask_table")), "ibims", "a")
    for each in (of_matrices, of_pictures):
        assert list(each.regions) == ["planes"]
        np.testing.assert_array_equal(each.regions["planes"][0], ROWS >= 400)


def test_scenes_are_found_in_both_layouts_and_results_are_none(tmp_path):
    matrices(tmp_path / "ibims1_core_mat", "office_02")
    matrices(tmp_path / "ibims1_core_mat", "office_02_results")
    matrices(tmp_path / "ibims1_core_mat", "office_10")
    pictures(tmp_path / "ibims1_core_raw", "corridor_01")
    (tmp_path / "ibims1_core_raw/rgb/kitchen_01.png").write_bytes(png(RGB))
    assert list(find_matrices(tmp_path)) == ["office_02", "office_10"]
    assert list(find_pictures(tmp_path)) == ["corridor_01"]
    data = IBims(str(tmp_path), "found")
    assert sorted(data.scenes()) == ["corridor_01", "office_02", "office_10"]
    assert data.evaluation
    assert all(data.load(name).name == name for name in data.scenes())
    with pytest.raises(ValueError, match="got 3 of 100 scenes"):
        IBims(str(tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": None, "mask_transp": None}, "expected a structure data with .*, got none of depth, mask_transp"),
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


@pytest.mark.parametrize("damage", [lambda whole: b"", lambda whole: b"text", lambda whole: whole[: len(whole) // 2]])
def test_damaged_matrices_are_refused_in_one_line(tmp_path, capfd, damage):
    path = matrices(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    assert refused(lambda: load_matrices(path, "ibims", "a"), path, capfd).startswith("expected a MATLAB file")
    path.unlink()
    assert refused(lambda: load_matrices(path, "ibims", "a"), path, capfd).startswith("expected a MATLAB file")
