"""People's depth files and photos: each format against an independent reader or writer."""

import struct
import zipfile

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from small_files import png_by_its_specification, written

from dsr.io.depth_files import can_hold, read_depth_file, write_depth_file
from dsr.io.images import pixels_in_header, read_mask, read_rgb

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
