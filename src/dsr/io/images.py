"""Pictures, maps of numbers, and numbers in text from files; errors name the file."""

import contextlib
import io
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from dsr.notes import Assumption
from dsr.utils.arrays import array_headers, read_arrays
from dsr.utils.decoding import QUIET_DECODERS, decode_pixels, format_not_read, picture_size
from dsr.utils.guards import (
    MOST_FILE,
    expect_pixels,
    numbers_in,
    opened,
    read_limited,
    read_text,
    refusing,
    split_numbers,
)
from dsr.utils.validation import Whole

Size = tuple[int, int]  # height and width in pixels
MAP_SUFFIXES = (".npy", ".png", ".tiff", ".tif", ".pfm")
Pixels = Annotated[Whole, Field(ge=1, le=1e12)]  # a size in a camera file
_BITS, _DARK = (8, 10, 12, 14, 16), 64  # that a photo of 16 bits may use; its values of 8 bits are below if not all
_LONGEST = 40  # bytes of a number and the blank behind it
_TEXT = re.compile(r"[-+.\deEnaifNAIF\s,]*")


def pixels_in_header(path: Path) -> tuple[int, int] | None:
    """Return height and width that a picture file declares; None if it is missing, damaged or no picture."""
    try:
        with opened(path) as file:
            return picture_size(file)
    except OSError:
        return None


def read_rgb(path: Path) -> np.ndarray:
    """Return a picture as uint8 RGB, (H, W, 3)."""
    return read_colours(path, cv2.IMREAD_COLOR)[0]


def read_colours(path: Path, flags: int) -> tuple[np.ndarray, list[Assumption]]:
    """Return a picture as uint8 RGB, (H, W, 3), one of 8 to 14 bits in 16 brightened, with a note of that."""
    pixels = read_pixels(path, flags)
    deep = read_pixels(path, flags | cv2.IMREAD_ANYDEPTH) if pixels.max() < _DARK else pixels
    bits, notes = used_bits(deep)
    if notes:
        pixels = (deep // 2 ** (bits - 8)).astype(np.uint8)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), notes


def used_bits(pixels: np.ndarray) -> tuple[int, list[Assumption]]:
    """Return the bits that the values of a photo, uint8 or uint16, use, and a note if they are 8 to 14 of 16."""
    if pixels.dtype != np.uint16 or not pixels.any():
        return 8 * pixels.itemsize, []
    bits = next(bits for bits in _BITS if pixels.max() < 1 << bits)
    text = f"the photo uses {bits} of its 16 bits and is brightened accordingly"
    return bits, [Assumption(text, f"up to {pixels.max()}")] if bits < 16 else []


def read_map(path: Path, most: int | None = None) -> np.ndarray:
    """Return a map of floats, 16- or 32-bit whole numbers, (H, W) float64, of at most so many pixels."""
    with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
        return read_values(path, most).astype(np.float64)


def read_values(path: Path, most: int | None = None) -> np.ndarray:
    """Return a map in the type that it is stored in, (H, W), floats or whole numbers of 16 bits or more."""
    values = read_array(path, most)
    what = f": {_describe_picture(values)}" if values.dtype in (np.uint8, np.uint16) else ""
    if values.ndim != 2:
        raise ValueError(f"{path}: expected one channel (height x width), got shape {values.shape}{what}")
    if values.dtype.kind not in "fiu" or (values.dtype.kind in "iu" and values.dtype.itemsize == 1):
        raise ValueError(f"{path}: expected 16 bits or floats, got {values.dtype} (too coarse for depth){what}")
    return values


def read_array(path: Path, most: int | None = None) -> np.ndarray:
    """Return the values of a picture, NPY, NPZ, PFM or OpenEXR file in the type and shape that they are stored in."""
    readers = {".npy": _read_npy, ".npz": _read_npz, ".pfm": _read_pfm, ".exr": _read_exr}
    if path.suffix.lower() not in readers:
        return read_pixels(path, cv2.IMREAD_UNCHANGED, most)
    values = readers[path.suffix.lower()](path)
    if most is not None and values.ndim > 1:
        expect_pixels(path, values.shape[0], values.shape[1], most)
    return values


def _describe_picture(values: np.ndarray) -> str:
    """Describe what a picture of several channels, or of 8 bits, probably shows."""
    if values.ndim == 2:
        return "a picture for viewing, or disparities of an old benchmark"
    if values.ndim == 3 and values.shape[2] == 2:
        return "grey that is transparent in places"
    if values.ndim != 3 or values.shape[2] not in (3, 4) or not values.size:
        return "no map"
    if (values[..., :3] == values[..., :1]).all():
        return "three equal channels, a grey picture for viewing"
    return "a picture in colour, a photo or a map coloured for viewing"


def read_levels(path: Path) -> np.ndarray:
    """Return an 8-bit one-channel picture as it is, (H, W) uint8: disparities of older benchmarks."""
    levels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    if levels.ndim != 2 or levels.dtype != np.uint8:
        raise ValueError(f"{path}: expected one channel of 8 bits, got {levels.dtype} of shape {levels.shape}")
    return levels


def read_mask(path: Path, most: int | None = None) -> np.ndarray:
    """Return a mask, (H, W) bool: True where the picture, of at most so many pixels, is not 0."""
    return read_pixels(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, most) > 0


def read_numbers(path: Path, count: int) -> np.ndarray:
    """Return the numbers of a text file, separated by blanks, commas or line ends, as float64 (count,)."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a text file of {count} numbers, there is none")
    size = path.stat().st_size
    if size > _LONGEST * count:
        raise ValueError(f"{path}: expected {count} numbers, got {size} bytes, too many for that")
    content = read_text(path, size)
    with refusing(f"{path}: expected {count} numbers, got text or bytes that are none", ValueError):
        values = np.array(split_numbers(content) if _TEXT.fullmatch(content) else "", dtype=np.float64)
    if values.size != count:
        raise ValueError(f"{path}: expected {count} numbers, got {values.size}")
    return values


def _content(path: Path) -> bytes:
    if not path.is_file():
        raise ValueError(f"{path}: expected a picture, there is none")
    return read_limited(path, MOST_FILE)


def _read_pfm(path: Path) -> np.ndarray:
    """Return a PFM file's values, (H, W), not multiplied by the header's scale, as in the stereo benchmarks."""
    data = _content(path)
    header = re.match(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,40})(?:\r\n|\s)", data)
    if header is None:
        raise ValueError(f"{path}: expected a PFM file, got something else")
    if header[1] != b"Pf":
        raise ValueError(f"{path}: expected one channel, got a PFM file with three")
    width, height = int(header[2]), int(header[3])
    scale = next(iter(numbers_in([header[4].decode()])), 0.0)
    pixels = memoryview(data)[header.end() :]
    if not 0 < abs(scale) < math.inf or not width or not height or len(pixels) != 4 * width * height:
        raise ValueError(f"{path}: expected a PFM file of {width} x {height} floats, got a damaged one")
    return np.frombuffer(pixels, "<f4" if scale < 0 else ">f4").reshape(height, width)[::-1]


def _read_npy(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    # a damaged header makes NumPy raise OSError, MemoryError, TokenError, ...
    with refusing(f"{path}: expected a NumPy array, got a damaged or foreign file", Exception), path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _read_npz(path: Path) -> np.ndarray:
    names = sorted(array_headers(path))
    if len(names) != 1 and "depth" not in names:
        raise ValueError(f"{path}: expected one array, or one named depth; got {', '.join(names) or 'none'}")
    name = names[0] if len(names) == 1 else "depth"
    return read_arrays(path, (name,))[name]


def _read_exr(path: Path) -> np.ndarray:
    """Return the depth channel of an OpenEXR file; see https://openexr.com/en/latest/StandardOptions.html."""
    import OpenEXR  # noqa: PLC0415 - only where somebody has such a file

    channels, windows = {}, {}
    # damaged files raise RuntimeError, ValueError, MemoryError, ..., and print on both streams
    with refusing(f"{path}: expected an OpenEXR file, got a damaged or foreign one", Exception):
        quiet = contextlib.redirect_stdout(io.StringIO())
        with QUIET_DECODERS, quiet, OpenEXR.File(str(path), separate_channels=True) as file:
            for number in reversed(range(len(file.parts))):
                corners = (file.parts[number].header[name] for name in ("dataWindow", "displayWindow"))
                ends = [(least.astype(int).tolist(), most.astype(int).tolist()) for least, most in corners]
                for name, channel in file.channels(number).items():
                    channels[name], windows[name] = channel.pixels, ends
    chosen = _depth_channel(path, channels)
    values = channels[chosen]
    # rows and columns of the pixels that are stored, and of those that are shown
    stored, shown = ([range(least[axis], most[axis] + 1) for axis in (1, 0)] for least, most in windows[chosen])
    if stored == shown or values.shape != tuple(map(len, stored)) or 0 in map(len, shown):
        return values
    expect_pixels(path, len(shown[0]), len(shown[1]))
    whole = np.full([len(each) for each in shown], np.nan if values.dtype.kind == "f" else 0, values.dtype)
    inside = [np.isin(each, there) for each, there in zip(shown, stored, strict=True)]
    within = [np.isin(each, there) for each, there in zip(stored, shown, strict=True)]
    whole[np.ix_(*inside)] = values[np.ix_(*within)]
    return whole


def _depth_channel(path: Path, channels: Iterable[str]) -> str:
    last = {name: name.rpartition(".")[2].lower() for name in sorted(channels)}
    for wanted in ("z", "depth", "y"):
        found = [name for name, short in last.items() if short == wanted]
        if found:
            return min(found, key=len)
    if len(last) == 1:
        return next(iter(last))
    if "R" in last:
        return "R"
    raise ValueError(f"{path}: expected a channel named Z, Y or R, got {', '.join(last) or 'none'}")


def read_pixels(path: Path, flags: int, most: int | None = None) -> np.ndarray:
    """Return the pixels of a picture file; see :func:`dsr.utils.decoding.decode_pixels`."""
    content = _content(path)
    pixels = decode_pixels(path, content, flags, most)
    if pixels is None:
        kind = format_not_read(content, stored=flags == cv2.IMREAD_UNCHANGED)
        if kind:
            raise ValueError(f"{path}: expected PNG, JPEG, TIFF, BMP, WebP or PNM, got {kind}, which is not read here")
        raise ValueError(f"{path}: expected a picture, got a damaged or foreign file of {len(content)} bytes")
    return pixels
