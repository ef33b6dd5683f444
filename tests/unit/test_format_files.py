"""Reading files: every format gives the numbers that the test wrote byte by byte, every refusal names its file."""

import json
import re
import struct

import cv2
import numpy as np
import pytest
from refusals import refused
from small_files import png_by_its_specification as png

from dsr.io.cameras import read_camera
from dsr.io.images import read_map, read_mask, read_rgb

VALUES = np.array([[1.0, 2.5, 3.25], [4.5, 5.0, 60000.0]])  # Not symmetric under any flip, exact in float32
WHOLE = np.array([[1, 256, 3], [40000, 5, 65535]])
INTRINSICS = {"width": 3, "height": 2, "fx": 3.0, "fy": 3.0, "cx": 1.0, "cy": 0.5}


def pfm(values, order, scale="1.0"):
    """Return a PFM file: text header, rows from the bottom up, a negative scale for little-endian floats."""
    height, width = values.shape
    header = f"Pf\n{width} {height}\n{'-' if order == '<' else ''}{scale}\n".encode()
    return header + b"".join(struct.pack(f"{order}{width}f", *row) for row in values[::-1])


def tiff(values):
    """Return an uncompressed little-endian TIFF of 32-bit floats in one strip."""
    pixels = values.astype("<f4").tobytes()
    height, width = values.shape
    long, short = 4, 3
    entries = [
        (256, long, width), (257, long, height), (258, short, 32), (259, short, 1), (262, short, 1), (273, long, 8),
        (277, short, 1), (278, long, height), (279, long, len(pixels)), (339, short, 3),
    ]  # fmt: skip
    directory = struct.pack("<H", len(entries)) + b"".join(
        struct.pack("<HHI", tag, kind, 1) + struct.pack("<I" if kind == long else "<Hxx", value)
        for tag, kind, value in entries
    )
    return b"II*\0" + struct.pack("<I", 8 + len(pixels)) + pixels + directory + b"\0\0\0\0"


def npy(values, descr):
    """Return a version 1.0 .npy file."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {values.shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode() + values.astype(descr).tobytes()


def written(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return path


def refusal(reader, path, capfd):
    return refused(lambda: reader(path), path, capfd)


FORMATS = {
    "npy float32": ("d.npy", npy(VALUES, "<f4"), VALUES),
    "npy float64": ("d.npy", npy(VALUES, "<f8"), VALUES),
    "npy big-endian": ("d.npy", npy(VALUES, ">f4"), VALUES),
    "npy 16-bit": ("d.npy", npy(WHOLE, "<u2"), WHOLE),
    "npy 32-bit": ("d.npy", npy(WHOLE, "<i4"), WHOLE),
    "png 16-bit": ("d.png", png(WHOLE, 16, 0), WHOLE),
    "tiff float": ("d.tiff", tiff(VALUES), VALUES),
    "tif float": ("d.tif", tiff(VALUES), VALUES),
    "pfm little-endian": ("d.pfm", pfm(VALUES, "<"), VALUES),
    "pfm of Middlebury": ("d.pfm", pfm(VALUES, "<", "0.003922"), VALUES),
    "pfm big-endian, scaled": ("d.pfm", pfm(VALUES, ">", "2.5e+1"), VALUES),
    "pfm big-endian": ("d.pfm", pfm(VALUES, ">"), VALUES),
    "pfm of Windows": ("d.pfm", pfm(VALUES, "<").replace(b"\n", b"\r\n", 3), VALUES),
}


@pytest.mark.parametrize("case", FORMATS)
def test_maps_of_all_formats_are_read_exactly_from_the_top_row(tmp_path, case):
    name, content, expected = FORMATS[case]
    values = read_map(written(tmp_path, name, content))
    assert values.dtype == np.float64
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("order", ["<", ">"])
def test_infinities_and_nan_of_a_pfm_are_kept(tmp_path, order):
    marked = np.array([[np.inf, 1.0], [np.nan, -2.0]])
    np.testing.assert_array_equal(read_map(written(tmp_path, "d.pfm", pfm(marked, order))), marked)


@pytest.mark.parametrize(
    "content",
    [
        b"PF\n2 1\n-1.0\n" + bytes(24), b"Pf\n2 1\n0.0\n" + bytes(8), b"Pf\n2 1\n-1.0\n" + bytes(9),
        b"Pf\n2 1\n-.\n" + bytes(8), b"Pf\n2\n-1.0\n" + bytes(8), b"Pf\n0 1\n-1.0\n",
        b"Pf\n2 1\n-1.0\n" + bytes(7), b"Pf\n2 1\n1e999\n" + bytes(8), b"Pf\n2 1\nnan\n" + bytes(8),
        b"Pf\n" + b"1" * 5000 + b" 1\n-1.0\n" + bytes(8), b"Pf\n# made by hand\n2 1\n-1.0\n" + bytes(8),
    ],
)  # fmt: skip
def test_pfm_that_is_no_single_channel_of_its_size_is_refused(tmp_path, capfd, content):
    assert re.search(
        r"expected (one channel|a PFM file)", refusal(read_map, written(tmp_path, "d.pfm", content), capfd)
    )


@pytest.mark.parametrize(
    ("name", "content"),
    [("d.png", png(WHOLE % 256, 8, 0)), ("d.npy", npy(WHOLE % 256, "|u1")), ("d.npy", npy(WHOLE % 100, "|i1"))],
)
def test_8_bit_depth_is_refused(tmp_path, capfd, name, content):
    assert "expected 16-bit or floating point" in refusal(read_map, written(tmp_path, name, content), capfd)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("d.png", png(np.dstack([WHOLE] * 3), 16, 2)),
        ("d.npy", npy(np.ones((1, 2, 3)), "<f4")),
        ("d.npy", npy(np.ones(3), "<f4")),
    ],
)
def test_map_of_several_channels_is_refused_with_its_shape(tmp_path, capfd, name, content):
    assert "expected one channel" in refusal(read_map, written(tmp_path, name, content), capfd)


@pytest.mark.parametrize("descr", ["<c16", "|b1"])
def test_array_that_is_no_numeric_map_is_refused(tmp_path, capfd, descr):
    refusal(read_map, written(tmp_path, "d.npy", npy(np.ones((2, 3)), descr)), capfd)


@pytest.mark.parametrize("case", ["npy float32", "png 16-bit", "tiff float", "pfm little-endian"])
def test_truncated_map_is_refused(tmp_path, capfd, case):
    name, content, _ = FORMATS[case]
    for fraction in (0.3, 0.9):  # within the header, within the values
        refusal(read_map, written(tmp_path, name, content[: int(len(content) * fraction)]), capfd)


@pytest.mark.parametrize("name", ["d.npy", "d.png", "d.tiff", "d.pfm"])
def test_foreign_file_is_refused(tmp_path, capfd, name):
    numpy_like = (b"\x93NUMPY\x01\0\x10\0{'descr': ((((", b"\x93NUMPY\x09\0ab")
    for content in (b"", b"no picture, no array", bytes(200), *numpy_like):
        refusal(read_map, written(tmp_path, name, content), capfd)


def test_pickled_array_is_refused(tmp_path, capfd):
    np.save(tmp_path / "d.npy", np.array([[{}]], dtype=object))
    refusal(read_map, tmp_path / "d.npy", capfd)


def test_array_larger_than_memory_is_refused(tmp_path, capfd):
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999, 99999999), }".ljust(117) + "\n"
    content = b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode()
    refusal(read_map, written(tmp_path, "d.npy", content), capfd)


@pytest.mark.parametrize(
    ("reader", "name"),
    [(read_map, "d.npy"), (read_map, "d.png"), (read_rgb, "rgb.png"), (read_mask, "mask.png"), (read_camera, "c.json")],
)
def test_missing_file_and_directory_are_refused(tmp_path, capfd, reader, name):
    assert "there is none" in refusal(reader, tmp_path / name, capfd)
    (tmp_path / name).mkdir()
    assert "there is none" in refusal(reader, tmp_path / name, capfd)


def test_photo_is_read_as_red_green_blue(tmp_path):
    colours = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [10, 20, 30]]])
    picture = read_rgb(written(tmp_path, "rgb.png", png(colours, 8, 2)))
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, colours)


def test_jpg_photo_is_read_as_red_green_blue(tmp_path):
    orange = np.full((16, 24, 3), (0, 128, 255), np.uint8)  # blue, green, red
    assert cv2.imwrite(str(tmp_path / "rgb.jpg"), orange)
    picture = read_rgb(tmp_path / "rgb.jpg")
    assert picture.shape == (16, 24, 3)
    np.testing.assert_allclose(picture, np.full((16, 24, 3), (255, 128, 0)), atol=3)


def test_grey_photo_becomes_three_equal_channels(tmp_path):
    grey = WHOLE % 256
    picture = read_rgb(written(tmp_path, "rgb.png", png(grey, 8, 0)))
    np.testing.assert_array_equal(picture, np.dstack([grey] * 3))


def test_broken_png_photo_is_refused(tmp_path, capfd):
    content = png(np.random.default_rng(0).integers(0, 256, (32, 32, 3)), 8, 2)
    for fraction in (0, 0.3, 0.97):
        refusal(read_rgb, written(tmp_path, "rgb.png", content[: int(len(content) * fraction)]), capfd)


def test_mask_is_true_where_its_picture_is_not_0(tmp_path):
    mask = read_mask(written(tmp_path, "mask.png", png([[0, 1, 255], [128, 0, 0]], 8, 0)))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, [[False, True, True], [True, False, False]])


def camera_file(folder, **changes):
    entries = {key: value for key, value in {**INTRINSICS, **changes}.items() if value != "absent"}
    path = folder / "camera.json"
    path.write_text(json.dumps(entries))
    return path


def test_camera_file_is_read_in_pixels_and_metres(tmp_path):
    path = camera_file(
        tmp_path, range_type="disparity", baseline=160, baseline_unit="mm", doffs=2.5, depth_unit="mm", hole_value=0
    )
    described = read_camera(path)
    camera = described.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (3, 2, 3, 3, 1, 0.5)
    assert camera.baseline == pytest.approx(0.16, rel=1e-15)
    assert camera.doffs == 2.5
    assert (described.range_type, described.depth_unit, described.hole_value) == ("disparity", 0.001, 0.0)


def test_camera_file_of_intrinsics_alone_is_enough(tmp_path):
    described = read_camera(camera_file(tmp_path))
    assert (described.camera.baseline, described.camera.doffs) == (None, 0)
    assert (described.range_type, described.depth_unit, described.hole_value) == (None, None, None)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("mm", 0.001), (0.0002, 0.0002), (5, 5.0)])
def test_depth_unit_is_m_mm_or_a_number(tmp_path, unit, metres):
    assert read_camera(camera_file(tmp_path, depth_unit=unit)).depth_unit == metres


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", "absent"), ("fx", "absent"), ("cy", "absent"), ("width", 3.5), ("width", 0), ("height", -2),
        ("fx", 0), ("fx", "3"), ("fy", 0), ("cx", None), ("cx", True), ("fx", 10**400), ("width", 1e300),
        ("range_type", "z"), ("range_type", ["depth"]), ("baseline", "0.2"), ("baseline", 0), ("baseline", -1),
        ("baseline", float("inf")), ("doffs", None), ("doffs", float("nan")), ("hole_value", "0"),
        ("hole_value", None), ("width", True), ("width", float("nan")), ("height", 10**400), ("depth_unit", 10**400),
        ("depth_unit", "cm"), ("depth_unit", 0), ("depth_unit", -1), ("depth_unit", None), ("depth_unit", True),
        ("depth_unit", float("nan")),
    ],
)  # fmt: skip
def test_camera_file_with_an_invalid_value_is_refused_by_its_key(tmp_path, capfd, key, value):
    assert key in refusal(read_camera, camera_file(tmp_path, **{key: value}), capfd).split(":")[0].split()[-1]


def test_camera_file_with_an_unknown_key_is_refused(tmp_path, capfd):
    message = refusal(read_camera, camera_file(tmp_path, basline=0.2), capfd)
    assert message.startswith("basline: unknown key; expected ")
    assert "baseline" in message


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "3", "null", "[" * 100_000, '{"width": 3,}'])
def test_camera_file_that_is_no_json_object_is_refused(tmp_path, capfd, text):
    message = refusal(read_camera, written(tmp_path, "camera.json", text.encode()), capfd)
    assert re.match(r"got damaged JSON: .* at line \d+ column \d+$|expected an object, got ", message)
