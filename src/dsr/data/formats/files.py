"""Readers of pictures, range maps and cameras, whose errors are one line that names the file."""

from __future__ import annotations

import math
import os
import re
import threading
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from dsr.geometry.camera import Camera, RangeType
from dsr.utils.validation import describe

MAP_SUFFIXES = (".npy", ".png", ".tiff", ".tif", ".pfm")
_METRES = {"m": 1.0, "mm": 1e-3}


def read_rgb(path: Path) -> np.ndarray:
    """Return a picture as uint8 RGB, (H, W, 3).

    Raises:
        ValueError: it is missing, damaged or no picture.

    """
    picture = read_pixels(path, cv2.IMREAD_COLOR)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def read_map(path: Path) -> np.ndarray:
    """Return a one-channel map of floats, 16- or 32-bit whole numbers as float64, (H, W).

    Raises:
        ValueError: it is missing, damaged, of another shape, or has 8-bit values (too coarse for a surface).

    """
    with np.errstate(invalid="ignore"):  # a damaged file may hold signalling NaNs
        return read_values(path).astype(np.float64)


def read_values(path: Path) -> np.ndarray:
    """Return a one-channel map in the type that it is stored in, (H, W); see :func:`read_map`.

    Raises:
        ValueError: as for :func:`read_map`.

    """
    return expect_depth_values(path, read_array(path))


def read_array(path: Path) -> np.ndarray:
    """Return the values of a map in the type and shape that it is stored in.

    Raises:
        ValueError: it is missing or damaged.

    """
    readers = {".npy": _load_npy, ".pfm": _load_pfm}
    reader = readers.get(path.suffix.lower())
    return read_pixels(path, cv2.IMREAD_UNCHANGED) if reader is None else reader(path)


def expect_depth_values(path: Path, values: np.ndarray) -> np.ndarray:
    """Return the values of a depth file.

    Raises:
        ValueError: they are not (H, W), or no floats or whole numbers of 16 bits or more.

    """
    if values.ndim != 2:
        raise ValueError(f"{path}: expected one channel (height x width), got shape {values.shape}")
    if values.dtype.kind not in "fiu" or (values.dtype.kind in "iu" and values.dtype.itemsize == 1):
        raise ValueError(f"{path}: expected 16-bit or floating point values, got {values.dtype} (too coarse for depth)")
    return values


def read_levels(path: Path) -> np.ndarray:
    """Return an 8-bit one-channel picture as it is, (H, W) uint8: disparities of older benchmarks.

    Raises:
        ValueError: it is missing, damaged, or has other values.

    """
    levels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    if levels.ndim != 2 or levels.dtype != np.uint8:
        raise ValueError(f"{path}: expected one channel of 8 bits, got {levels.dtype} of shape {levels.shape}")
    return levels


def read_mask(path: Path) -> np.ndarray:
    """Return a mask, (H, W) bool: True where the picture is not 0.

    Raises:
        ValueError: it is missing or damaged.

    """
    return read_pixels(path, cv2.IMREAD_GRAYSCALE) > 0


@dataclass(frozen=True)
class CameraFile:
    """What a ``camera.json`` says.

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
    """Return the content of a ``camera.json``.

    Raises:
        ValueError: it is missing or damaged, or a key is missing, unknown or out of range.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a camera file, there is none")
    try:
        entries = _CameraJson.model_validate_json(path.read_bytes()).model_dump(exclude_unset=True, exclude_none=True)
        if "baseline" in entries:
            entries["baseline"] *= _METRES[entries.get("baseline_unit", "m")]
        camera = Camera(**{each.name: entries[each.name] for each in fields(Camera) if each.name in entries})
    except ValidationError as error:
        raise ValueError(f"{path}: {describe(error, _CameraJson.model_fields)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return CameraFile(camera, *map(entries.get, ("range_type", "depth_unit", "hole_value")))


def _whole(value: Any) -> Any:
    """Return a whole float, such as 640.0, as int and anything else as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _metres(unit: Any) -> Any:
    """Return metres per value for the name of a unit, and anything else as it is."""
    if not isinstance(unit, str):
        return unit
    if unit not in _METRES:
        raise ValueError("m, mm or a positive number of metres per value")
    return _METRES[unit]


_Number = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)]
"""Beyond these limits, no number in a camera file means anything."""
Pixels = Annotated[int, Field(ge=1, le=1e12), BeforeValidator(_whole)]
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


def _content(path: Path) -> bytes:
    """Return what is in a picture file."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a picture, there is none")
    return path.read_bytes()


def _load_pfm(path: Path) -> np.ndarray:
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
    try:
        scale = float(header[4])
    except ValueError:
        scale = 0.0
    pixels = data[header.end() :]
    if not 0 < abs(scale) < math.inf or not width or not height or len(pixels) != 4 * width * height:
        raise ValueError(f"{path}: expected a PFM file of {width} x {height} floats, got a damaged one")
    return np.frombuffer(pixels, "<f4" if scale < 0 else ">f4").reshape(height, width)[::-1]


def _load_npy(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:  # a damaged header makes NumPy raise OSError, MemoryError, TokenError, ...
        raise ValueError(f"{path}: expected a NumPy array, got a damaged or foreign file ({error})") from error


def read_pixels(path: Path, flags: int) -> np.ndarray:
    """Return the pixels of a picture file as OpenCV decodes them.

    Args:
        path: the file.
        flags: OpenCV's.

    Raises:
        ValueError: it is missing, damaged or no picture.

    """
    content = _content(path)
    try:
        with _QUIET_STDERR:
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError(f"{path}: expected a picture, got a damaged or foreign file of {len(content)} bytes")
    return pixels


class _QuietStderr:
    """A context in which stderr is discarded, so that messages of decoders (libpng, OpenCV) are not shown.

    Threads may be in it at the same time: the first redirects stderr and the last restores it.
    """

    def __init__(self) -> None:
        self._lock, self._within, self._kept = threading.Lock(), 0, -1

    def __enter__(self) -> None:
        with self._lock:
            if not self._within:
                self._kept = os.dup(2)
                with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device
                    os.dup2(nowhere.fileno(), 2)
            self._within += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._within -= 1
            if not self._within:
                os.dup2(self._kept, 2)
                os.close(self._kept)


_QUIET_STDERR = _QuietStderr()


def quiet_decoders() -> _QuietStderr:
    """Return a context in which messages of decoders about damaged files are not shown."""
    return _QUIET_STDERR
