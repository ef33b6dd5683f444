"""Depth maps in files: PNG, TIFF, NPY, NPZ, PFM and OpenEXR, and ICL-NUIM's text, which is only read.

First the values as they are stored, then what they stand for: holes, unit and range type, from and to metres.
:mod:`dsr.io.units` identifies the unit.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.io.images import read_numbers, read_values
from dsr.notes import Assumption
from dsr.sample import FARTHEST, NEAREST
from dsr.utils.files import replacing

DEPTH_SUFFIXES = (".png", ".tiff", ".tif", ".npy", ".npz", ".pfm", ".exr")  # that are read and written
ICL_CAMERA = Camera(640, 480, 481.2, -480.0, 319.5, 239.5)
ICL_SUFFIX = ".depth"  # of ICL-NUIM's text, distances along the rays in centimetres, :mod:`dsr.data.icl`
READ_SUFFIXES = (*DEPTH_SUFFIXES, ICL_SUFFIX)
_STORABLE = {
    ".png": ("uint16",),
    **dict.fromkeys((".tiff", ".tif"), ("uint16", "int16", "int32", "uint32", "float32", "float64")),
    ".pfm": ("float32",),
    ".exr": ("float16", "float32", "uint32"),
}  # types of value by file format; NumPy's formats take any
# Tags of TIFF (Adobe, TIFF 6.0, section 14, and Technical Notes 2 and 3): the compression, 8 for Deflate, and what it
# is applied to, differences of whole numbers (2) or of the bytes of floats, all first ones of a row before others (3).
_COMPRESSION, _PREDICTOR = cv2.IMWRITE_TIFF_COMPRESSION, 317
# Whole numbers of 16 bits from the first on are a sensor's end, not a distance, if there are none from the second on up
# to it.
_FULL, _NEARLY_FULL = 65000, 50000
# usual marks of holes and of a renderer's far plane, in steps of 1, 10, 100, 1000 or 5000 to the unit of a map
_FAR_MARKS = (*(10**k - 1 for k in (4, 5, 6)), *(2**k - 1 for k in range(12, 17)), 65504)
_MANY, _SHARE = 4, 1e-4  # pixels, and share of the map, that at least have a mark, and have none


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
        values = read_values(path, most)
    if values.size == 0:
        raise ValueError(f"{path}: expected a depth map, got one of {values.shape[0]} x {values.shape[1]} pixels")
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


def write_depth_file(path: Path, values: np.ndarray) -> None:
    """Write a map, (H, W), as it is, atomically, in the format that the suffix names, one of those above."""
    suffix = path.suffix.lower()
    if not can_hold(suffix, values.dtype):
        raise ValueError(f"{path}: expected {' or '.join(_STORABLE[suffix])} values, got {values.dtype}")
    with replacing(path) as temporary:
        if suffix == ".npy":
            np.save(temporary, values)
        elif suffix == ".npz":
            np.savez_compressed(temporary, depth=values)
        elif suffix == ".pfm":
            size = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.0\n".encode()
            temporary.write_bytes(size + values[::-1].astype("<f4").tobytes())
        elif suffix == ".exr":
            import OpenEXR  # noqa: PLC0415 - only where somebody has such a file

            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"Z": np.ascontiguousarray(values)}) as file:
                file.write(str(temporary))
        else:
            predictor = 3 if values.dtype.kind == "f" else 2
            how = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 6]}.get(suffix, [_COMPRESSION, 8, _PREDICTOR, predictor])
            _, content = cv2.imencode(suffix, values, how)
            temporary.write_bytes(content.tobytes())


def can_hold(suffix: str, dtype: np.dtype) -> bool:
    """Return whether the format of a suffix holds values of a type exactly."""
    return str(dtype) in _STORABLE.get(suffix, (str(dtype),))


def storable(suffix: str, dtype: np.dtype) -> np.dtype:
    """Return the type that the format of a suffix stores values of a type as: itself, or the widest of its kind."""
    alike = [np.dtype(name) for name in _STORABLE.get(suffix, ()) if np.dtype(name).kind == dtype.kind]
    return dtype if can_hold(suffix, dtype) or not alike else max(alike, key=lambda each: each.itemsize)


@dataclass(frozen=True)
class Encoding:
    """How the values of a depth file are stored."""

    suffix: str  # of the file's format, such as .png
    dtype: str  # NumPy's name of the type of the values
    unit: float  # metres per value; pixels per value for disparities
    hole: float  # value that is written for a hole: 0, NaN, inf or another
    range_type: RangeType


# How results are stored to the bit: as the distance to the camera's plane in metres, NaN in holes.
IN_METRES = Encoding(".tiff", "float32", 1.0, math.nan, "orthogonal")


def turn_back_bits(name: str, values: np.ndarray, bits: int) -> np.ndarray:
    """Return values (h, w) of 16 bits that were turned to the left, turned back; a message begins with ``name``."""
    if values.dtype != np.uint16:
        raise ValueError(f"{name}: expected 16-bit values for --depth-unit sunrgbd, got {values.dtype}")
    return (values >> bits) | (values << (16 - bits))


def find_holes(
    values: np.ndarray, hole_value: float | None, *, above: float = 0.0
) -> tuple[np.ndarray, float, list[Assumption]]:
    """Return where a stored map is missing, the value that most of its holes have, and the assumptions.

    Whole numbers are holes at 0 and at the largest number of their type, those of 16 bits also from 65000 on if the
    next smaller one is below 50000, floats at 0, below 0, at NaN and at infinity, and both at ``hole_value`` and at
    :func:`far_marks` above the largest disparity, or infinity for none of them.
    """
    if values.dtype.kind in "iu":
        largest = np.iinfo(values.dtype).max
        kinds = {"0": values == 0, "below 0": values < 0, str(largest): values == largest}
        if values.dtype == np.uint16:
            full = (values >= _FULL) & (values < largest)
            others = values[values < _FULL]
            kinds[f"{_FULL} or more"] = full & bool(others.size and 0 < others.max() < _NEARLY_FULL)
    else:
        kinds = {
            "0": values == 0,
            "below 0": values < 0,
            "NaN": np.isnan(values),
            "infinity": np.isposinf(values),
        }
    if hole_value is not None:
        kinds = {f"{hole_value:g}": values == hole_value, **kinds}
    holes = np.logical_or.reduce(list(kinds.values()))
    for value in far_marks(values, ~holes):
        if value <= above:
            break
        name = f"{value:g}, far beyond all others (--hole-value 0 keeps them),"
        kinds[name] = values == value
        holes |= kinds[name]
    found, assumptions = dict[str, float](), list[Assumption]()
    for name, mask in kinds.items():
        if mask.any():
            found[name] = float(mask.mean())
            text = "zeros count as holes" if name == "0" else f"values that are {name} count as holes"
            assumptions.append(Assumption(text, f"{found[name]:.1%}"))
    if hole_value:
        return holes, hole_value, assumptions
    if values.dtype.kind in "iu":
        return holes, 0.0, assumptions
    usual = max((name for name in found if name != "below 0"), key=found.__getitem__, default="")
    return holes, {"0": 0.0, "infinity": math.inf}.get(usual, math.nan), assumptions


def far_marks(values: np.ndarray, known: np.ndarray) -> list[float]:
    """Return the values of a map, (h, w), that many known pixels share and that lie far beyond all smaller ones."""
    marks, rest = list[float](), values[known]
    while rest.size:
        highest = float(rest.max())
        smaller = rest[rest < highest]
        if min(smaller.size, rest.size - smaller.size) < max(_MANY, _SHARE * values.size):
            break
        usual = any(np.isclose(highest * steps, _FAR_MARKS, 1e-6, 0).any() for steps in (1, 10, 100, 1000, 5000))
        second = float(smaller.max())
        if highest < second * (1.5 if usual else 10):
            break
        walls = not usual and highest < second * 100  # behind something near, or a few boards
        if walls and (2 * smaller.size < rest.size or np.unique(smaller).size < 16):
            break
        marks.append(highest)
        rest = smaller
    return marks


def expect_known(name: object, values: np.ndarray, holes: np.ndarray) -> None:
    """Raise ValueError if all of a map's values, (h, w), are holes; the message begins with its name."""
    if holes.all():
        negative = float((values < 0).mean())
        what = f"{negative:.0%} are negative (along an axis that points backwards?), the others holes"
        raise ValueError(f"{name}: expected at least one known pixel, {what if negative else 'all are holes'}")


def decode(values: np.ndarray, holes: np.ndarray, encoding: Encoding, camera: Camera) -> Tensor:
    """Return orthogonal depth in metres, (1, h, w) float32, NaN in holes and where a distance is none.

    That is what lies beyond :data:`dsr.sample.NEAREST` and :data:`dsr.sample.FARTHEST`: the sky of renderings, which
    Blender writes as 1e10 m, and disparities of 0. ``values``: (h, w) as stored; ``camera``: of these pixels.
    """
    known = np.where(holes, np.nan, values.astype(np.float64)) * encoding.unit
    depth = from_range(torch.from_numpy(known)[None], camera, encoding.range_type)
    return depth.masked_fill((depth < NEAREST) | (depth > FARTHEST), torch.nan).float()


def encode(depth: Tensor, encoding: Encoding, camera: Camera) -> tuple[np.ndarray, int]:
    """Return the stored values of orthogonal depth, (1, H, W) in metres, and how many pixels are beyond their range."""
    values = to_range(depth.double(), camera, encoding.range_type)[0].cpu().numpy() / encoding.unit
    dtype, known = np.dtype(encoding.dtype), np.isfinite(values)
    if dtype.kind in "iu":
        values = np.round(values)
    least, largest = (1, np.iinfo(dtype).max - 1) if dtype.kind in "iu" else (0, float(np.finfo(dtype).max))
    held = known & (values >= least) & (values <= largest)
    return np.where(held, values, encoding.hole).astype(dtype), int((known & ~held).sum())
