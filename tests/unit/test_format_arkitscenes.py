"""ARKitScenes, of files of our own: the lidar at 7.5, confidence and intrinsics, both splits, every damage named."""

import math
import re

import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.arkitscenes import NOTE, ARKitScenes, find_frames, load_frame

ROWS, COLUMNS = np.mgrid[0:1440, 0:1920]
TRUTH = (1000 + ROWS + COLUMNS // 2).astype(np.uint16)
MEASURED = (990 + 3 * ROWS + COLUMNS).astype(np.uint16)[:192, :256]
CONFIDENCE = (COLUMNS[:192, :256] % 3).astype(np.uint8)
NAME = "41069021_305.244"
CAMERA = "1920 1440 1590.25 1591.5 958.5 724.75"


TRUTH_PNG = png(np.where(ROWS < 2, 0, TRUTH).astype(np.uint16))
PHOTO_PNG = png(np.full((1440, 1920, 3), 51, np.uint8))


def frame(root, name=NAME, photos="wide", **changes):
    """Write a frame and return its five files."""
    contents = {photos: PHOTO_PNG, "highres_depth": TRUTH_PNG, "lowres_depth": png(MEASURED),
                "confidence": png(CONFIDENCE)}  # fmt: skip
    files = [
        written(root / folder / f"{name}.png", changes.get(folder, content)) for folder, content in contents.items()
    ]
    pincam = root / "wide_intrinsics" / f"{name}.pincam"
    return *files, written(pincam, changes.get("pincam", CAMERA.encode()))


def test_frame_has_metres_a_camera_and_the_lidar_at_seven_and_a_half(tmp_path):
    scene = load_frame(*frame(tmp_path), "arkitscenes", NAME)
    assert scene.depth[0, :2].isnan().all()
    assert scene.depth[0, 10, 20].item() == pytest.approx(1.020)
    assert list(scene.measured) == [7.5]
    assert scene.measured[7.5].isfinite().all()
    assert scene.measured[7.5][0, 10, 20].item() == pytest.approx(1.040)
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1590.25, 1591.5, 958.5, 724.75)
    assert (camera.width, camera.height, scene.unit.name) == (1920, 1440, "cm")


@pytest.mark.parametrize(("least", "fraction"), [(0, 1), (1, 2 / 3), (2, 1 / 3)])
def test_uncertain_pixels_of_the_lidar_become_holes(tmp_path, least, fraction):
    scene = load_frame(*frame(tmp_path), "arkitscenes", NAME, min_confidence=least)
    known = scene.measured[7.5][0].isfinite()
    np.testing.assert_array_equal(known, least <= CONFIDENCE)
    assert known.double().mean().item() == pytest.approx(fraction, abs=0.01)


def test_frame_without_intrinsics_gets_sixty_degrees_and_a_note(tmp_path):
    frame(tmp_path / "1")
    frame(tmp_path / "2", "41069022_1.500")[4].unlink()
    data = ARKitScenes(str(tmp_path))
    assert (data.load(NAME).notes, data.load("41069022_1.500").notes) == ((), (NOTE,))
    assert math.degrees(2 * math.atan(960 / data.load("41069022_1.500").camera.fx)) == pytest.approx(60)


def test_intrinsics_may_be_a_millisecond_off(tmp_path):
    pincam = frame(tmp_path)[4]
    pincam.rename(pincam.with_name("41069021_305.245.pincam"))
    assert find_frames(tmp_path)[NAME][4].name == "41069021_305.245.pincam"
    pincam.with_name("41069021_305.245.pincam").rename(pincam.with_name("41069021_305.246.pincam"))
    assert find_frames(tmp_path)[NAME][4] is None


def test_frames_are_found_in_both_splits_and_spellings(tmp_path):
    frame(tmp_path / "Validation/41069021")
    frame(tmp_path / "Validation/41069023", "41069023_2.000", "color")
    frame(tmp_path / "Training/41069022", "41069022_1.500")[3].unlink()
    frame(tmp_path / "Validation/41069024", "41069024_2.000")[1].unlink()
    assert list(find_frames(tmp_path, "validation")) == [NAME, "41069023_2.000"]
    assert list(find_frames(tmp_path, "training")) == ["41069022_1.500"]
    assert list(find_frames(tmp_path / "Training", "training")) == ["41069022_1.500"]
    assert len(find_frames(tmp_path)) == 3
    assert (ARKitScenes(str(tmp_path)).evaluation, ARKitScenes(str(tmp_path), "training").evaluation) == (True, False)
    with pytest.raises(ValueError, match=r"lowres_depth.*expected its confidence in the folder confidence"):
        ARKitScenes(str(tmp_path), "training", min_confidence=1).load("41069022_1.500")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"split": "test"}, "split: expected one of validation, training, got test"),
        ({"min_confidence": 3}, "min_confidence: expected 0, 1 or 2, got 3"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        ARKitScenes(str(tmp_path), **settings)


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"", "expected a picture"),
        (0, png(np.zeros((144, 192, 3), np.uint8)), "expected 1440 x 1920 pixels"),
        (1, TRUTH_PNG[:5000], "expected a picture"),
        (1, png(MEASURED), "expected 1440 x 1920 pixels"),
        (2, TRUTH_PNG, "expected 192 x 256 pixels"),
        (2, png(CONFIDENCE), "expected one channel of 16 bits"),
        (2, png(MEASURED * 0), "expected at least one known pixel, all are holes"),
        (3, png(MEASURED), "expected one channel of 8 bits"),
        (3, png(CONFIDENCE[1:]), "expected 192 x 256 pixels"),
        (3, png(CONFIDENCE + 1), "expected confidence from 0 to 2, got 3"),
        (3, png(CONFIDENCE * 0), "expected a pixel of confidence 1, there is none"),
        (4, b"1920 1440 1590 1590 960", "expected 6 numbers, got 5"),
        (4, b"1920 1440 1590 1590 960 x", "expected 6 numbers"),
        (4, b"256 192 212 212 127 96", "expected a camera of 1440 x 1920 pixels, got 192 x 256"),
        (4, b"1920 1440 0 1590 960 720", "expected fx 0 cx 0 fy cy 0 0 1 of a 1440 x 1920 picture"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = frame(tmp_path)
    files[which].write_bytes(content)
    assert re.match(
        message, refused(lambda: load_frame(*files, "arkitscenes", NAME, min_confidence=1), files[which], capfd)
    )
