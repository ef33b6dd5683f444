"""Readers of pictures, range maps, numbers and cameras, which check sizes first and whose errors name the file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import AliasChoices, BaseModel, BeforeValidator, Field

from dsr.geometry.camera import Camera, RangeType
from dsr.notes import Assumption
from dsr.utils.arrays import read_array_header
from dsr.utils.decoding import decode_pixels, format_not_read, picture_size
from dsr.utils.guards import (
    MOST_FILE,
    array_bytes,
    expect_bytes,
    expect_pixels,
    naming,
    numbers_in,
    opened,
    parse_json,
    pixels_of_file,
    read_limited,
    read_text,
    refusing,
    split_numbers,
)
from dsr.utils.validation import Number, Whole, parse_model

MAP_SUFFIXES = (".npy", ".png", ".tiff", ".tif", ".pfm")
_METRES = {"m": 1.0, "mm": 1e-3}
_BITS, _DARK = (8, 10, 12, 14, 16), 64
"""Bits that a photo of 16 may use, and what its values of 8 bits are below if it does not use all."""
_LONGEST = 40
"""Largest number of bytes of a number and the blank behind it."""
_TEXT = re.compile(r"[-+.\deEnaifNAIF\s,]*")
_MAPS = (
    "JET", "TURBO", "VIRIDIS", "PLASMA", "INFERNO", "MAGMA", "HOT", "BONE", "RAINBOW", "HSV", "PARULA", "CIVIDIS",
    "OCEAN", "COOL", "AUTUMN", "SUMMER", "SPRING", "WINTER", "PINK", "TWILIGHT",
)  # fmt: skip
_SAMPLE, _ALIKE, _SHARE = 2000, 12, 0.9
"""Number of pixels that are compared, the largest difference of a channel of 255, and the share of pixels that have one
of a map's colours."""


def pixels_in_header(path: Path) -> tuple[int, int] | None:
    """Return height and width that a picture file declares; None if it is missing, damaged or no picture."""
    try:
        with opened(path) as file:
            header = picture_size(file)
    except OSError:
        return None
    return None if header is None else (header.height, header.width)


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
    """Return a one-channel map of floats, 16- or 32-bit whole numbers as float64, (H, W).

    Args:
        most: largest number of pixels; None for what the size of the file explains.

    Raises:
        ValueError: it is missing, damaged, of another shape, or has 8-bit values (too coarse for a surface).

    """
    with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
        return read_values(path, most).astype(np.float64)


def read_values(path: Path, most: int | None = None) -> np.ndarray:
    """Return a one-channel map in the type that it is stored in, (H, W); see :func:`read_map`."""
    return expect_depth_values(path, read_array(path, most))


def read_array(path: Path, most: int | None = None) -> np.ndarray:
    """Return the values of a map in the type and shape that it is stored in.

    Args:
        most: largest number of pixels; None for what the size of the file explains.

    Raises:
        ValueError: it is missing, damaged or too large.

    """
    readers = {".npy": _load_npy, ".pfm": _load_pfm}
    reader = readers.get(path.suffix.lower())
    return read_pixels(path, cv2.IMREAD_UNCHANGED, most) if reader is None else reader(path, most)


def expect_depth_values(path: Path, values: np.ndarray) -> np.ndarray:
    """Return the values of a depth file if they are (H, W), floats or whole numbers of 16 bits or more."""
    if values.ndim != 2:
        what = f": {describe_picture(values)}" if values.dtype in (np.uint8, np.uint16) else ""
        raise ValueError(f"{path}: expected one channel (height x width), got shape {values.shape}{what}")
    if values.dtype.kind not in "fiu" or (values.dtype.kind in "iu" and values.dtype.itemsize == 1):
        what = f": {describe_picture(values)}" if values.dtype == np.uint8 else ""
        raise ValueError(
            f"{path}: expected 16-bit or floating point values, got {values.dtype} (too coarse for depth){what}"
        )
    return values


def read_levels(path: Path) -> np.ndarray:
    """Return an 8-bit one-channel picture as it is, (H, W) uint8: disparities of older benchmarks."""
    levels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    if levels.ndim != 2 or levels.dtype != np.uint8:
        raise ValueError(f"{path}: expected one channel of 8 bits, got {levels.dtype} of shape {levels.shape}")
    return levels


def read_mask(path: Path, most: int | None = None) -> np.ndarray:
    """Return a mask, (H, W) bool: True where the picture is not 0.

    Args:
        most: largest number of pixels; None for what the size of the file explains.

    Raises:
        ValueError: it is missing, damaged or too large.

    """
    return read_pixels(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, most) > 0


def read_numbers(path: Path, count: int) -> np.ndarray:
    """Return the numbers of a text file, separated by blanks, commas or line ends, as float64 (count,).

    Raises:
        ValueError: it is missing, holds something else, or another number of them.

    """
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


@dataclass(frozen=True)
class CameraFile:
    """The content of a ``camera.json``.

    Args:
        camera: in pixels and metres.
        range_type: how the maps beside it count; None where it does not say.
        depth_unit: metres per value in depth files; None where it does not say.
        hole_value: the value that stands for a hole in files that cannot hold NaN; None for none.

    """

    camera: Camera
    range_type: RangeType | None
    depth_unit: float | None
    hole_value: float | None


def read_camera(path: Path) -> CameraFile:
    """Return the content of a ``camera.json`` of dsr, or a ``cam_params.json`` as NICE-SLAM's data sets have it.

    Raises:
        ValueError: it is missing or damaged, or a key is missing, unknown or out of range.

    """
    content = read_text(path)
    if (params := _params_in(content)) is not None:
        return _read_params(path, content, params)
    entries = parse_model(_CameraJson, content, path).model_dump(exclude_unset=True, exclude_none=True)
    if "baseline" in entries:
        entries["baseline"] *= _METRES[entries.get("baseline_unit", "m")]
    with naming(path):
        camera = Camera(**{each.name: entries[each.name] for each in fields(Camera) if each.name in entries})
    return CameraFile(camera, *map(entries.get, ("range_type", "depth_unit", "hole_value")))


def _params_in(content: str) -> type[_Params | _NestedParams] | None:
    """Return how JSON has the keys of NICE-SLAM's ``cam_params.json``, nested or not; None if it has none of them."""
    try:
        entries = parse_json(content)
    except ValueError:
        return None
    if not isinstance(entries, dict):
        return None
    return _NestedParams if isinstance(entries.get("camera"), dict) else _Params if _SCALES & entries.keys() else None


def _read_params(path: Path, content: str, kind: type[_Params | _NestedParams]) -> CameraFile:
    """Return the camera of a ``cam_params.json``, and the unit that its scale says."""
    read = parse_model(kind, content, path)
    params = read.camera if isinstance(read, _NestedParams) else read
    with naming(path):
        camera = Camera(params.w, params.h, params.fx, params.fy, params.cx, params.cy)
    return CameraFile(camera, None, None if params.scale is None else 1 / params.scale, None)


def _metres(unit: Any) -> Any:
    """Return metres per value for the name of a unit, and anything else as it is."""
    if not isinstance(unit, str):
        return unit
    if unit not in _METRES:
        raise ValueError("m, mm or a positive number of metres per value")
    return _METRES[unit]


_Number = Annotated[Number, Field(ge=-1e12, le=1e12)]
"""Beyond these limits, no number in a camera file means anything."""
Pixels = Annotated[Whole, Field(ge=1, le=1e12)]
"""A size in a camera file."""


class _CameraJson(BaseModel, strict=True, extra="forbid"):
    """A ``camera.json`` as it is stored; keys that it lacks do not get the defaults."""

    width: Pixels
    height: Pixels
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number
    range_type: RangeType | None = None
    baseline: _Number | None = None
    baseline_unit: Literal["m", "mm"] = "m"
    doffs: _Number = 0.0
    depth_unit: Annotated[_Number, Field(gt=0), BeforeValidator(_metres)] = 1.0
    hole_value: _Number = 0.0


_SCALES = {"scale", "png_depth_scale"}


class _Params(BaseModel, strict=True):
    """NICE-SLAM's ``cam_params.json``; the scale is the number of values in a metre."""

    w: Pixels = Field(validation_alias=AliasChoices("w", "W", "width"))
    h: Pixels = Field(validation_alias=AliasChoices("h", "H", "height"))
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number
    scale: Annotated[_Number, Field(ge=1)] | None = Field(None, validation_alias=AliasChoices(*sorted(_SCALES)))


class _NestedParams(BaseModel, strict=True):
    """The same under the key ``camera``."""

    camera: _Params


def _content(path: Path) -> bytes:
    """Return what is in a picture file."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a picture, there is none")
    return read_limited(path, MOST_FILE)


def _load_pfm(path: Path, most: int | None) -> np.ndarray:
    """Return a PFM file's values as they are, (H, W).

    The header's scale says the byte order by its sign; its magnitude, which OpenCV multiplies by, is left alone, as the
    stereo benchmarks do.
    """
    data = _content(path)
    header = re.match(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,40})(?:\r\n|\s)", data)
    if header is None:
        raise ValueError(f"{path}: expected a PFM file, got something else")
    if header[1] != b"Pf":
        raise ValueError(f"{path}: expected one channel, got a PFM file with three")
    width, height = int(header[2]), int(header[3])
    scale = next(iter(numbers_in([header[4].decode()])), 0.0)
    if most is not None:
        expect_pixels(path, height, width, most)
    pixels = memoryview(data)[header.end() :]
    if not 0 < abs(scale) < math.inf or not width or not height or len(pixels) != 4 * width * height:
        raise ValueError(f"{path}: expected a PFM file of {width} x {height} floats, got a damaged one")
    return np.frombuffer(pixels, "<f4" if scale < 0 else ">f4").reshape(height, width)[::-1]


def _load_npy(path: Path, most: int | None) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    try:
        with path.open("rb") as file:
            shape, dtype = read_array_header(file)
            count = pixels_of_file(path.stat().st_size) if most is None else most
            expect_bytes("the array", array_bytes(shape, dtype.itemsize), min(8 * count, path.stat().st_size))
            file.seek(0)
            return np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # a damaged header makes NumPy raise OSError, MemoryError, TokenError, ...
        raise ValueError(f"{path}: expected a NumPy array, got a damaged or foreign file ({error})") from error


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


def describe_picture(values: np.ndarray) -> str:
    """Describe what a picture of several channels, or of 8 bits, probably shows.

    Args:
        values: (H, W) or (H, W, C) as they are stored.

    """
    if values.ndim == 2:
        return "a picture for viewing, or disparities of an old benchmark"
    if values.ndim == 3 and values.shape[2] == 2:
        return "grey that is transparent in places"
    if values.ndim != 3 or values.shape[2] not in (3, 4) or not values.size:
        return "no map"
    pixels = values[..., :3].reshape(-1, 3)
    pixels = pixels[:: -(-len(pixels) // _SAMPLE)].astype(np.int64)
    if (pixels == pixels[:, :1]).all():
        return "three equal channels, a grey picture for viewing"
    pixels = pixels // 257 if values.dtype == np.uint16 else pixels
    pixels = pixels[pixels.any(axis=1)]  # black where there is nothing to colour
    for name in _MAPS:
        colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{name}"))
        for order in (colours[:, 0].astype(np.int64), colours[:, 0, ::-1].astype(np.int64)):
            apart = np.abs(pixels[:, None] - order).max(axis=2).min(axis=1)
            if (apart <= _ALIKE).mean() > _SHARE:
                return f"a picture coloured for viewing by the map {name.lower()}, whose values are lost"
    return "a picture in colour, a photo or a map coloured for viewing"
