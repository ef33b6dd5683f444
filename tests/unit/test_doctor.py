"""The doctor: a check finds the one fault that the test put in, with its number, and none finds any in sound scenes."""

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from small_scenes import room

from dsr.doctor.depth_checks import find_rounding, with_depth
from dsr.doctor.examine import CHECKS, examine, examine_directory
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.io.images import read_map, read_rgb
from dsr.sample import Scene
from dsr.synthetic.simgeo import render_scene

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
    found = {}
    for finding in examine(scene):
        assert "\n" not in finding.message + finding.advice
        if finding.level in ("warning", "problem"):
            assert finding.check not in found
            assert finding.advice
            found[finding.check] = (finding.level, finding.message, finding.advice)
    return found


def only(scene, check):
    """Return what is wrong with a scene, which is one thing."""
    found = wrong(scene)
    assert list(found) == [check]
    return found[check]


def level_of(scene, check):
    """Return the level of the first finding of one check."""
    return of(scene, check)[0].level


def of(scene, check):
    """Return the findings of one check."""
    return next(function for function in CHECKS if function.__name__ == f"check_{check}")(scene)


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


# units


@pytest.mark.parametrize(("factor", "cure"), [(1000, "x 0.001"), (0.001, "x 1000"), (5000, "x 0.0002")])
def test_wrong_unit_is_found_with_its_factor(sound, factor, cure):
    level, message, advice = only(changed(sound, lambda z: z * factor), "units")
    assert level == "problem"
    assert cure in advice
    assert '"depth_unit"' in advice
    assert ("farther" if factor > 1 else "nearer") in message


@pytest.mark.parametrize(("factor", "text"), [(1000, "200 m"), (0.001, "0.2 mm")])
def test_baseline_in_another_unit_is_named_where_depth_is_off_by_the_same_factor(sound, factor, text):
    scene = with_camera(changed(sound, lambda z: z * factor), baseline=0.2 * factor)
    advice = [finding.advice for finding in examine(scene) if finding.level == "problem"]
    assert len(advice) == 1
    assert f'set "baseline_unit" in camera.json: the baseline of {text} is off by the same factor' in advice[0]


def test_measured_map_in_another_unit_than_the_high_resolution_map_is_found(sound):
    coarse = sound.depth[:, 2::4, 2::4]
    assert wrong(replace(sound, measured={4: coarse})) == {}
    _, message, _ = only(replace(sound, measured={4: coarse * 4}), "units")
    assert message == "the measured map at x4 is 4 times as far as the high-resolution depth"


# intrinsics and size


@pytest.mark.parametrize("scale", [2, 0.5, 4, 0.25, 3])
def test_intrinsics_of_another_resolution_are_found_with_the_factor(sound, scale):
    other = sound.camera.rescale(round(SIZE * scale), round(SIZE * scale))
    scene = with_camera(sound, fx=other.fx, fy=other.fy, cx=other.cx, cy=other.cy)
    level, message, advice = only(scene, "intrinsics")
    assert level == "problem"
    assert f"{scale:g} times as large ({SIZE * scale:.0f} x {SIZE * scale:.0f})" in message
    assert advice.startswith(f"divide them by {scale:g}")


def test_swapped_intrinsics_are_found():
    camera = Camera(320, 240, 300.0, 301.0, 159.5, 119.5)
    sound = room_scene(camera, 17.0)
    assert wrong(sound) == {}
    _, message, advice = only(with_camera(sound, fy=159.5, cx=301.0), "intrinsics")
    assert "fx 300, fy 159.5, cx 301, cy 119.5 px" in message
    assert advice == "correct the order: fy is the number given as cx, cx is the number given as fy"
    _, _, advice = only(with_camera(sound, cx=119.5, cy=159.5), "intrinsics")
    assert advice == "correct the order: cx is the number given as cy, cy is the number given as cx"


def test_principal_point_far_off_the_centre_is_found_with_its_side(sound):
    _, message, advice = only(with_camera(sound, cx=127.5 - 0.3 * SIZE), "intrinsics")
    assert "is 30% of the width left of the centre and 0% of the height above it" in message
    assert advice.startswith("check cx and cy")
    assert level_of(with_camera(sound, cy=127.5 + 0.12 * SIZE), "intrinsics") == "note"
    assert level_of(with_camera(sound, cy=127.5 + 0.08 * SIZE), "intrinsics") == "ok"


@pytest.mark.parametrize(("fx", "level"), [(35.0, "warning"), (60.0, "note"), (2000.0, "note"), (3000.0, "warning")])
def test_implausible_field_of_view_is_found_in_degrees(sound, fx, level):
    scene = with_camera(sound, fx=fx, fy=fx)
    [finding] = of(scene, "intrinsics")
    degrees = 2 * math.degrees(math.atan(SIZE / 2 / fx))
    assert finding.level == level
    assert f"fx {fx:g} px gives a horizontal field of view of {degrees:.3g} degrees" in finding.message


# registration


@pytest.mark.parametrize(
    ("right", "down", "text"),
    [(6, 0, "6 px right, 0 px below"), (-4, 0, "4 px left, 0 px below"), (3, -5, "3 px right, 5 px above")],
)
def test_shifted_photo_is_found_with_its_shift(sound, right, down, text):
    shifted = replace(sound, rgb=sound.rgb.roll((down, right), (1, 2)))
    level, message, _ = only(shifted, "registration")
    assert (level, message) == ("warning", f"the photo's edges are {text} of the depth edges")


@pytest.mark.parametrize(
    ("axes", "text"),
    [((2,), "mirrored left to right"), ((1,), "mirrored top to bottom"), ((1, 2), "turned by 180 degrees")],
)
def test_mirrored_photo_is_recognised(sound, axes, text):
    level, message, _ = only(replace(sound, rgb=sound.rgb.flip(axes)), "registration")
    assert level == "problem"
    figures = re.fullmatch(
        rf"the depth map fits better with the photo {text} \((0\.\d\d) against (-?0\.\d\d)\)", message
    )
    assert figures is not None
    assert float(figures[1]) > 2 * float(figures[2])


def test_unrelated_photo_is_found(sound):
    other = render_scene("cube_high_freq", SIZE).scene("simgeo", "cube").rgb
    [finding] = [finding for finding in examine(replace(sound, rgb=other)) if finding.level != "ok"]
    assert (finding.check, finding.level) == ("registration", "warning")
    assert finding.message.startswith("the photo seems to show something else")


def test_narrow_holes_are_no_edges(sound):
    depth = sound.depth.clone()
    depth[:, ::8] = torch.nan
    depth[:, :, ::8] = torch.nan
    assert level_of(replace(sound, depth=depth), "registration") == "ok"
    assert level_of(replace(sound, depth=depth, rgb=sound.rgb.flip(2)), "registration") == "problem"
    flat = torch.where(depth.isnan(), torch.nan, 2.0)
    assert level_of(replace(sound, depth=flat), "registration") == "note"


# holes


@pytest.mark.parametrize(("rows", "level"), [(10, "ok"), (64, "note"), (128, "warning")])
def test_fraction_of_holes_is_judged(sound, rows, level):
    depth = sound.depth.clone()
    depth[:, :rows] = torch.nan
    [finding] = of(replace(sound, depth=depth), "holes")
    assert finding.level == level
    assert finding.message == f"{1 - rows / SIZE:.1%} of the pixels are valid"


def scattered(share=0.05):
    """Return pixels in many places."""
    return np.random.default_rng(5).random((SIZE, SIZE)) < share


@pytest.mark.parametrize("value", [65.535, 10.0, 655.35, 0.001, 0.0001, 7.77])
def test_value_that_marks_holes_is_found(sound, value):
    where = scattered()
    _, message, advice = only(changed(sound, lambda z: np.where(where, value, z)), "holes")
    share = f"{where.mean():.1%}"
    side = "largest" if value > 4 else "smallest"
    assert message.startswith(f"{share} of the valid pixels have exactly the {side} value, {value:g} m")
    assert '"hole_value"' in advice


# precision


def degrees(relative_step, camera=CAMERA):
    return math.degrees(math.atan(relative_step * camera.fx))


@pytest.mark.parametrize("step", [0.001, 0.002])
def test_whole_millimetres_are_found_as_terraces(sound, step):
    scene = changed(sound, lambda z: np.round(z / step) * step)
    level, message, advice = only(scene, "precision")
    tilt = degrees(step / np.median(scene.depth))
    assert level == "warning"
    assert message.startswith(f"depth comes in steps of {step * 1e3:.3g} mm, ")
    assert f"one step tilts a surface by {tilt:.2g} degrees" in message
    assert advice


def test_tenths_of_millimetres_pass(sound):
    scene = changed(sound, lambda z: np.round(z, 4))
    assert wrong(scene) == {}
    rounding = find_rounding(scene)
    assert rounding is not None
    assert rounding.step == pytest.approx(1e-4)
    assert rounding.tilt == pytest.approx(degrees(1e-4 / np.median(scene.depth)), rel=1e-3)


def test_8_bit_depth_is_a_problem(sound):
    low, high = sound.depth.min().item(), sound.depth.max().item()
    step = (high - low) / 255
    level, message, _ = only(changed(sound, lambda z: low + np.round((z - low) / step) * step), "precision")
    assert level == "problem"
    assert message.startswith(f"depth comes in steps of {step * 1e3:.3g} mm, ")
    assert "distinct values (8 bits hold 256)" in message


def test_whole_disparities_are_found_in_pixels(sound):
    disparity = to_range(sound.depth, CAMERA, "disparity").round()
    scene = replace(sound, depth=from_range(disparity, CAMERA, "disparity"))
    level, message, _ = only(scene, "precision")
    assert level == "problem"
    assert message.startswith("disparity comes in steps of 1 px, ")
    tilt = degrees(np.median(scene.depth) / (0.2 * CAMERA.fx))
    assert f"one step tilts a surface by {tilt:.2g} degrees" in message


@pytest.mark.parametrize("factor", [2, 3, 4, 8])
def test_map_enlarged_by_repeating_its_pixels_is_recognised(sound, factor):
    def enlarge(depth):
        return depth[::factor, ::factor].repeat(factor, 0).repeat(factor, 1)[:SIZE, :SIZE]

    level, message, _ = only(changed(sound, enlarge), "precision")
    assert level == "problem"
    assert message == f"every value is repeated {factor} times across and down: an enlarged smaller map"


def test_flat_walls_and_level_floors_are_not_terraces(straight):
    depth = straight.depth[0].numpy()
    assert (np.diff(depth) == 0).mean() > 0.2
    assert find_rounding(straight) is None


# planes


def test_distance_along_the_ray_is_distinguished_from_orthogonal_depth(straight, sound):
    rays = CAMERA.ray_lengths().numpy()
    for scene in (straight, sound):
        level, message, advice = only(changed(scene, lambda z: z * rays), "planes")
        assert level == "problem"
        assert message.startswith("depth looks like distance along the ray: ")
        assert advice == 'set "range_type": "perspective" in camera.json'
        _, message, advice = only(changed(scene, lambda z: z / rays), "planes")
        assert message.startswith("depth was read as distance along the ray but looks orthogonal in the file: ")
        assert advice == 'set "range_type": "orthogonal" in camera.json'


def test_planes_are_recognised_through_noise_and_holes(sound):
    noise = 1 + 0.002 * np.random.default_rng(6).standard_normal((SIZE, SIZE))
    holes = np.where(scattered(0.002), np.nan, 1)
    rays = CAMERA.ray_lengths().numpy()
    assert level_of(changed(sound, lambda z: z * noise * holes), "planes") == "ok"
    assert level_of(changed(sound, lambda z: z * rays * noise * holes), "planes") == "problem"


def test_planes_are_undecided_where_all_is_round(sound):
    rays = CAMERA.rays().numpy()
    square, half = (rays**2).sum(axis=0), 3 * rays[2]
    root = half**2 - square * (9 - 0.9**2)
    depth = np.where(root > 0, (half - np.sqrt(np.maximum(root, 0))) / square, np.nan)
    for bend in (1, rays[2], np.sqrt(square), 1 / np.sqrt(square)):
        assert level_of(changed(sound, lambda _, bend=bend: depth * bend), "planes") == "note"


def test_rounded_distance_along_the_ray_is_found_in_its_own_unit(sound):
    rays = CAMERA.ray_lengths().numpy()
    _, message, _ = only(changed(sound, lambda z: np.round(z * rays, 3) / rays), "precision")
    assert message.startswith("distance along the ray comes in steps of 1 mm, ")


def test_rounding_below_the_noise_passes(sound):
    noise = 1 + 0.005 * np.random.default_rng(6).standard_normal((SIZE, SIZE))
    assert level_of(changed(sound, lambda z: np.round(z * noise, 3)), "precision") == "ok"


# scenes of which only a measured low-resolution map is known


def test_measured_map_is_examined_at_its_own_resolution(sound):
    coarse = replace(sound, depth=None, measured={4: sound.depth[:, 2::4, 2::4], 2: sound.depth[:, 1::2, 1::2]})
    scene = with_depth(coarse)
    assert scene.rgb.shape == (3, SIZE // 2, SIZE // 2)
    assert (scene.camera.fx, scene.camera.width) == (120, SIZE // 2)
    assert torch.equal(scene.depth, sound.depth[:, 1::2, 1::2])
    assert wrong(coarse) == {}
    assert list(wrong(replace(coarse, measured={2: sound.depth[:, 1::2, 1::2] * 1000}))) == ["units"]


# real scenes


ICL = Camera(640, 480, 481.2, -480.0, 319.5, 239.5)


def real_scene(rgb, depth, camera):
    """Return a scene of a photo (H, W, 3) and depth (H, W) in metres, not positive in holes."""
    photo = torch.from_numpy(rgb).permute(2, 0, 1).float() / 255
    known = np.where(depth > 0, depth, np.nan)
    return Scene("real", "real", photo, camera, torch.from_numpy(known)[None])


def office(shared):
    """Return ICL-NUIM's office, its distances along the ray taken as depth."""
    folder = shared / "real" / "icl_nuim" / "office"
    values = np.array((folder / "scene_00_0000.depth").read_text().split(), float).reshape(480, 640) / 100
    return real_scene(read_rgb(folder / "scene_00_0000.png"), values, ICL)


def test_distances_along_the_ray_of_a_real_office_are_recognised(shared):
    scene = office(shared)
    only(scene, "planes")
    assert wrong(replace(scene, depth=from_range(scene.depth, ICL, "perspective"))) == {}


def test_real_living_room_is_orthogonal_and_in_whole_millimetres(shared):
    folder = shared / "real" / "icl_nuim" / "living"
    scene = real_scene(read_rgb(folder / "rgb.png"), read_map(folder / "depth.png") / 5000, ICL)
    level, message, _ = only(scene, "precision")
    assert level == "warning"
    assert re.match(r"depth comes in steps of 1 mm, .* tilts a surface by 9 degrees", message)
    assert level_of(scene, "planes") == "ok"
    assert "planes" in wrong(changed(scene, lambda z: z * ICL.ray_lengths().numpy()))


@pytest.mark.parametrize("name", ["Aloe", "Midd1"])
def test_middlebury_2006_has_terraces_of_a_third_of_a_pixel(shared, name):
    folder = shared / "real" / "middlebury2006" / name
    disparity = cv2.imread(str(folder / "disp1.png"), cv2.IMREAD_UNCHANGED) / 3
    height, width = disparity.shape
    camera = Camera(width, height, 3740 / 3, 3740 / 3, (width - 1) / 2, (height - 1) / 2, baseline=0.16)
    with np.errstate(divide="ignore"):
        depth = np.where(disparity > 0, camera.baseline * camera.fx / disparity, np.nan)
    level, message, _ = only(real_scene(read_rgb(folder / "view1.png"), depth, camera), "precision")
    assert level == "problem"
    assert message.startswith("disparity comes in steps of 0.33 px, ")


# the report


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
