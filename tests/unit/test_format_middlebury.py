"""Middlebury's formats: on files written here byte by byte, and on real ones."""

import cv2
import numpy as np
import pytest
import torch
from data_set_files import pfm

from dsr.data.middlebury import find_2014, find_levels, load_2014, load_levels

CALIBRATION = (
    "cam0=[ 100.5 0 3.25 ; 0 100.5 2 ; 0 0 1 ] \ncam1=[ 100.5 0 8.25 ; 0 100.5 2 ; 0 0 1 ]\n doffs= 5 \n"
    "baseline= 176.252\n width= 6\nheight= 4 \n ndisp= 73\n isint=0\n vmin= 8 \n"
)


def picture(path, height, width, value=128):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((height, width, 3), value, np.uint8))


def levels(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.asarray(values, np.uint8))


@pytest.fixture
def scene_2014(tmp_path):
    folder = tmp_path / "Recycle-perfect"
    picture(folder / "im0.png", 4, 6, 51)
    (folder / "calib.txt").write_text(CALIBRATION)
    disparity = 10.0 + 10 * np.arange(4)[:, None] + np.arange(6)
    disparity[1, 2] = 0
    (folder / "disp0.pfm").write_bytes(pfm(disparity))
    return folder


def test_depth_follows_from_disparity_with_and_without_the_offset(scene_2014):
    scene = load_2014(scene_2014, "middlebury", "recycle")
    assert (scene.dataset, scene.name, scene.camera.doffs) == ("middlebury", "recycle", 5)
    assert scene.depth[0, 2, 3] == pytest.approx(0.176252 * 100.5 / (33 + 5))
    assert torch.equal(scene.depth.isnan().nonzero(), torch.tensor([[0, 1, 2]]))
    assert scene.rgb.unique().tolist() == pytest.approx([0.2])
    without = load_2014(scene_2014, "middlebury", "recycle", offset=False)
    assert (without.depth[0, 2, 3], without.camera.doffs) == (pytest.approx(0.176252 * 100.5 / 33), 0)


def test_disparity_name_of_the_evaluation_kit_is_known(scene_2014):
    (scene_2014 / "disp0.pfm").rename(scene_2014 / "disp0GT.pfm")
    assert load_2014(scene_2014, "middlebury", "recycle").depth[0, 0, 0] == pytest.approx(0.176252 * 100.5 / 15)


def test_folders_are_found_by_name_and_perfect_ones_are_preferred(scene_2014):
    root = scene_2014.parent
    for name in ("Recycle-imperfect", "Vintage-imperfect", "Piano"):
        (root / name).mkdir()
        (root / name / "calib.txt").write_text(CALIBRATION)
    (root / "notes").mkdir()
    assert {name: path.name for name, path in find_2014(root).items()} == {
        "recycle": "Recycle-perfect", "vintage": "Vintage-imperfect", "piano": "Piano",
    }  # fmt: skip


DAMAGED_CALIBRATIONS = {
    "": "cam0: expected [f 0 cx; 0 f cy; 0 0 1], got nothing",
    CALIBRATION.replace("cam0=[", "cam0="): "cam0: expected [f 0 cx; 0 f cy; 0 0 1], got 100.5 0 3.25",
    CALIBRATION.replace("[ 100.5 0 3.25", "[ f 0 3.25"): "cam0: expected a number, got f",
    CALIBRATION.replace("doffs= 5", "doffs= five"): "doffs: expected a number, got five",
    CALIBRATION.replace(" width= 6\n", ""): "width: expected a number, got nothing",
    CALIBRATION.replace(" width= 6", " width= 6.5"): "width: expected a number, got 6.5",
    CALIBRATION.replace("height= 4", "height= -4"): "camera height: expected a positive whole number, got -4",
    CALIBRATION.replace("baseline= 176.252", "baseline= nan"): "baseline: expected a number, got nan",
    CALIBRATION.replace("baseline= 176.252", "baseline= 0"): "camera baseline: expected a positive number of metres",
}


@pytest.mark.parametrize("text", DAMAGED_CALIBRATIONS)
def test_damaged_calibration_is_refused_in_one_line(scene_2014, text):
    (scene_2014 / "calib.txt").write_text(text)
    with pytest.raises(ValueError, match=r"calib\.txt: ") as refusal:
        load_2014(scene_2014, "middlebury", "recycle")
    message = str(refusal.value)
    assert DAMAGED_CALIBRATIONS[text] in message
    assert message.count("\n") == 0


def test_levels_of_2006_are_pixels_of_the_full_size(tmp_path):
    ground = np.full((370, 40), 90)
    ground[0, 0] = 0
    levels(tmp_path / "Aloe" / "disp1.png", ground)
    picture(tmp_path / "Aloe" / "view1.png", 370, 40)
    (tmp_path / "Aloe" / "dmin.txt").write_text("270\n")
    [(name, files)] = find_levels(tmp_path).items()
    scene = load_levels(files, "middlebury2006", name, 2006)
    assert (name, scene.camera.fx, scene.camera.doffs) == ("aloe", pytest.approx(3740 / 3), 90)
    assert scene.depth[0, 5, 5] == pytest.approx(3740 * 0.16 / (90 + 270))
    assert scene.depth.isnan().sum() == 1
    (tmp_path / "Aloe" / "dmin.txt").unlink()  # then the shift is Art's
    scene = load_levels(find_levels(tmp_path)["aloe"], "middlebury2006", "aloe", 2006)
    assert scene.depth[0, 5, 5] == pytest.approx(3740 * 0.16 / (90 + 200))


def test_levels_of_2003_and_2001_are_quarters_and_eighths_of_pixels(tmp_path):
    levels(tmp_path / "cones" / "disp2.png", np.full((375, 450), 100))
    picture(tmp_path / "cones" / "im2.png", 375, 450)
    scene = load_levels(find_levels(tmp_path)["cones"], "middlebury2003", "cones", 2003)
    assert scene.depth[0, 3, 3] == pytest.approx(0.08 * 1500 / (25 + 52))
    levels(tmp_path / "venus" / "disp2.pgm", np.full((20, 30), 100))
    picture(tmp_path / "venus" / "im2.ppm", 20, 30)
    scene = load_levels(find_levels(tmp_path)["venus"], "middlebury2001", "venus", 2001)
    assert scene.depth[0, 3, 3] == pytest.approx(0.08 * 1500 / (12.5 + 52))


@pytest.mark.parametrize("smooth", [True, False])
def test_terraces_become_slopes_unless_requested(tmp_path, smooth):
    ramp = np.round(60 + 0.05 * np.arange(200))[None].repeat(370, axis=0)
    levels(tmp_path / "Aloe" / "disp1.png", ramp)
    picture(tmp_path / "Aloe" / "view1.png", 370, 200)
    scene = load_levels(find_levels(tmp_path)["aloe"], "middlebury2006", "aloe", 2006, smooth=smooth)
    steps = scene.depth[0, 0, 20:180].diff()
    assert bool((steps != 0).all()) is smooth


@pytest.mark.parametrize(
    ("height", "shift", "message"),
    [
        (700, "0", "view1.png: expected 700 x 40 pixels"), (370, "many", "dmin.txt: dmin: expected a number, got many"),
        (200, "0", "disp1.png: expected a height near 1110, a half or a third, got 200"),
    ],
)  # fmt: skip
def test_levels_that_do_not_fit_are_refused_in_one_line(tmp_path, height, shift, message):
    picture(tmp_path / "Aloe" / "view1.png", 370, 40)
    levels(tmp_path / "Aloe" / "disp1.png", np.ones((height, 40)))
    (tmp_path / "Aloe" / "dmin.txt").write_text(shift)
    with pytest.raises(ValueError, match=message):
        load_levels(find_levels(tmp_path)["aloe"], "middlebury2006", "aloe", 2006)


def test_disparity_that_no_camera_sees_is_refused(scene_2014):
    (scene_2014 / "disp0.pfm").write_bytes(pfm(np.full((4, 6), 1.0)).replace(b"\x00\x00\x80\x3f", b"\x00\x00\xc0\xc0"))
    with pytest.raises(ValueError, match=r"disp0\.pfm: expected disparities above -5 pixels, got -6"):
        load_2014(scene_2014, "middlebury", "recycle")


def test_real_scenes_of_2014_are_read(shared):
    found = find_2014(shared / "real" / "middlebury2014")
    assert sorted(found) == [
        "adirondack", "artl", "motorcycle", "piano", "pipes", "playroom", "playtable", "recycle", "shelves", "teddy",
    ]  # fmt: skip
    scene = load_2014(found["recycle"], "middlebury", "recycle")
    assert scene.rgb.shape == (3, 486, 720)
    assert 1.2 < scene.depth.nanmedian() < 2.6
    assert scene.depth.isnan().double().mean() == pytest.approx(0.0167, abs=1e-3)


def test_real_scenes_of_2005_and_2006_are_read(shared):
    found = find_levels(shared / "real" / "middlebury2006")
    scene = load_levels(found["aloe"], "middlebury2006", "aloe", 2006)
    assert (len(found), scene.rgb.shape) == (8, (3, 370, 427))
    assert scene.depth.isnan().double().mean() == pytest.approx(0.029, abs=1e-3)
    found = find_levels(shared / "real" / "middlebury2005")
    assert sorted(found) == ["art", "dolls", "moebius"]
    scene = load_levels(found["art"], "middlebury2005", "art", 2005)
    assert scene.rgb.shape == (3, 1088, 1376)
    assert {factor: tuple(coarse.shape) for factor, coarse in scene.measured.items()} == {
        4: (1, 272, 344), 8: (1, 136, 172),
    }  # fmt: skip
    kit = load_2014(find_2014(shared / "real" / "middlebury2014")["artl"], "middlebury", "artl")
    torch.testing.assert_close(scene.depth.nanmedian(), kit.depth.nanmedian(), rtol=0.01, atol=0)
    coarse, fine = scene.measured[4], scene.depth
    torch.testing.assert_close(coarse.nanmedian(), fine.nanmedian(), rtol=0.02, atol=0)
