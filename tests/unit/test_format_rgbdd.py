"""RGB-D-D: its owners' layout and the one in circulation, splits, the phone's map at 2.667, every damage named."""

import math
import re

import cv2
import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png

from dsr.data.frame_files import NO_CAMERA, load_pair
from dsr.data.rgbdd import RGBDD, find_frames, load_measured_frame

ROWS, COLUMNS = np.mgrid[0:384, 0:512]
DEPTH = (1000 + 2 * ROWS + COLUMNS).astype(np.uint16)
MEASURED = (900 + ROWS + 3 * COLUMNS).astype(np.uint16)[:144, :192]


def written(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


PHOTO = cv2.imencode(".jpg", np.full((384, 512, 3), 51, np.uint8))[1].tobytes()
FLAT = ("RGB/{}_RGB.jpg", "Depth/{}_HR_gt.png", "DepthLR/{}_LR_fill_depth.png")
OWNERS = ("{0}/{0}_RGB.jpg", "{0}/{0}_HR_gt.png", "{0}/{0}_LR_fill_depth.png")


def image(root, name, layout=FLAT, count=3):
    """Write the first ``count`` files of an image."""
    contents = (PHOTO, png(DEPTH), png(MEASURED))
    return tuple(
        written(root / path.format(name), content) for path, content in zip(layout[:count], contents, strict=False)
    )


def test_image_is_metres_with_sixty_degrees_of_view(tmp_path):
    scene = load_measured_frame(*image(tmp_path, "20200509112638"), "rgbdd_real", "20200509112638")
    assert scene.depth[0, 10, 20].item() == pytest.approx(1.040)
    [(ratio, measured)] = scene.measured.items()
    assert ratio == pytest.approx(8 / 3)
    assert measured[0, 10, 20].item() == pytest.approx(0.970)
    assert (measured.shape, scene.unit.name) == ((1, 144, 192), "cm")
    assert math.degrees(2 * math.atan(256 / scene.camera.fx)) == pytest.approx(60)
    assert (scene.camera.cx, scene.camera.cy, scene.camera.fx) == (255.5, 191.5, scene.camera.fy)
    assert scene.rgb.unique().tolist() == pytest.approx([0.2])
    depth_alone = load_pair(*image(tmp_path, "1", count=2), "rgbdd", "1")
    assert (depth_alone.name, dict(depth_alone.measured)) == ("1", {})


def test_both_layouts_and_their_splits_are_found(tmp_path):
    image(tmp_path / "flat", "20200101000002")
    image(tmp_path / "flat", "20200101000001", count=2)
    image(tmp_path / "owners/portraits/portraits_test", "20200101000003", OWNERS)
    image(tmp_path / "owners/plants/plants_train", "20200101000004", OWNERS)
    image(tmp_path / "owners/models/models_train", "20200101000005", OWNERS, count=2)
    image(tmp_path / "owners/lights/lights_test", "20200101000006", OWNERS)
    assert list(find_frames(tmp_path)) == [f"2020010100000{number}" for number in (1, 2, 3, 4, 5)]
    assert list(find_frames(tmp_path, "test")) == [f"2020010100000{number}" for number in (1, 2, 3)]
    assert list(find_frames(tmp_path, "test", measured=True)) == [f"2020010100000{number}" for number in (2, 3)]
    assert list(find_frames(tmp_path, "train")) == [f"2020010100000{number}" for number in (4, 5)]
    assert list(find_frames(tmp_path / "owners", "train", measured=True)) == ["20200101000004"]
    with pytest.raises(ValueError, match="expected a directory"):
        find_frames(tmp_path / "nowhere")


def test_test_images_are_to_evaluate_on_and_the_others_to_train_on(tmp_path):
    image(tmp_path, "20200101000002")
    image(tmp_path / "plants/plants_train", "20200101000004", OWNERS)
    test, train = RGBDD(str(tmp_path), False, scenes="found"), RGBDD(str(tmp_path), True, "train", "found")
    assert (test.name, test.evaluation, test.scenes()) == ("rgbdd", True, ["20200101000002"])
    assert (train.name, train.evaluation, train.scenes()) == ("rgbdd_real", False, ["20200101000004"])
    assert test.load("20200101000002").notes == (NO_CAMERA,)
    with pytest.raises(ValueError, match=r"expected all scenes in .* got 1 of 405 scenes; .*dataset\.scenes=found"):
        RGBDD(str(tmp_path), real=False)
    with pytest.raises(ValueError, match="got 1 of 2215 scenes"):
        RGBDD(str(tmp_path), real=False, split="train")
    with pytest.raises(ValueError, match="split: expected one of test, train, got all"):
        RGBDD(str(tmp_path), real=False, split="all")


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"", "expected a picture"),
        (0, PHOTO[:200], "expected a picture"),
        (1, png(DEPTH)[:500], "expected a picture"),
        (1, png((DEPTH // 256).astype(np.uint8)), "expected one channel of 16 bits"),
        (1, png(DEPTH[:, 1:]), "expected 384 x 512 pixels"),
        (1, png(DEPTH * 0), "expected at least one known pixel, all are holes"),
        (2, png(MEASURED[1:]), "expected 144 x 192 pixels"),
        (2, png(DEPTH), "expected 144 x 192 pixels"),
        (2, b"text", "expected a picture"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = image(tmp_path, "20200509112638")
    files[which].write_bytes(content)
    assert re.match(
        message, refused(lambda: load_measured_frame(*files, "rgbdd_real", "20200509112638"), files[which], capfd)
    )


def test_real_images_are_read(shared):
    assert len(RGBDD(str(shared / "modern/RGBDD"), real=False, scenes="found").scenes()) == 21
    data = RGBDD(str(shared / "real/rgbdd_real"), real=True, scenes="found")
    assert data.scenes() == ["20200509112638", "20200509114515"]
    scene = data.load("20200509112638")
    [measured] = scene.measured.values()
    assert abs(scene.depth.median() - measured.median()) < 0.05
