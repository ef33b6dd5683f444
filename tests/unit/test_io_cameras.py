"""Cameras of people's photos: files of several programs, numbers, EXIF data, and what is assumed without."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from dsr.geometry.camera import Camera
from dsr.io.cameras import find_camera, read_camera
from dsr.io.photos import read_photo
from dsr.io.reading import CameraChoice

SIZE, COARSE = (48, 64), (12, 16)
OWN = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 24.0}
OPEN3D = {"width": 64, "height": 48, "intrinsic_matrix": [60.0, 0, 0, 0, 61, 0, 31, 24, 1]}


def written(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def photo(folder, exif=None, size=SIZE):
    """Return a JPEG file with EXIF entries: main ones, and the focal length of the Exif part."""
    path, entries = folder / "photo.jpg", Image.Exif()
    for tag, value in (exif or {}).items():
        (entries.get_ifd(0x8769) if tag == 0xA405 else entries)[tag] = value
    pixels = np.linspace(0, 255, size[0] * size[1] * 3).reshape(*size, 3).astype("u1")
    Image.fromarray(pixels).save(path, exif=entries, quality=95)
    return path


def found(folder, **choice):
    description, assumptions = find_camera(CameraChoice(**choice), photo(folder), SIZE, COARSE)
    return description.camera, [str(assumption) for assumption in assumptions]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("camera.json", OWN),
        ("open3d.json", OPEN3D),
    ],
)
def test_camera_file_of_the_photo_is_used_silently(tmp_path, name, content):
    assert found(tmp_path, file=written(tmp_path, name, content)) == (Camera(**OWN), [])


@pytest.mark.parametrize(
    "text",
    [
        "60 0 31\n0 61 24\n0 0 1\n", "60 0 31 0 61 24 0 0 1", "60,0,31\n0,61,24\n0,0,1",
        "6e1 0 31 0\n0 61 24 0\n0 0 1 0\n0 0 0 1\n",
    ],
)  # fmt: skip
def test_matrix_of_sun_rgbd_or_scannet_is_in_photo_pixels(tmp_path, text):
    camera, assumptions = found(tmp_path, file=written(tmp_path, "intrinsics.txt", text))
    assert camera == Camera(**OWN)
    assert assumptions == ["camera: the matrix is read in pixels of the photo"]


def test_matrix_in_depth_map_pixels_is_recognised_and_scaled(tmp_path):
    camera, assumptions = found(tmp_path, file=written(tmp_path, "k.txt", "15 0 7.5 0 15 5.5 0 0 1"))
    assert camera == Camera(64, 48, 60, 60, 31.5, 23.5)
    assert "pixels of the depth map" in assumptions[0]
    assert "16 x 12 pixels is scaled to the photo's 64 x 48" in assumptions[1]


def test_camera_of_another_resolution_is_scaled_about_the_outer_edge(tmp_path):
    camera, assumptions = found(tmp_path, file=written(tmp_path, "c.json", {**OWN, "width": 128, "height": 96}))
    assert camera == Camera(64, 48, 30, 30.5, 31.5 / 2 - 0.5, 24.5 / 2 - 0.5)
    assert assumptions == ["camera: that of 128 x 96 pixels is scaled to the photo's 64 x 48"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("c.json", {**OWN, "width": 80}, "expected a camera of the photo's aspect"),
        ("c.json", {**OWN, "fx": "wide"}, "fx: expected a valid number, got 'wide'"),
        ("c.json", {**OPEN3D, "intrinsic_matrix": [1, 2]}, "intrinsic_matrix: expected at least 9 items"),
        ("c.json", {**OPEN3D, "intrinsic_matrix": [True] * 9}, "intrinsic_matrix.0: expected a valid number, got True"),
        ("c.json", {**OPEN3D, "intrinsic_matrix": [10**400] * 9}, "expected a matrix"),
        ("c.json", {"intrinsic_matrix": OPEN3D["intrinsic_matrix"]}, "width: it is missing"),
        ("c.json", {**OPEN3D, "height": "48"}, "height: expected a valid integer, got '48'"),
        ("c.json", {**OPEN3D, "intrinsic_matrix": [60.0, 0, 31, 0, 61, 24, 0, 0, 1]}, "expected a matrix"),
        ("c.json", "{", "got damaged JSON"),
        ("k.txt", "a matrix", "expected JSON or a matrix"),
        ("k.txt", "1 2 3", "expected JSON or a matrix"),
        ("k.txt", "60 0 310 0 61 240 0 0 1", "expected a principal point near the middle"),
        ("k.txt", "-60 0 31 0 61 24 0 0 1", r"expected a matrix \(fx 0 cx"),
        ("missing.txt", None, "expected a file, there is none"),
    ],
)
def test_camera_file_that_does_not_fit_is_refused_by_name(tmp_path, name, content, message):
    path = tmp_path / name if content is None else written(tmp_path, name, content)
    with pytest.raises(ValueError, match=message) as caught:
        found(tmp_path, file=path)
    assert str(caught.value).startswith(f"{path}: ")


def test_command_line_numbers_are_photo_pixels(tmp_path):
    assert found(tmp_path, intrinsics=(60.0, 61.0, 31.0, 24.0)) == (Camera(**OWN), [])


def test_unknown_camera_is_assumed_to_have_60_degrees_with_a_note(tmp_path):
    camera, assumptions = found(tmp_path)
    assert math.degrees(2 * math.atan(32 / camera.fx)) == pytest.approx(60)
    assert assumptions == [
        "camera: none given, 60 degrees of horizontal view assumed (--camera, --fov or --intrinsics) (55.426 pixels)"
    ]


def test_focal_length_of_exif_data_is_relative_to_the_35_mm_diagonal(tmp_path):
    description, assumptions = find_camera(CameraChoice(), photo(tmp_path, {0xA405: 26}), SIZE, COARSE)
    assert description.camera.fx == pytest.approx(26 / math.sqrt(36**2 + 24**2) * 80)
    assert "EXIF" in assumptions[0].text
    assert assumptions[0].detail.startswith("26 mm")


@pytest.mark.parametrize("choice", [{"fov": 0.0}, {"fov": 180.0}, {"fov": math.nan}, {"intrinsics": (1, 0, 1, 1)}])
def test_impossible_camera_numbers_are_refused(choice):
    with pytest.raises(ValueError, match=f"^{next(iter(choice))}: expected"):
        CameraChoice(**choice)


@pytest.mark.parametrize("orientation", range(2, 9))
def test_exif_rotation_is_applied_only_where_depth_fits_it_alone(tmp_path, orientation):
    path = photo(tmp_path, {0x0112: orientation})
    plain = np.asarray(Image.open(path).convert("RGB")).astype(int)
    as_stored, assumptions = read_photo(path, COARSE)
    assert np.abs(as_stored - plain).max() <= 2
    assert "ignored" in assumptions[0].text
    upright, assumptions = read_photo(path, COARSE[::-1])
    if orientation < 5:
        assert upright.shape == (48, 64, 3)
        return
    from PIL import ImageOps  # noqa: PLC0415

    expected = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB")).astype(int)
    assert upright.shape == expected.shape
    assert np.abs(upright - expected).max() <= 2
    assert "turned" in assumptions[0].text


def camera_file(folder, **changes):
    entries = {key: value for key, value in {**OWN, **changes}.items() if value != "absent"}
    return written(folder, "camera.json", entries)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", "absent"), ("fx", "absent"), ("cy", "absent"), ("width", 3.5), ("width", 0), ("height", -2),
        ("fx", 0), ("fx", "3"), ("fy", 0), ("cx", None), ("cx", True), ("fx", 10**400), ("width", 1e300),
        ("range_type", "z"), ("range_type", ["depth"]), ("baseline", "0.2"), ("baseline", 0), ("baseline", -1),
        ("baseline", float("inf")), ("doffs", None), ("doffs", float("nan")), ("hole_value", "0"),
        ("hole_value", None), ("width", True), ("width", float("nan")), ("height", 10**400), ("depth_unit", 10**400),
        ("depth_unit", "cm"), ("depth_unit", 0), ("depth_unit", -1), ("depth_unit", None), ("depth_unit", True),
        ("depth_unit", float("nan")), ("basline", 0.2),
    ],
)  # fmt: skip
def test_camera_file_with_an_invalid_value_is_refused_by_its_key(tmp_path, key, value):
    with pytest.raises(ValueError, match=rf"camera\.json: (camera )?{key}: ") as caught:
        read_camera(camera_file(tmp_path, **{key: value}))
    assert "\n" not in str(caught.value)
