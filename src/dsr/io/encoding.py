"""Decoding and encoding of the values of depth files: unit, holes, range type; :mod:`dsr.io.units` identifies them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.notes import Assumption
from dsr.sample import FARTHEST, NEAREST

# Whole numbers of 16 bits from the first on are a sensor's end, not a distance, if there are none from the second on up
# to it.
_FULL, _NEARLY_FULL = 65000, 50000
# usual marks of holes and of a renderer's far plane, in steps of 1, 10, 100, 1000 or 5000 to the unit of a map
_FAR_MARKS = (*(10**k - 1 for k in (4, 5, 6)), *(2**k - 1 for k in range(12, 17)), 65504)
_MANY, _SHARE = 4, 1e-4  # pixels, and share of the map, that at least have a mark, and have none


@dataclass(frozen=True)
class Encoding:
    """How the values of a depth file are stored.

    Args:
        suffix: suffix of the file's format, such as ``.png``.
        dtype: NumPy's name of the type of the values.
        unit: metres per value; pixels per value for disparities.
        hole: value that is written for a hole: 0, NaN, inf or another.
        range_type: quantity that the values measure.

    """

    suffix: str
    dtype: str
    unit: float
    hole: float
    range_type: RangeType


IN_METRES = Encoding(".tiff", "float32", 1.0, math.nan, "orthogonal")
"""How results are stored to the bit: as the distance to the camera's plane in metres, NaN in holes."""


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
    found = {name: float(mask.mean()) for name, mask in kinds.items() if mask.any()}
    assumptions = [
        Assumption(
            f"values that are {name} count as holes" if name != "0" else "zeros count as holes", f"{fraction:.1%}"
        )
        for name, fraction in found.items()
    ]
    return holes, _mark(values, found, hole_value), assumptions


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


def _mark(values: np.ndarray, found: dict[str, float], hole_value: float | None) -> float:
    """Return the value that most holes have."""
    if hole_value:
        return hole_value
    if values.dtype.kind in "iu":
        return 0.0
    found = {name: fraction for name, fraction in found.items() if name != "below 0"}
    return {"0": 0.0, "infinity": math.inf}.get(max(found, key=found.__getitem__, default=""), math.nan)


def decode(values: np.ndarray, holes: np.ndarray, encoding: Encoding, camera: Camera) -> Tensor:
    """Return orthogonal depth in metres, (1, h, w) float32, NaN in holes and where a distance is none.

    That is what lies beyond :data:`dsr.sample.NEAREST` and :data:`dsr.sample.FARTHEST`: the sky of renderings, which
    Blender writes as 1e10 m, and disparities of 0. ``values``: (h, w) as stored; ``camera``: of these pixels.
    """
    known = np.where(holes, np.nan, values.astype(np.float64)) * encoding.unit
    depth = from_range(torch.from_numpy(known)[None], camera, encoding.range_type)
    return depth.masked_fill((depth < NEAREST) | (depth > FARTHEST), torch.nan).float()


def encode(depth: Tensor, encoding: Encoding, camera: Camera) -> tuple[np.ndarray, int]:
    """Return the values that a file stores, and the number of valid pixels outside their range, which become holes.

    Whole numbers are rounded to the nearest. ``depth``: (1, H, W) orthogonal in metres, NaN in holes.
    """
    values = to_range(depth.double(), camera, encoding.range_type)[0].cpu().numpy() / encoding.unit
    dtype, known = np.dtype(encoding.dtype), np.isfinite(values)
    if dtype.kind in "iu":
        values = np.round(values)
    least, largest = (1, np.iinfo(dtype).max - 1) if dtype.kind in "iu" else (0, float(np.finfo(dtype).max))
    held = known & (values >= least) & (values <= largest)
    return np.where(held, values, encoding.hole).astype(dtype), int((known & ~held).sum())
