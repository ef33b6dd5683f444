"""Middlebury's formats: what single scenes of them have of their own, and real ones."""

import re

import numpy as np
import pytest
from data_set_files import pfm, photo, write_frame
from small_files import encoded_png as png
from small_files import written

from dsr.data.middlebury import find_2014, find_levels, load_2014, load_levels


@pytest.fixture
def folder(tmp_path):
    """The folder of a scene of 2014."""
    write_frame("middlebury", tmp_path)
    return tmp_path / "Recycle-perfect"


def test_offset_may_be_left_out_and_the_evaluation_kits_name_of_the_disparity_is_known(folder):
    (folder / "disp0.pfm").rename(folder / "disp0GT.pfm")
    for offset, doffs in ((True, 5), (False, 0)):
        scene = load_2014(folder, "middlebury", "recycle", offset=offset)
        assert scene.depth[0, 10, 20] == pytest.approx(0.176252 * 100.5 / (50 + doffs))
        assert scene.camera.doffs == doffs


def test_folders_are_found_by_name_and_perfect_ones_are_preferred(folder):
    root = folder.parent
    for name in ("Recycle-imperfect", "Vintage-imperfect", "Piano"):
        written(root / name / "calib.txt", b"")
    (root / "notes").mkdir()
    names = {"recycle": "Recycle-perfect", "vintage": "Vintage-imperfect", "piano": "Piano"}
    assert {name: path.name for name, path in find_2014(root).items()} == names


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (".*", "", "cam0: expected [f 0 cx; 0 f cy; 0 0 1], got nothing"),
        (r"cam0=\[", "cam0=", "cam0: expected [f 0 cx; 0 f cy; 0 0 1], got 100.5 0 3.25"),
        (r"\[ 100.5 0 3.25", "[ f 0 3.25", "cam0: expected a number, got f"),
        ("doffs= 5", "doffs= five", "doffs: expected a number, got five"),
        (" width= 68\n", "", "width: expected a number, got nothing"),
        (" width= 68", " width= 6.5", "width: expected a number, got 6.5"),
        ("height= 52", "height= -4", "camera height: expected a positive whole number, got -4"),
        ("baseline= 176.252", "baseline= nan", "baseline: expected a number, got nan"),
        ("baseline= 176.252", "baseline= 0", "camera baseline: expected a positive number of metres"),
    ],
)
def test_damaged_calibration_is_refused_in_one_line(folder, old, new, message):
    path = folder / "calib.txt"
    path.write_text(re.sub(old, new, path.read_text(), flags=re.DOTALL))
    with pytest.raises(ValueError, match=f"^{path}: {re.escape(message)}.*$"):
        load_2014(folder, "middlebury", "recycle")


def test_disparity_that_no_camera_sees_is_refused(folder):
    written(folder / "disp0.pfm", pfm(np.full((52, 68), 1.0)).replace(b"\x00\x00\x80\x3f", b"\x00\x00\xc0\xc0"))
    with pytest.raises(ValueError, match=r"disp0\.pfm: expected disparities above -5 pixels, got -6"):
        load_2014(folder, "middlebury", "recycle")


def levels(root, year, photo_name, disparity, values):
    """Write a scene of levels and return it as it is loaded."""
    values = np.asarray(values, np.uint8)
    written(root / "Scene" / photo_name, png(photo(*values.shape)))
    written(root / "Scene" / disparity, png(values))
    return load_levels(find_levels(root)["scene"], f"middlebury{year}", "scene", year)


def test_shift_of_2006_is_that_of_art_where_it_is_missing(tmp_path):
    scene = levels(tmp_path, 2006, "view1.png", "disp1.png", np.full((370, 40), 90))
    assert scene.depth[0, 5, 5] == pytest.approx(3740 * 0.16 / (90 + 200))


def test_levels_of_2003_and_2001_are_quarters_and_eighths_of_pixels(tmp_path):
    scene = levels(tmp_path / "a", 2003, "im2.png", "disp2.png", np.full((375, 450), 100))
    assert scene.depth[0, 3, 3] == pytest.approx(0.08 * 1500 / (25 + 52))
    scene = levels(tmp_path / "b", 2001, "im2.ppm", "disp2.pgm", np.full((20, 30), 100))
    assert scene.depth[0, 3, 3] == pytest.approx(0.08 * 1500 / (12.5 + 52))


@pytest.mark.parametrize("smooth", [True, False])
def test_terraces_become_slopes_unless_requested(tmp_path, smooth):
    levels(tmp_path, 2006, "view1.png", "disp1.png", np.round(60 + 0.05 * np.arange(200))[None].repeat(370, axis=0))
    scene = load_levels(find_levels(tmp_path)["scene"], "middlebury2006", "scene", 2006, smooth=smooth)
    assert bool((scene.depth[0, 0, 20:180].diff() != 0).all()) is smooth


@pytest.mark.parametrize(
    ("height", "shift", "message"),
    [
        (700, b"0", "view1.png: expected 700 x 40 pixels"),
        (370, b"many", "dmin.txt: dmin: expected a number, got many"),
        (200, b"0", "disp1.png: expected a height near 1110, 1/2 or 1/3, got 200"),
    ],
)  # fmt: skip
def test_levels_that_do_not_fit_are_refused_in_one_line(tmp_path, height, shift, message):
    write_frame("middlebury2006", tmp_path, disp1_png=png(np.ones((height, 40), np.uint8)), dmin_txt=shift)
    with pytest.raises(ValueError, match=message):
        load_levels(find_levels(tmp_path)["aloe"], "middlebury2006", "aloe", 2006)
