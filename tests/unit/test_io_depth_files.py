"""People's depth files and photos: each format against an independent reader or writer, and what values mean."""

import math
import struct
import zipfile

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image
from small_files import png_by_its_specification, written

from dsr.geometry.camera import Camera
from dsr.io.depth_files import Encoding, can_hold, decode, encode, find_holes, read_depth_file, write_depth_file
from dsr.io.images import pixels_in_header, read_mask, read_rgb
from dsr.io.reading import parse_unit
from dsr.io.units import interpret

FLOATS = np.array([[0.5, 1.25, np.nan], [3.0, 60000.0, np.inf]])
"""Not symmetric under any flip, exact in half precision but for the largest."""
WHOLE = np.array([[0, 256, 3], [40000, 5, 65535]])


def exr(path, channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, dict(channels)) as file:
        file.write(str(path))
    return path


def read_pfm(path):
    """Return a PFM's values by its specification."""
    lines = path.read_bytes().split(b"\n", 3)
    width, height = map(int, lines[1].split())
    order = "<" if float(lines[2]) < 0 else ">"
    return np.frombuffer(lines[3], f"{order}f4").reshape(height, width)[::-1]


def read_exr(path):
    with OpenEXR.File(str(path)) as file:
        assert list(file.channels()) == ["Z"]
        return file.channels()["Z"].pixels


INDEPENDENT = {
    "png": lambda path: np.asarray(Image.open(path)), "tiff": lambda path: np.asarray(Image.open(path)),
    "npy": np.load, "npz": lambda path: np.load(path)["depth"], "pfm": read_pfm, "exr": read_exr,
}  # fmt: skip


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        ("png", "u2"), ("tiff", "u2"), ("tif", "f4"), ("npy", "u2"), ("npy", "f4"), ("npy", "f8"), ("npy", "f2"),
        ("npz", "i4"), ("npz", "f4"), ("pfm", "f4"), ("exr", "f4"), ("exr", "f2"),
    ],
)  # fmt: skip
def test_written_files_read_the_same_here_and_in_another_program(tmp_path, suffix, dtype):
    values = (WHOLE if dtype[0] in "iu" else FLOATS).astype(dtype)
    path = tmp_path / f"d.{suffix}"
    write_depth_file(path, values)
    again = read_depth_file(path)
    assert again.dtype == values.dtype
    np.testing.assert_array_equal(again, values)
    np.testing.assert_array_equal(INDEPENDENT["tiff" if suffix == "tif" else suffix](path), values)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_files_of_other_programs_are_read_exactly(tmp_path):
    written(tmp_path / "a.png", png_by_its_specification(WHOLE))
    Image.fromarray(FLOATS.astype("f4")).save(tmp_path / "a.tif")
    np.savez(tmp_path / "a.npz", anything=FLOATS)
    np.save(tmp_path / "a.npy", FLOATS.astype(">f4"))
    np.testing.assert_array_equal(read_depth_file(tmp_path / "a.png"), WHOLE)
    for name in ("a.tif", "a.npz", "a.npy"):
        values = read_depth_file(tmp_path / name)
        assert values.dtype.isnative
        np.testing.assert_array_equal(values, FLOATS)


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (("Y", "Z"), "Z"), (("A", "Y"), "Y"), (("distance",), "distance"), (("B", "G", "R"), "R"),
        (("R", "G", "B", "scene.Z"), "scene.Z"), (("R", "depth.V", "left.depth"), "left.depth"),
    ],
)  # fmt: skip
def test_depth_channel_of_an_openexr_file_is_read(tmp_path, names, taken):
    channels = {name: np.full((2, 3), float(number), np.float32) for number, name in enumerate(names, 1)}
    values = read_depth_file(exr(tmp_path / "d.exr", channels))
    np.testing.assert_array_equal(values, channels[taken])


def test_openexr_file_without_a_depth_channel_is_refused_with_its_channels(tmp_path):
    path = exr(tmp_path / "d.exr", {name: np.ones((2, 3), np.float32) for name in ("U", "V")})
    with pytest.raises(ValueError, match=r"d.exr: expected a channel named Z, Y or R, got U, V$"):
        read_depth_file(path)


def test_file_that_is_no_depth_map_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "eight.png"), np.ones((4, 4), np.uint8))
    cv2.imwrite(str(tmp_path / "colour.png"), np.ones((4, 4, 3), np.uint16))
    np.savez(tmp_path / "two.npz", a=FLOATS, b=FLOATS)
    np.savez(tmp_path / "cube.npz", a=np.ones((2, 2, 2)))
    np.save(tmp_path / "empty.npy", np.ones((0, 3)))
    with zipfile.ZipFile(tmp_path / "none.npz", "w"):
        pass
    (tmp_path / "photo.jpg").write_bytes(b"")
    for name, message in {
        "eight.png": "too coarse for depth",
        "colour.png": "expected one channel",
        "two.npz": "expected one array, or one named depth; got a, b",
        "cube.npz": "expected one channel",
        "empty.npy": "0 x 3 pixels",
        "none.npz": "got none",
        "photo.jpg": "expected a depth map as .png",
        "missing.exr": "there is no such file",
    }.items():
        with pytest.raises(ValueError, match=message) as caught:
            read_depth_file(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)


def test_format_that_cannot_hold_the_values_is_refused(tmp_path):
    assert can_hold(".tif", np.dtype("float32"))
    assert not can_hold(".png", np.dtype("float32"))
    with pytest.raises(ValueError, match=r"d.png: expected uint16 values, got float32"):
        write_depth_file(tmp_path / "d.png", np.ones((2, 2), np.float32))
    assert not any(tmp_path.iterdir())


def pfm(values, order, scale="1.0"):
    """Return a PFM file: text header, rows from the bottom up, a negative scale for little-endian floats."""
    height, width = values.shape
    header = f"Pf\n{width} {height}\n{'-' if order == '<' else ''}{scale}\n".encode()
    return header + b"".join(struct.pack(f"{order}{width}f", *row) for row in values[::-1])


@pytest.mark.parametrize(
    "content",
    [pfm(FLOATS, "<"), pfm(FLOATS, "<", "0.003922"), pfm(FLOATS, ">", "2.5e+1"), pfm(FLOATS, ">"),
     pfm(FLOATS, "<").replace(b"\n", b"\r\n", 3)],
)  # fmt: skip
def test_pfm_of_each_byte_order_and_scale_is_read_from_the_top_row(tmp_path, content):
    np.testing.assert_array_equal(read_depth_file(written(tmp_path / "d.pfm", content)), FLOATS)


@pytest.mark.parametrize(
    "content",
    [
        b"PF\n2 1\n-1.0\n" + bytes(24), b"Pf\n2 1\n0.0\n" + bytes(8), b"Pf\n2 1\n-1.0\n" + bytes(9),
        b"Pf\n2\n-1.0\n" + bytes(8), b"Pf\n0 1\n-1.0\n", b"Pf\n2 1\n1e999\n" + bytes(8), b"Pf\n2 1\nnan\n" + bytes(8),
        b"Pf\n" + b"1" * 5000 + b" 1\n-1.0\n" + bytes(8), b"Pf\n# made by hand\n2 1\n-1.0\n" + bytes(8),
    ],
)  # fmt: skip
def test_pfm_that_is_no_single_channel_of_its_size_is_refused(tmp_path, content):
    with pytest.raises(ValueError, match=r"d\.pfm: expected (one channel|a PFM file)"):
        read_depth_file(written(tmp_path / "d.pfm", content))


@pytest.mark.parametrize("values", [np.ones((2, 3), complex), np.ones((2, 3), bool), np.array([[{}]]), np.ones(3)])
def test_array_that_is_no_map_of_numbers_is_refused(tmp_path, values):
    np.save(tmp_path / "d.npy", values)
    with pytest.raises(ValueError, match=r"d\.npy: expected"):
        read_depth_file(tmp_path / "d.npy")


def test_photo_is_read_as_red_green_blue(tmp_path):
    colours = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [10, 20, 30]]])
    picture = read_rgb(written(tmp_path / "rgb.png", png_by_its_specification(colours, 8, 2)))
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, colours)
    grey = written(tmp_path / "grey.png", png_by_its_specification(colours[..., 0], 8, 0))
    np.testing.assert_array_equal(read_rgb(grey), np.dstack([colours[..., 0]] * 3))
    orange = np.full((16, 24, 3), (0, 128, 255), np.uint8)  # blue, green, red
    assert cv2.imwrite(str(tmp_path / "rgb.jpg"), orange)
    np.testing.assert_allclose(read_rgb(tmp_path / "rgb.jpg"), np.full((16, 24, 3), (255, 128, 0)), atol=3)


def test_mask_is_true_where_its_picture_is_not_0(tmp_path):
    pixels = png_by_its_specification([[0, 1, 255], [128, 0, 0]], 8, 0)
    mask = read_mask(written(tmp_path / "mask.png", pixels))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, [[False, True, True], [True, False, False]])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp", ".ppm", ".pgm"])
def test_header_states_the_size_that_the_decoder_finds_and_one_that_is_cut_off_none(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    shape = (33, 57) if suffix == ".pgm" else (33, 57, 3)
    assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8))
    assert pixels_in_header(path) == (33, 57)
    path.write_bytes(path.read_bytes()[:6])
    assert pixels_in_header(path) is None


# What stored values mean: units, holes, range types, and back to the file

CAMERA = Camera(4, 3, 5.0, 6.0, 1.0, 1.5, baseline=0.1)


def guess(middle, dtype):
    values = np.full((3, 3), middle, dtype)
    reported = interpret("d", values, np.zeros((3, 3), bool))
    return reported.unit, reported.assumptions


@pytest.mark.parametrize(
    ("middle", "dtype", "unit", "word"),
    [
        (2000, "u2", 1e-3, "millimetres"), (51, "u2", 1e-3, "millimetres"), (20_000, "u2", 1e-3, "millimetres"),
        (100_000, "i4", 1e-4, "0.1 mm"), (500_000, "i4", 1e-4, "0.1 mm"), (3_000_000, "u4", 1e-6, "micrometres"),
        (49, "u2", 1e-2, "centimetres"), (4, "u2", None, None), (2.0, "f4", 1.0, "metres"),
        (150.0, "f8", 1.0, "metres"), (1500.0, "f4", 1e-3, "millimetres"),
    ],
)  # fmt: skip
def test_unit_is_guessed_from_type_and_median_and_reported(middle, dtype, unit, word):
    if word is None:
        with pytest.raises(ValueError, match="no usual unit makes its median of 4 a distance; give one"):
            guess(middle, dtype)
        return
    found, assumptions = guess(middle, dtype)
    assert found == unit
    assert word in assumptions[0].text
    assert assumptions[0].detail


def test_depth_too_far_too_near_or_too_sparse_is_pointed_out():
    assert any("1/5000" in assumption.text for assumption in guess(12_000, "u2")[1])
    assert not any("1/5000" in assumption.text for assumption in guess(9_000, "u2")[1])
    sparse = np.arange(9).reshape(3, 3) > 2
    for holes, scan in ((sparse, True), (~sparse, False)):
        reported = interpret("d", np.full((3, 3), 2000, "u2"), holes).assumptions
        assert any("1/256" in assumption.text for assumption in reported) == scan
    assert any("nearer than 5 cm" in assumption.text for assumption in guess(0.01, "f4")[1])


def test_object_that_was_cut_out_is_not_taken_for_a_laser_scan():
    rows, columns = np.mgrid[:60, :80]
    person = (rows - 30) ** 2 / 4 + (columns - 40) ** 2 < 100
    lines = (rows % 6 == 0) & (columns % 2 == 0) & (rows > 20)
    for known, scan in ((person, False), (lines, True)):
        try:
            reported = [str(each) for each in interpret("d", np.full((60, 80), 2000, "u2"), ~known).assumptions]
        except ValueError as error:
            reported = [str(error)]
        assert any("1/256" in each for each in reported) == scan


@pytest.mark.parametrize(
    ("text", "unit"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("0.0002", 0.0002), ("1/5000", 2e-4)]
)
def test_unit_is_a_name_a_number_or_a_fraction(text, unit):
    assert parse_unit(text) == pytest.approx(unit)


@pytest.mark.parametrize("text", ["inch", "", "0", "-1", "1/0", "nan", "inf", "1/2/3"])
def test_unknown_unit_is_refused(text):
    with pytest.raises(ValueError, match="expected m, cm, mm or metres per value"):
        parse_unit(text)


def test_zeros_and_the_largest_whole_number_are_holes():
    holes, mark, assumptions = find_holes(np.array([[0, 1, 65535], [0, 64999, 7]], "u2"), None)
    np.testing.assert_array_equal(holes, [[1, 0, 1], [1, 0, 0]])
    assert mark == 0
    assert [str(assumption) for assumption in assumptions] == [
        "zeros count as holes (33.3%)",
        "values that are 65535 count as holes (16.7%)",
    ]


def test_a_sensors_end_of_16_bits_is_a_hole_unless_the_map_reaches_that_far():
    ends = np.array([[900, 65000], [65534, 1200]], "u2")
    holes, mark, assumptions = find_holes(ends, None)
    np.testing.assert_array_equal(holes, [[0, 1], [1, 0]])
    assert mark == 0
    assert [str(assumption) for assumption in assumptions] == ["values that are 65000 or more count as holes (50.0%)"]
    assert not find_holes(np.array([[900, 65000], [65534, 51000]], "u2"), None)[0].any()
    assert not find_holes(ends.astype("i4"), None)[0].any()


@pytest.mark.parametrize(
    ("values", "hole_value", "mark"),
    [
        ([1, 0, 0, np.nan], None, 0.0), ([1, np.nan, np.nan, 0], None, math.nan), ([1, np.inf, 2, 3], None, math.inf),
        ([1, -1, -2, 3], None, math.nan), ([1, 2, 3, 4], None, math.nan), ([1, -1, 2, 0], -1.0, -1.0),
    ],
)  # fmt: skip
def test_invalid_floats_are_holes_and_the_commonest_mark_is_kept(values, hole_value, mark):
    array = np.array([values], "f4")
    holes, found, _ = find_holes(array, hole_value)
    np.testing.assert_array_equal(holes, ~(np.isfinite(array) & (array > 0)))
    np.testing.assert_equal(found, mark)


@pytest.mark.parametrize(
    "encoding",
    [
        Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal"),
        Encoding(".png", "uint16", 1 / 5000, 0.0, "perspective"),
        Encoding(".npy", "float64", 0.01, math.nan, "orthogonal"),
        Encoding(".pfm", "float32", 1.0, math.inf, "disparity"),
    ],
)
def test_stored_map_round_trips_value_by_value(encoding):
    stored = np.random.default_rng(1).integers(300, 5000, (3, 4)).astype(encoding.dtype)
    holes = np.zeros((3, 4), bool)
    holes[1, 2] = True
    stored[holes] = encoding.hole
    depth = decode(stored, holes, encoding, CAMERA)
    assert (tuple(depth.shape), depth.dtype) == ((1, 3, 4), torch.float32)
    again, lost = encode(depth, encoding, CAMERA)
    assert (again.dtype, lost) == (stored.dtype, 0)
    np.testing.assert_allclose(again, stored, rtol=3e-7)
    if stored.dtype.kind == "u":
        np.testing.assert_array_equal(again, stored)


def test_range_types_equal_their_closed_forms():
    values, none = np.full((3, 4), 2.0), np.zeros((3, 4), bool)
    along_ray = decode(values, none, Encoding(".npy", "float64", 1.0, math.nan, "perspective"), CAMERA)
    assert float(along_ray[0, 0, 3]) == pytest.approx(2 / math.sqrt(1 + (2 / 5) ** 2 + (1.5 / 6) ** 2))
    disparity = decode(values, none, Encoding(".npy", "float64", 1.0, math.nan, "disparity"), CAMERA)
    assert float(disparity[0, 0, 0]) == pytest.approx(0.1 * 5 / 2)


def test_values_beyond_16_bits_of_a_millimetre_become_counted_holes():
    depth = torch.tensor([[[65.534, 65.6, 0.0001, math.nan], [1.0004, 1.0006, 2, 3], [1, 1, 1, 1]]])
    values, lost = encode(depth, Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal"), CAMERA)
    assert lost == 2
    np.testing.assert_array_equal(values[:2], [[65534, 0, 0, 0], [1000, 1001, 2000, 3000]])


def test_maps_of_sensors_in_millimetres_and_metres_are_never_asked_about(shared):
    """Each is read in both, as it is and as floats; nothing is warned of."""
    paths = [
        *sorted((shared / "modern" / "RGBDD" / "Depth").glob("*.png"))[::8],
        *(shared / "real" / "depth_camera").glob("*/raw_depth.png"),
        *sorted((shared / "real" / "ddrnet").glob("*depth*/*.png"))[::8],
        *(shared / "real" / "stereo_board" / "depth").glob("*.png"),
        shared / "real" / "iphone_lidar" / "arkit_depth.png",
    ]
    assert len(paths) > 10
    for path in paths:
        values = read_depth_file(path)
        holes = find_holes(values, None)[0]
        for each, unit in ((values, 1e-3), (values.astype(np.float32) / 1000, 1.0)):
            reported = interpret(str(path), each, holes, Camera.from_fov(60, values.shape[1], values.shape[0]))
            assert (reported.unit, reported.range_type, reported.bits) == (unit, None, 0)
            assert not [each for each in reported.assumptions if each.code]
