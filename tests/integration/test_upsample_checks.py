"""``dsr upsample`` of values and cameras that can't be what they are taken for: read, asked for, or warned of."""

import shutil

import cv2
import numpy as np
import pytest
from PIL import Image
from small_scenes import room
from upsampling import info, refused_line
from upsampling import upsample as run_upsample

from dsr.geometry.camera import Camera
from dsr.io.depth_files import read_depth_file

SMALL = Camera.from_fov(60, 128, 96)  # Of the depth maps; the default of 60 degrees, so that no camera need be given
DEPTH = room(SMALL, 17.0)[0]
MILLIMETRES = np.round(DEPTH * 1000).astype(np.uint16)
BASELINE = 0.1
DISPARITY = BASELINE * SMALL.fx / DEPTH
HD = (640, 480)


def write(folder, values, size=(256, 192), name="depth"):
    """Write a photo and a map, and return the options that name them."""
    Image.fromarray(np.full((size[1], size[0], 3), 99, np.uint8)).save(folder / "photo.png")
    values = np.asarray(values)
    path = folder / f"{name}.npy"
    if values.dtype in (np.uint8, np.uint16):
        path = folder / f"{name}.png"
        cv2.imwrite(str(path), values)
    else:
        np.save(path, values)
    return ["--rgb", folder / "photo.png", "--depth", path]


def upsample(*arguments):
    return run_upsample(*arguments, "--method", "bicubic", "--only", "depth")


def warned(tmp_path, capsys, files, *options):
    """Return the codes in info.json, and what was printed, after checking that --strict refuses what is warned of."""
    assert upsample(*files, *options, "-o", tmp_path / "out") == 0
    printed = capsys.readouterr().out
    warnings = info(tmp_path / "out")["warnings"]
    assert printed.count("warning: ") == len(warnings)
    shutil.rmtree(tmp_path / "strict", ignore_errors=True)
    code = upsample(*files, *options, "-o", tmp_path / "strict", "--strict")
    assert not (tmp_path / "strict" / "info.json").exists() or not warnings
    if warnings:
        assert warnings[0]["message"] in refused_line(capsys, code)
    else:
        assert code == 0
    return [each["code"] for each in warnings], printed


def metres(folder):
    return read_depth_file(folder / "depth_metres.tiff")


# encodings


@pytest.mark.parametrize(
    "values",
    [MILLIMETRES * np.uint16(5), (MILLIMETRES << 3) | (MILLIMETRES >> 13), DEPTH.astype(np.float32) * 1000],
    ids=["fifths", "turned bits", "floats"],
)
def test_what_values_show_is_read_so(tmp_path, values):
    assert upsample(*write(tmp_path, values), "--strict", "-o", tmp_path / "out") == 0
    assert np.median(metres(tmp_path / "out")) == pytest.approx(np.median(DEPTH), rel=0.01)


def test_sizes_and_cameras_of_known_data_sets_give_the_unit(tmp_path, capsys):
    unrounded = np.round(cv2.resize(DEPTH, HD) * 5000).astype(np.uint16)
    intrinsics = ("--intrinsics", 481.2, 480, 319.5, 239.5)
    assert upsample(*write(tmp_path, unrounded, HD), *intrinsics, "-o", tmp_path / "i", "--dry-run") == 0
    assert "1/5000 m: the camera is that of ICL-NUIM" in capsys.readouterr().out
    lines = np.where(np.random.default_rng(1).random((375, 1242)) < 0.05, cv2.resize(DEPTH, (1242, 375)) * 5 * 256, 0)
    assert upsample(*write(tmp_path, lines.astype(np.uint16), (1242, 375)), "-o", tmp_path / "k", "--dry-run") == 0
    assert "1/256 m: size and holes are those of KITTI's maps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.round(DEPTH * 5000).astype(np.uint16), ("--depth-unit mm (", "--depth-unit 1/5000 (")),
        (DEPTH * 100, ("--depth-unit cm (", "--depth-unit mm (")),
        (DISPARITY, ("--range-type disparity with --baseline", "--range-type orthogonal")),
        (np.round(DISPARITY).astype(np.uint16), ("--depth-unit cm (", "--range-type disparity")),
        ((1 / DEPTH).astype(np.float32), ("--range-type disparity", "inverse depth of a network has no metric unit")),
        ((DEPTH - DEPTH.min()) / np.ptp(DEPTH), ("normalised", "--depth-unit METRES")),
        (np.uint16(257) * np.round(255 * DEPTH / DEPTH.max()).astype(np.uint16), ("for viewing", "--depth-unit")),
        (np.round(255 * DEPTH / DEPTH.max()).astype(np.uint8), ("uint8", "too coarse for depth")),
        (np.where(np.random.default_rng(2).random(DEPTH.shape) < 0.1, MILLIMETRES, 0).astype(np.uint16),
         ("--depth-unit 1/256 (", "--depth-unit mm (")),
        (cv2.applyColorMap(np.uint8(255 * DEPTH / DEPTH.max()), cv2.COLORMAP_JET), ("expected one channel",)),
    ],
)  # fmt: skip
def test_what_has_two_likely_readings_or_no_unit_is_asked_for_in_one_line(tmp_path, capsys, values, expected):
    line = refused_line(capsys, upsample(*write(tmp_path, values), "-o", tmp_path / "out"))
    assert line.startswith(str(tmp_path / "depth"))
    for text in expected:
        assert text in line
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").rglob("*.*"))


def test_whole_centimetres_of_a_room_are_not_taken_for_a_near_thing_in_silence(tmp_path, capsys):
    files = write(tmp_path, np.round(DEPTH * 100).astype(np.uint16))
    codes, printed = warned(tmp_path, capsys, files)
    assert codes == ["near-millimetres"]
    assert "are they centimetres?" in printed
    assert warned(tmp_path, capsys, files, "--depth-unit", "cm", "--overwrite")[0] == []


def test_planes_warn_of_distances_along_the_ray_and_of_disparities_given_as_depth(tmp_path, capsys):
    files = write(tmp_path, DEPTH * SMALL.ray_lengths().numpy())
    codes, printed = warned(tmp_path, capsys, files)
    assert codes == ["along-the-ray"]
    assert "--range-type perspective" in printed
    for chosen in ("orthogonal", "perspective"):
        assert warned(tmp_path, capsys, files, "--range-type", chosen, "--overwrite")[0] == []
    files = write(tmp_path, DISPARITY)
    assert warned(tmp_path, capsys, files, "--depth-unit", "m", "--overwrite")[0] == ["falls-with-distance"]
    files = write(tmp_path, DEPTH, name="disparity")
    codes, printed = warned(tmp_path, capsys, files, "--baseline", BASELINE, "--overwrite")
    assert codes == ["falls-with-distance"]
    assert "disparities rise with distance" in printed


# cameras


@pytest.mark.parametrize(
    ("intrinsics", "codes", "said"),
    [
        ((220, 220, 127.5, 95.5), [], ""),
        ((110, 110, 63.5, 47.5), ["other-picture"], "fit the depth map of 128 x 96, not the photo of 256 x 192"),
        ((440, 440, 255.5, 191.5), ["other-picture"], "fit an image 2 times as large"),
        ((220, 220, 700, 95.5), ["off-centre"], "principal point (700, 95.5) px"),
        ((575, 5, 127.5, 95.5), ["focal-ratio"], "fx 575 and fy 5 px differ"),
        ((4000, 4000, 127.5, 95.5), ["view-narrow"], "field of view of 3.67 degrees"),
        ((4.2, 4.2, 127.5, 95.5), ["view-wide"], "field of view of 176 degrees"),
    ],
)
def test_cameras_that_can_hardly_be_right_are_warned_of(tmp_path, capsys, intrinsics, codes, said):
    found, printed = warned(tmp_path, capsys, write(tmp_path, MILLIMETRES), "--intrinsics", *intrinsics)
    assert found == codes
    assert said in printed


def test_a_camera_that_cannot_see_its_picture_is_refused(tmp_path, capsys):
    files = write(tmp_path, MILLIMETRES)
    line = refused_line(capsys, upsample(*files, "--intrinsics", 220, 220, 1e9, 95.5, "-o", tmp_path / "out"))
    assert line.startswith("--intrinsics: expected a principal point in or near the picture of 256 x 192 pixels")


@pytest.mark.parametrize(("baseline", "code"), [(100, "baseline-long"), (0.1 / 1000, "baseline-short")])
def test_a_baseline_in_another_unit_is_warned_of(tmp_path, capsys, baseline, code):
    files = write(tmp_path, DISPARITY, name="disparity")
    codes, printed = warned(tmp_path, capsys, files, "--baseline", baseline)
    assert codes[0] == code
    assert "--baseline is in metres" in printed
    codes, _ = warned(tmp_path, capsys, write(tmp_path, MILLIMETRES), "--baseline", baseline, "--overwrite")
    assert codes == [code]


def folder_of(folder, maps):
    """Write a folder of photos and maps."""
    folder.mkdir()
    for number, values in enumerate(maps):
        Image.fromarray(np.full((192, 256, 3), 99, np.uint8)).save(folder / f"{number}_photo.png")
        np.save(folder / f"{number}_depth.npy", values)
    return folder


def test_near_frame_of_a_folder_makes_no_other_doubtful(tmp_path):
    near = (MILLIMETRES * 0.4 / DEPTH.max()).astype(np.uint16)
    mixed = folder_of(tmp_path / "mixed", [near, MILLIMETRES, MILLIMETRES])
    assert upsample(mixed, "--strict", "-o", tmp_path / "out") == 0
    assert upsample(folder_of(tmp_path / "near", [near, near]), "--strict", "-o", tmp_path / "out_near") == 2


def test_what_most_of_the_maps_of_a_folder_show_applies_to_all_of_them(tmp_path, capsys):
    along_the_ray = DEPTH * SMALL.ray_lengths().numpy()
    wall = np.full_like(DEPTH, 3.0)  # flat however it is read: it tells nothing, and is read like the others
    for name, maps, expected in (
        ("most", (along_the_ray, along_the_ray, wall), [["along-the-ray"]] * 3),
        ("one", (along_the_ray, DEPTH, DEPTH), [[]] * 3),
    ):
        folder = folder_of(tmp_path / name, maps)
        assert upsample(folder, "-o", tmp_path / "out" / name) == 0
        assert capsys.readouterr().out.count("warning: depth looks like distance along the ray") == (name == "most")
        found = [info(tmp_path / "out" / name / f"{number}_photo")["warnings"] for number in range(3)]
        assert [[each["code"] for each in warnings] for warnings in found] == expected
