"""Depth maps read and written with their stored values: PNG, TIFF, NPY, NPZ, PFM and OpenEXR; ICL-NUIM's are read.

:mod:`dsr.io.encoding` converts the values to metres and handles holes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from dsr.data.formats.files import expect_depth_values, quiet_decoders, read_array, read_values
from dsr.data.formats.icl_nuim import CAMERA as ICL_CAMERA
from dsr.data.formats.shared import read_numbers
from dsr.utils.files import read_arrays, replacing

DEPTH_SUFFIXES = (".png", ".tiff", ".tif", ".npy", ".npz", ".pfm", ".exr")
"""Of the formats that are read and written."""
ICL_SUFFIX = ".depth"
"""Of ICL-NUIM's text, distances along the rays in centimetres, :mod:`dsr.data.formats.icl_nuim`."""
READ_SUFFIXES = (*DEPTH_SUFFIXES, ICL_SUFFIX)
_STORABLE = {
    ".png": ("uint16",),
    ".tiff": ("uint16", "int16", "int32", "uint32", "float32", "float64"),
    ".pfm": ("float32",),
    ".exr": ("float16", "float32", "uint32"),
}
"""Types of value by file format; NumPy's formats take any."""


def read_depth_file(path: Path) -> np.ndarray:
    """Return a map as it is stored, (H, W), floats or whole numbers of 16 bits or more in this machine's byte order.

    Of an OpenEXR file the channel named Z or depth is taken (of any layer), else Y, else the only one, else R; of an
    ``.npz`` file the array named depth, else the only one.

    Raises:
        ValueError: it is missing, damaged, of another format or shape, or has 8-bit values.

    """
    suffix = path.suffix.lower()
    if suffix not in READ_SUFFIXES:
        raise ValueError(f"{path}: expected a depth map as {', '.join(READ_SUFFIXES)}, got {suffix or 'no suffix'}")
    if not path.is_file():
        raise ValueError(f"{path}: expected a depth map, there is no such file")
    readers = {".exr": _read_exr, ".npz": _read_npz, ICL_SUFFIX: _read_icl}
    values = expect_depth_values(path, readers[suffix](path)) if suffix in readers else read_values(path)
    if values.size == 0:
        raise ValueError(f"{path}: expected a depth map, got one of {values.shape[0]} x {values.shape[1]} pixels")
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


def read_array_file(path: Path) -> np.ndarray:
    """Return the array of an NPY, NPZ, PFM or OpenEXR file, of any type and shape; see :func:`read_depth_file`.

    Raises:
        ValueError: it is missing or damaged.

    """
    suffix = path.suffix.lower()
    return _read_exr(path) if suffix == ".exr" else _read_npz(path) if suffix == ".npz" else read_array(path)


def write_depth_file(path: Path, values: np.ndarray) -> None:
    """Write a map as it is, atomically, in the format that the suffix names.

    Args:
        path: with one of :data:`DEPTH_SUFFIXES`.
        values: (H, W), of a type that :func:`can_hold` says the format has.

    Raises:
        ValueError: the format cannot hold values of this type.

    """
    suffix = path.suffix.lower()
    if not can_hold(suffix, values.dtype):
        raise ValueError(f"{path}: expected {' or '.join(_STORABLE[_format(suffix)])} values, got {values.dtype}")
    with replacing(path) as temporary:
        if suffix == ".npy":
            np.save(temporary, values)
        elif suffix == ".npz":
            np.savez_compressed(temporary, depth=values)
        elif suffix == ".pfm":
            header = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.0\n".encode()
            temporary.write_bytes(header + values[::-1].astype("<f4").tobytes())
        elif suffix == ".exr":
            _write_exr(temporary, values)
        else:
            written, content = cv2.imencode(suffix, values)
            if not written:
                raise ValueError(f"{path}: {values.shape[0]} x {values.shape[1]} pixels could not be encoded")
            temporary.write_bytes(content.tobytes())


def can_hold(suffix: str, dtype: np.dtype) -> bool:
    """Return whether the format of a suffix holds values of a type exactly."""
    return str(dtype) in _STORABLE.get(_format(suffix), (str(dtype),))


def _format(suffix: str) -> str:
    """Return the first of the suffixes that mean one format."""
    return ".tiff" if suffix == ".tif" else suffix


def _read_icl(path: Path) -> np.ndarray:
    """Return the numbers of a file of ICL-NUIM, (480, 640) float64."""
    return read_numbers(path, ICL_CAMERA.height * ICL_CAMERA.width).reshape(ICL_CAMERA.height, ICL_CAMERA.width)


def _read_npz(path: Path) -> np.ndarray:
    """Return the array named depth, or the only one."""
    arrays = read_arrays(path)
    if len(arrays) == 1:
        return next(iter(arrays.values()))
    if "depth" not in arrays:
        raise ValueError(f"{path}: expected one array, or one named depth; got {', '.join(sorted(arrays)) or 'none'}")
    return arrays["depth"]


def _read_exr(path: Path) -> np.ndarray:
    """Return the depth channel of an OpenEXR file; see https://openexr.com/en/latest/StandardOptions.html."""
    import OpenEXR  # noqa: PLC0415 - only where somebody has such a file

    try:  # damaged files print on both streams
        quiet = contextlib.redirect_stdout(io.StringIO())
        with quiet_decoders(), quiet, OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # RuntimeError, ValueError, MemoryError, ...
        raise ValueError(f"{path}: expected an OpenEXR file, got a damaged or foreign one") from error
    return channels[_depth_channel(path, channels)]


def _depth_channel(path: Path, channels: Mapping[str, np.ndarray]) -> str:
    """Return which channel holds depth."""
    last = {name: name.rpartition(".")[2].lower() for name in sorted(channels)}
    for wanted in ("z", "depth", "y"):
        found = [name for name, short in last.items() if short == wanted]
        if found:
            return min(found, key=len)
    if len(channels) == 1:
        return next(iter(channels))
    if "R" in channels:
        return "R"
    raise ValueError(f"{path}: expected a channel named Z, Y or R, got {', '.join(sorted(channels)) or 'none'}")


def _write_exr(path: Path, values: np.ndarray) -> None:
    """Write one channel, Z."""
    import OpenEXR  # noqa: PLC0415 - as above

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(values)}) as file:
        file.write(str(path))
