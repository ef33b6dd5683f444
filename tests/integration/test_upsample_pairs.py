"""Photos and depth maps that do not belong together get a warning of ``dsr upsample``, and right ones do not."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from upsampling import info
from upsampling import upsample as run_upsample

from dsr.notes import LIMITS
from dsr.synthetic.procedural.random_scene import render_random_scene

SCENES = (1, 5, 6, 11)  # Numbers of rendered scenes with edges in depth and photo
TURNS = {
    "mirrored left to right": lambda photo: photo[:, ::-1],
    "mirrored top to bottom": lambda photo: photo[::-1],
    "turned by 180 degrees": lambda photo: photo[::-1, ::-1],
    "turned by 90 degrees to the right": lambda photo: np.rot90(photo, 1),
    "turned by 90 degrees to the left": lambda photo: np.rot90(photo, -1),
}  # What is done to a photo


@pytest.fixture(scope="session")
def rendered():
    """Return photos (256, 256, 3) uint8 and depth maps (128, 128) in millimetres."""
    found = []
    for number in SCENES:
        scene = render_random_scene(11, number, 256).scene("procedural", str(number))
        rgb = (255 * scene.rgb).round().byte().permute(1, 2, 0).numpy()
        depth = scene.depth[0].numpy()[1::2, 1::2]
        found.append((rgb, (depth * 3000 / depth.max()).round().astype(np.uint16)))
    return found


def write(folder: Path, pairs):
    """Write pairs of photo and depth map, and return the options that name them."""
    folder.mkdir(exist_ok=True)
    photos, depths = [], []
    for number, (photo, depth) in enumerate(pairs):
        photos.append(str(folder / f"{number:02}_photo.png"))
        depths.append(str(folder / f"{number:02}_depth.png"))
        cv2.imwrite(photos[-1], photo[..., ::-1])
        cv2.imwrite(depths[-1], depth)
    return ["--rgb", *photos, "--depth", *depths, "--depth-unit", "mm"]


def upsample(options, out: Path, *more):
    return run_upsample(*options, "-o", out, "--method", "bicubic", "--only", "depth", *more)


def reported(out: Path):
    """Return the warnings of a result by code."""
    found = info(out)["warnings"]
    assert all(each["threshold"] == LIMITS[each["code"]] for each in found)
    return {each["code"]: each for each in found}


@pytest.mark.parametrize(("number", "turn"), [(3 * (place % 2), turn) for place, turn in enumerate(TURNS)])
def test_mirrored_and_turned_photos_are_reported(rendered, number, turn, tmp_path, capsys):
    photo, depth = rendered[number]
    options = write(tmp_path / "in", [(TURNS[turn](photo), depth)])
    assert upsample(options, tmp_path / "out") == 0
    said = capsys.readouterr().out
    warning = reported(tmp_path / "out")["photo-turned"]
    assert f"warning: {warning['message']}" in said
    assert warning["value"] >= warning["threshold"]


def test_photo_of_another_scene_is_reported(rendered, tmp_path):
    photo, depth = rendered[1][0], rendered[2][1]
    options = write(tmp_path / "in", [(photo, depth)])
    assert upsample(options, tmp_path / "out") == 0
    [warning] = reported(tmp_path / "out").values()
    assert warning["code"] == "photo-other"
    assert warning["value"] < warning["threshold"]


@pytest.mark.parametrize(("axis", "pixels"), [(0, 24), (1, 8)])
def test_photo_beside_its_depth_map_is_reported_with_the_pixels_of_the_photo(rendered, axis, pixels, tmp_path):
    photo, depth = rendered[3]
    moved = photo[:, pixels:] if axis else photo[pixels:]
    options = write(tmp_path / "in", [(moved, depth[:, : -pixels // 2] if axis else depth[: -pixels // 2])])
    assert upsample(options, tmp_path / "out") == 0
    warning = reported(tmp_path / "out")["edges-beside"]
    assert warning["value"] == pytest.approx(pixels, rel=0.15)
    assert warning["value"] >= warning["threshold"]


def test_lists_in_another_order_are_reported_once_before_the_work(rendered, tmp_path, capsys):
    photos, depths = zip(*rendered, strict=True)
    options = write(tmp_path / "in", zip(photos[1:] + photos[:1], depths, strict=True))
    assert upsample(options, tmp_path / "out") == 0
    said = capsys.readouterr().out
    for number in range(len(rendered)):
        warning = reported(tmp_path / "out" / f"{number:02}_photo")["photo-order"]
        assert warning["value"] == 4
        assert said.count(warning["message"]) == 1
    assert upsample(options, tmp_path / "block", "--shard", "2/2") == 0  # of which no frame fits another
    assert reported(tmp_path / "block" / "03_photo")["photo-order"]["value"] == 4


def test_right_pairs_are_left_alone(rendered, tmp_path):
    options = write(tmp_path / "in", rendered)
    assert upsample(options, tmp_path / "out", "--strict") == 0
    assert not any(reported(path.parent) for path in (tmp_path / "out").rglob("info.json"))


def test_near_duplicate_frames_in_another_order_are_left_alone(rendered, tmp_path):
    rng = np.random.default_rng(0)
    photo, depth = rendered[0]
    photos, depths = [], []
    for shift in (0, 2, 4, 6):
        noisy = (photo + rng.normal(0, 3, photo.shape)).clip(0, 255).astype(np.uint8)
        photos.append(noisy[:, shift : 240 + shift])
        noisy = (depth * rng.normal(1, 0.002, depth.shape)).astype(np.uint16)
        depths.append(noisy[:, shift // 2 : 120 + shift // 2])
    options = write(tmp_path / "in", zip(photos[1:] + photos[:1], depths, strict=True))
    assert upsample(options, tmp_path / "out") == 0
    results = list((tmp_path / "out").rglob("info.json"))
    assert len(results) == len(photos)
    assert not any("photo-order" in reported(path.parent) for path in results)


@pytest.mark.parametrize("case", ["noise on a wall", "photo without edges", "noise in the photo"])
def test_nothing_is_said_where_nothing_can_be_known(rendered, case, tmp_path):
    rng = np.random.default_rng(0)
    photo, depth = rendered[0]
    if case == "noise on a wall":
        depth = (2000 * rng.normal(1, 0.05, depth.shape)).astype(np.uint16)
    elif case == "photo without edges":
        photo = np.full_like(photo, 90)
    else:
        photo = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
        depth = depth[::4, ::4]
    options = write(tmp_path / "in", [(photo, depth), (photo, depth)])
    assert upsample(options, tmp_path / "out", "--strict") == 0
    assert not any(reported(path.parent) for path in (tmp_path / "out").rglob("info.json"))
