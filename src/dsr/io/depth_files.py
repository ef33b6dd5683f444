"""Depth maps read and written with their stored values: PNG, TIFF, NPY, NPZ, PFM and OpenEXR; ICL-NUIM's are read.

:mod:`dsr.io.encoding` converts the values to metres and handles holes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from dsr.geometry.camera import Camera
from dsr.io.images import expect_depth_values, read_array, read_numbers
from dsr.utils.arrays import array_headers, read_arrays
from dsr.utils.decoding import QUIET_DECODERS
from dsr.utils.files import replacing
from dsr.utils.guards import expect_pixels, refusing

DEPTH_SUFFIXES = (".png", ".tiff", ".tif", ".npy", ".npz", ".pfm", ".exr")  # that are read and written
ICL_CAMERA = Camera(640, 480, 481.2, -480.0, 319.5, 239.5)
ICL_SUFFIX = ".depth"  # of ICL-NUIM's text, distances along the rays in centimetres, :mod:`dsr.data.icl`
READ_SUFFIXES = (*DEPTH_SUFFIXES, ICL_SUFFIX)
_STORABLE = {
    ".png": ("uint16",),
    ".tiff": ("uint16", "int16", "int32", "uint32", "float32", "float64"),
    ".pfm": ("float32",),
    ".exr": ("float16", "float32", "uint32"),
}  # types of value by file format; NumPy's formats take any
# Tags of TIFF (Adobe, TIFF 6.0, section 14, and Technical Notes 2 and 3): the compression, 8 for Deflate, and what it
# is applied to, differences of whole numbers (2) or of the bytes of floats, all first ones of a row before others (3).
_COMPRESSION, _PREDICTOR = cv2.IMWRITE_TIFF_COMPRESSION, 317


def read_depth_file(path: Path, most: int | None = None) -> np.ndarray:
    """Return a map as it is stored, (H, W), floats or whole numbers of 16 bits or more in this machine's byte order.

    Of an OpenEXR file the channel named Z or depth is taken (of any layer), else Y, else the only one, else R; of an
    ``.npz`` file the array named depth, else the only one. ``most``: pixels it may have.
    """
    suffix = path.suffix.lower()
    if suffix not in READ_SUFFIXES:
        raise ValueError(f"{path}: expected a depth map as {', '.join(READ_SUFFIXES)}, got {suffix or 'no suffix'}")
    if not path.is_file():
        raise ValueError(f"{path}: expected a depth map, there is no such file")
    if suffix == ICL_SUFFIX:
        size = ICL_CAMERA.height, ICL_CAMERA.width
        values = read_numbers(path, size[0] * size[1]).reshape(size)
    else:
        values = expect_depth_values(path, read_array_file(path, most))
    if values.size == 0:
        raise ValueError(f"{path}: expected a depth map, got one of {values.shape[0]} x {values.shape[1]} pixels")
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


def read_array_file(path: Path, most: int | None = None) -> np.ndarray:
    """Return the array of an NPY, NPZ, PFM or OpenEXR file, or a picture, of any type and shape."""
    readers = {".exr": _read_exr, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        return read_array(path, most)
    values = readers[path.suffix.lower()](path)
    if most is not None and values.ndim > 1:
        expect_pixels(path, values.shape[0], values.shape[1], most)
    return values


def write_depth_file(path: Path, values: np.ndarray) -> None:
    """Write a map, (H, W), as it is, atomically, in the format that the suffix names, one of those above."""
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
            predictor = 3 if values.dtype.kind == "f" else 2
            how = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 6]}.get(suffix, [_COMPRESSION, 8, _PREDICTOR, predictor])
            written, content = cv2.imencode(suffix, values, how)
            if not written:
                raise ValueError(f"{path}: {values.shape[0]} x {values.shape[1]} pixels could not be encoded")
            temporary.write_bytes(content.tobytes())


def can_hold(suffix: str, dtype: np.dtype) -> bool:
    """Return whether the format of a suffix holds values of a type exactly."""
    return str(dtype) in _STORABLE.get(_format(suffix), (str(dtype),))


def storable(suffix: str, dtype: np.dtype) -> np.dtype:
    """Return the type that the format of a suffix stores values of a type as: itself, or the widest of its kind."""
    alike = [np.dtype(name) for name in _STORABLE.get(_format(suffix), ()) if np.dtype(name).kind == dtype.kind]
    return dtype if can_hold(suffix, dtype) or not alike else max(alike, key=lambda each: each.itemsize)


def _format(suffix: str) -> str:
    """Return the first of the suffixes that mean one format."""
    return ".tiff" if suffix == ".tif" else suffix


def _read_npz(path: Path) -> np.ndarray:
    """Return the array named depth, or the only one."""
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
    """Return which channel holds depth."""
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


def _write_exr(path: Path, values: np.ndarray) -> None:
    """Write one channel, Z."""
    import OpenEXR  # noqa: PLC0415 - as above

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(values)}) as file:
        file.write(str(path))
