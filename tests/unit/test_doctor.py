"""The doctor: a check finds the one fault that the test put in, with its number, and none finds any in sound scenes."""

import json
import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from small_scenes import room

from dsr.cli import main
from dsr.doctor.scenes import CHECKS, examine, examine_directory, find_rounding, with_depth
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.io.images import read_rgb
from dsr.sample import Scene

SIZE = 256
CAMERA = Camera(SIZE, SIZE, 240.0, 240.0, 127.5, 127.5, baseline=0.2)


def room_scene(camera=CAMERA, turn=0.0):
    """Return the room as a scene: every surface of its own colour, with noise."""
    depth, surface = room(camera, turn)
    rng = np.random.default_rng(3)
    colours = rng.uniform(0.1, 0.9, (12, 3))
    photo = colours[surface].transpose(2, 0, 1) + 0.02 * rng.standard_normal((3, *surface.shape))
    return Scene("made", "room", torch.from_numpy(photo.clip(0, 1)).float(), camera, torch.from_numpy(depth)[None])


@pytest.fixture(scope="module")
def straight():
    """Return a room seen along its floor and walls: exactly equal depth along lines and all over the wall opposite."""
    return room_scene()


@pytest.fixture(scope="module")
def sound():
    """Return a room in which no surface faces the camera."""
    return room_scene(turn=17.0)


def changed(scene, depth):
    """Return the scene with a depth that is made of its own, (H, W) array to (H, W) array."""
    return replace(scene, depth=torch.from_numpy(np.asarray(depth(scene.depth[0].numpy())))[None])


def with_camera(scene, **values):
    return replace(scene, camera=replace(scene.camera, **values))


def wrong(scene):
    """Return level, message and advice by check of what is worse than a note."""
    found = [each for each in examine(scene) if each.level in ("warning", "problem")]
    assert all(each.advice and "\n" not in each.message + each.advice for each in found)
    return {each.check: each[1:] for each in found}


def of(scene, check):
    """Return the first finding of one check."""
    return next(function for function in CHECKS if function.__name__ == f"check_{check}")(scene)[0]


def test_sound_rooms_pass_every_check(straight, sound):
    for scene in (straight, sound):
        assert [(finding.check, finding.level) for finding in examine(scene)] == [
            (check.__name__.removeprefix("check_"), "ok") for check in CHECKS
        ]


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 3), (5, 4), (16, 16), (40, 33)])
def test_pictures_of_any_size_are_examined(size):
    height, width = size
    camera = Camera(width, height, 30.0, 30.0, (width - 1) / 2, (height - 1) / 2)
    depth = 1 + torch.rand(1, height, width, dtype=torch.float64)
    depth[:, 0, 0] = torch.nan if height * width > 1 else 1.0
    examine(Scene("made", "small", torch.rand(3, height, width), camera, depth))


RAYS = CAMERA.ray_lengths().numpy()
SCATTERED = np.random.default_rng(5).random((SIZE, SIZE)) < 0.05
NOISE = np.random.default_rng(6).standard_normal((SIZE, SIZE))


def values(depth):
    return lambda scene: changed(scene, depth)


def enlarged(factor):
    return values(lambda z: z[::factor, ::factor].repeat(factor, 0).repeat(factor, 1)[:SIZE, :SIZE])


def marked(value):
    return values(lambda z: np.where(SCATTERED, value, z))


def of_size(scale):
    other = CAMERA.rescale(round(SIZE * scale), round(SIZE * scale))
    return lambda scene: with_camera(scene, fx=other.fx, fy=other.fy, cx=other.cx, cy=other.cy)


def rolled(right, down):
    return lambda scene: replace(scene, rgb=scene.rgb.roll((down, right), (1, 2)))


def flipped(*axes):
    return lambda scene: replace(scene, rgb=scene.rgb.flip(axes))


def rounded_between_extremes(z):
    step = (z.max() - z.min()) / 255
    return z.min() + np.round((z - z.min()) / step) * step


def in_whole_disparities(scene):
    disparity = to_range(scene.depth, CAMERA, "disparity").round()
    return replace(scene, depth=from_range(disparity, CAMERA, "disparity"))


BESIDE = "the photo's edges are {} of the depth edges$"
MARK = f"{SCATTERED.mean():.1%} of the valid pixels have exactly the {{}} value, {{}} m"
FAULTS = {
    "metres in millimetres": (values(lambda z: z * 1000), "units", "problem", "farther", 'x 0.001 .*"depth_unit"'),
    "millimetres in metres": (values(lambda z: z * 0.001), "units", "problem", "nearer", 'x 1000 .*"depth_unit"'),
    "measured map in another unit": (
        lambda scene: replace(scene, measured={4: scene.depth[:, 2::4, 2::4] * 4}),
        "units", "problem", "the measured map at x4 is 4 times as far as the high-resolution depth$", "",
    ),
    "camera twice as large": (of_size(2), "intrinsics", "problem", r"2 times as large \(512 x 512\)",
                              "divide them by 2"),
    "principal point to the left": (
        lambda scene: with_camera(scene, cx=127.5 - 0.3 * SIZE),
        "intrinsics", "warning", "is 30% of the width left of the centre and 0% of the height above it",
        "check cx and cy",
    ),
    "wide": (lambda scene: with_camera(scene, fx=35.0, fy=35.0), "intrinsics", "warning",
             "fx 35 px gives a horizontal field of view of 149 degrees", ""),
    "narrow": (lambda scene: with_camera(scene, fx=3000.0, fy=3000.0), "intrinsics", "warning", "of 4.89 degrees", ""),
    "photo to the right": (rolled(6, 0), "registration", "warning", BESIDE.format("6 px right, 0 px below"), ""),
    "photo above": (rolled(3, -5), "registration", "warning", BESIDE.format("3 px right, 5 px above"), ""),
    "mirrored": (flipped(2), "registration", "problem", "with the photo mirrored left to right", ""),
    "upside down": (flipped(1), "registration", "problem", "with the photo mirrored top to bottom", ""),
    "rotated": (flipped(1, 2), "registration", "problem", "with the photo turned by 180 degrees", ""),
    "largest of 16 bits": (marked(65.535), "holes", "warning", MARK.format("largest", "65.535"), '"hole_value"'),
    "a value apart": (marked(7.77), "holes", "warning", MARK.format("largest", "7.77"), '"hole_value"'),
    "almost 0": (marked(0.0001), "holes", "warning", MARK.format("smallest", "0.0001"), '"hole_value"'),
    "most missing": (values(lambda z: np.where(np.arange(SIZE)[:, None] < 128, np.nan, z)), "holes", "warning",
                     "50.0% of the pixels are valid$", ""),
    "whole millimetres": (values(lambda z: np.round(z, 3)), "precision", "warning",
                          "depth comes in steps of 1 mm, .* one step tilts a surface by", ""),
    "8 bits": (values(rounded_between_extremes), "precision", "problem", r"distinct values \(8 bits hold 256\)", ""),
    "whole disparities": (in_whole_disparities, "precision", "problem", "^disparity comes in steps of 1 px, ", ""),
    "enlarged 8 times": (enlarged(8), "precision", "problem", "every value is repeated 8 times across and down", ""),
    "along the ray": (values(lambda z: z * RAYS), "planes", "problem", "depth looks like distance along the ray: ",
                      '"perspective"'),
    "along the ray with noise": (values(lambda z: z * RAYS * (1 + 0.002 * NOISE)), "planes", "problem", "", ""),
    "divided by the ray": (values(lambda z: z / RAYS), "planes", "problem",
                           "depth was read as distance along the ray but looks orthogonal in the file: ",
                           '"orthogonal"'),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_alone_is_found_with_its_figures(fault, sound):
    change, check, level, message, advice = FAULTS[fault]
    found = wrong(change(sound))
    assert list(found) == [check]
    assert found[check][0] == level
    assert re.search(message, found[check][1])
    assert re.search(advice, found[check][2])


LEVELS = {
    "principal point a little below": (lambda scene: with_camera(scene, cy=127.5 + 0.12 * SIZE), "intrinsics", "note"),
    "principal point hardly below": (lambda scene: with_camera(scene, cy=127.5 + 0.08 * SIZE), "intrinsics", "ok"),
    "telephoto": (lambda scene: with_camera(scene, fx=2000.0, fy=2000.0), "intrinsics", "note"),
    "flat": (values(lambda z: np.where(SCATTERED, np.nan, 2.0)), "registration", "note"),
    "some holes": (values(lambda z: np.where(np.arange(SIZE)[:, None] < 64, np.nan, z)), "holes", "note"),
    "few holes": (values(lambda z: np.where(np.arange(SIZE)[:, None] < 10, np.nan, z)), "holes", "ok"),
    "tenths of millimetres": (values(lambda z: np.round(z, 4)), "precision", "ok"),
    "rounding below the noise": (values(lambda z: np.round(z * (1 + 0.005 * NOISE), 3)), "precision", "ok"),
    "noise": (values(lambda z: z * (1 + 0.002 * NOISE)), "planes", "ok"),
}


@pytest.mark.parametrize("case", LEVELS)
def test_what_may_be_right_is_no_warning(case, sound):
    change, check, level = LEVELS[case]
    assert of(change(sound), check).level == level


@pytest.mark.parametrize(("factor", "text"), [(1000, "200 m"), (0.001, "0.2 mm")])
def test_baseline_in_another_unit_is_named_where_depth_is_off_by_the_same_factor(sound, factor, text):
    scene = with_camera(changed(sound, lambda z: z * factor), baseline=0.2 * factor)
    [advice] = [finding.advice for finding in examine(scene) if finding.level == "problem"]
    assert f'set "baseline_unit" in camera.json: the baseline of {text} is off by the same factor' in advice


def test_swapped_intrinsics_are_found():
    camera = Camera(320, 240, 300.0, 301.0, 159.5, 119.5)
    sound = room_scene(camera, 17.0)
    assert wrong(sound) == {}
    _, message, advice = wrong(with_camera(sound, fy=159.5, cx=301.0))["intrinsics"]
    assert "fx 300, fy 159.5, cx 301, cy 119.5 px" in message
    assert advice == "correct the order: fy is the number given as cx, cx is the number given as fy"


def test_unrelated_photo_is_found(sound):
    other = torch.from_numpy(np.indices((SIZE, SIZE)) // 37 % 2).float().sum(0).expand(3, -1, -1) / 2
    [finding] = [finding for finding in examine(replace(sound, rgb=other)) if finding.level != "ok"]
    assert (finding.check, finding.level) == ("registration", "warning")
    assert finding.message.startswith("the photo seems to show something else")


def test_narrow_holes_are_no_edges(sound):
    depth = sound.depth.clone()
    depth[:, ::8] = torch.nan
    depth[:, :, ::8] = torch.nan
    assert of(replace(sound, depth=depth), "registration").level == "ok"
    assert of(replace(sound, depth=depth, rgb=sound.rgb.flip(2)), "registration").level == "problem"


def test_rounding_has_its_step_and_its_tilt(sound, straight):
    rounding = find_rounding(changed(sound, lambda z: np.round(z, 4)))
    assert rounding is not None
    tilt = math.degrees(math.atan(1e-4 / np.median(sound.depth) * CAMERA.fx))
    assert (rounding.step, rounding.tilt) == (pytest.approx(1e-4), pytest.approx(tilt, rel=1e-3))
    along = find_rounding(changed(sound, lambda z: np.round(z * RAYS, 3) / RAYS))
    assert along is not None
    assert (along.quantity, along.step) == ("distance along the ray", pytest.approx(1e-3))
    assert (np.diff(straight.depth[0].numpy()) == 0).mean() > 0.2  # flat walls and level floors are no terraces
    assert find_rounding(straight) is None


def test_planes_are_undecided_where_all_is_round(sound):
    rays = CAMERA.rays().numpy()
    square, half = (rays**2).sum(axis=0), 3 * rays[2]
    root = half**2 - square * (9 - 0.9**2)
    depth = np.where(root > 0, (half - np.sqrt(np.maximum(root, 0))) / square, np.nan)
    for bend in (1, rays[2], np.sqrt(square), 1 / np.sqrt(square)):
        assert of(changed(sound, lambda _, bend=bend: depth * bend), "planes").level == "note"


def test_measured_map_is_examined_at_its_own_resolution(sound):
    coarse = replace(sound, depth=None, measured={4: sound.depth[:, 2::4, 2::4], 2: sound.depth[:, 1::2, 1::2]})
    scene = with_depth(coarse)
    assert scene.rgb.shape == (3, SIZE // 2, SIZE // 2)
    assert (scene.camera.fx, scene.camera.width) == (120, SIZE // 2)
    assert torch.equal(scene.depth, sound.depth[:, 1::2, 1::2])
    assert wrong(coarse) == {}
    assert list(wrong(replace(coarse, measured={2: sound.depth[:, 1::2, 1::2] * 1000}))) == ["units"]


def test_distances_along_the_ray_of_a_real_office_are_recognised(shared):
    folder, camera = shared / "real" / "icl_nuim" / "office", Camera(640, 480, 481.2, -480.0, 319.5, 239.5)
    values = np.array((folder / "scene_00_0000.depth").read_text().split(), float).reshape(480, 640) / 100
    photo = torch.from_numpy(read_rgb(folder / "scene_00_0000.png")).permute(2, 0, 1).float() / 255
    depth = torch.from_numpy(np.where(values > 0, values, np.nan))[None]
    scene = Scene("real", "office", photo, camera, depth)
    assert list(wrong(scene)) == ["planes"]
    assert wrong(replace(scene, depth=from_range(scene.depth, camera, "perspective"))) == {}


@pytest.mark.parametrize("kind", ["missing", "file", "empty"])
def test_directory_without_scenes_is_one_line_on_stderr_and_exit_code_2(tmp_path, capsys, kind):
    place = tmp_path / kind
    if kind == "file":
        place.write_text("x")
    elif kind == "empty":
        place.mkdir()
    assert examine_directory(place) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(rf"error: {re.escape(str(place))}: expected a scene or a directory of scenes, got .*\n", err)


# The command


@pytest.mark.command
def test_findings_are_printed_with_advice(tmp_path, capsys):
    small = room_scene(CAMERA.rescale(128, 128), 17.0)
    depth, rays = small.depth[0].numpy(), small.camera.ray_lengths().numpy()
    numbers = {name: getattr(small.camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    for name, values, entries in (
        ("ray", depth * rays, {}), ("ray_described", depth * rays, {"range_type": "perspective"}),
        ("unit", depth * 1000, {}), ("unit_described", depth * 1000, {"depth_unit": "mm"}),
    ):  # fmt: skip
        (tmp_path / name).mkdir()
        (tmp_path / name / "camera.json").write_text(json.dumps({**numbers, **entries}))
        cv2.imwrite(str(tmp_path / name / "rgb.png"), 255 * small.rgb.permute(1, 2, 0).numpy()[..., ::-1])
        np.save(tmp_path / name / "depth.npy", values)
    assert main(["doctor", str(tmp_path)]) == 1
    output, errors = capsys.readouterr()
    assert errors == ""
    text = " ".join(output.split())
    assert "ray: 1 problem" in text
    assert "depth looks like distance along the ray" in text
    assert '-> set "range_type": "perspective" in camera.json' in text
    assert "ray_described: fine" in text
    assert "unit: 1 problem" in text
    assert "-> x 0.001 would make the median" in text
    assert "unit_described: fine" in text
    assert output.endswith("4 scenes: 2 fine, 2 with problems\n")
    assert main(["doctor", str(tmp_path), "--most", "2"]) == 1
    assert capsys.readouterr().out.startswith("2 of 4 scenes, at equal distances\nray: 1 problem")


def test_published_scenes_pass(shared, capsys):
    assert main(["doctor", str(shared / "scenes")]) == 0
    output, errors = capsys.readouterr()
    assert errors == ""
    for name in ("books", "lucy", "plant"):
        assert f"{name}: fine" in output
    assert output.endswith("3 scenes: 3 fine\n")
