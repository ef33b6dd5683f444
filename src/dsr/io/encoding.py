"""What the values of somebody's depth file mean, and back: unit, holes, range type, and what was assumed of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType, from_range, to_range

_NEAREST, _FARTHEST = 0.05, 80.0
"""Metres: a median outside speaks against a unit."""
_OTHER_UNITS = ((1e-4, "0.1 mm"), (1e-6, "micrometres"), (1e-2, "centimetres"))
"""Of whole numbers that cannot be millimetres, from the likeliest down."""
_SPARSE = 0.6
"""Share of holes beyond which whole numbers may be a laser scanner's."""
_FAR_FOR_A_SENSOR = 10.0
"""Metres: depth cameras that count in millimetres see no farther than that."""
_FLOAT_MILLIMETRES = 200.0
"""A median of floats beyond which they are millimetres."""
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_LARGEST_UNIT = 1e6


class Assumption(NamedTuple):
    """Something that was assumed or found.

    Attributes:
        text: the same for all pictures that it holds for.
        detail: figures of the one picture.

    """

    text: str
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.text} ({self.detail})" if self.detail else self.text


@dataclass(frozen=True)
class Encoding:
    """How a depth file counts.

    Args:
        suffix: of its format, such as ``.png``.
        dtype: NumPy's name of the type of its values.
        unit: metres per value; pixels per value for disparities.
        hole: the value that stands for a hole when it is written: 0, NaN, inf or another.
        range_type: what the values measure.

    """

    suffix: str
    dtype: str
    unit: float
    hole: float
    range_type: RangeType


def parse_unit(text: str) -> float:
    """Return the metres per value that a text names: m, cm, mm, a number, or a fraction such as 1/5000.

    Raises:
        ValueError: it is none of these.

    """
    if text in _UNITS:
        return _UNITS[text]
    above, _, below = text.partition("/")
    try:
        unit = float(above) / float(below or 1)
    except (ValueError, ZeroDivisionError):
        unit = math.nan
    if not 0 < unit <= _LARGEST_UNIT:
        raise ValueError(f"--depth-unit: expected m, cm, mm or metres per value such as 0.0002 or 1/5000, got {text!r}")
    return unit


def find_holes(values: np.ndarray, hole_value: float | None) -> tuple[np.ndarray, float, list[Assumption]]:
    """Return where a stored map is unknown, the value that marks a hole in it, and what was assumed.

    GlobalContext numbers have holes at 0 and at the largest number of their type, floats at 0, below, at NaN and
    infinities; both at ``hole_value`` too.

    Args:
        values: (h, w) as stored.
        hole_value: one more value of holes; None for none.

    """
    if values.dtype.kind in "iu":
        largest = np.iinfo(values.dtype).max
        kinds = {"0": values == 0, "below 0": values < 0, str(largest): values == largest}
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
    found = {name: float(mask.mean()) for name, mask in kinds.items() if mask.any()}
    facts = [
        Assumption(f"values that are {name} count as holes" if name != "0" else "zeros count as holes", f"{share:.1%}")
        for name, share in found.items()
    ]
    return holes, _mark(values, found, hole_value), facts


def _mark(values: np.ndarray, found: dict[str, float], hole_value: float | None) -> float:
    """Return the value that most holes have."""
    if hole_value is not None:
        return hole_value
    if values.dtype.kind in "iu":
        return 0.0
    found = {name: share for name, share in found.items() if name != "below 0"}
    return {"0": 0.0, "infinity": math.inf}.get(max(found, key=found.__getitem__, default=""), math.nan)


def guess_unit(name: str, values: np.ndarray, holes: np.ndarray) -> tuple[float, list[Assumption]]:
    """Return metres per value of a stored map, told from its type and its median, and what was assumed.

    Args:
        name: of the file, for the error.
        values: (h, w) as stored, orthogonal or perspective depth.
        holes: (h, w) bool, where it is unknown.

    Raises:
        ValueError: no usual unit makes the distances plausible.

    """
    middle = float(np.median(values[~holes]))
    if values.dtype.kind == "f":
        if middle > _FLOAT_MILLIMETRES:
            return 1e-3, [Assumption("floats this large are taken for millimetres", f"median {middle:.4g}")]
        facts = [Assumption("floats are taken for metres", f"median {middle:.3g} m")]
        if middle < _NEAREST:
            facts.append(Assumption("the depth is nearer than 5 cm: is it in metres? --depth-unit gives another unit"))
        return 1.0, facts
    if _NEAREST <= middle * 1e-3 <= _FARTHEST:
        facts = [Assumption("whole numbers are taken for millimetres", f"median {middle * 1e-3:.3g} m")]
        if middle * 1e-3 > _FAR_FOR_A_SENSOR:
            facts.append(
                Assumption(
                    "that is far for a sensor: TUM and ICL-NUIM store 1/5000 m, SUN RGB-D 1/8000 m (--depth-unit)"
                )
            )
        if holes.mean() > _SPARSE:
            facts.append(Assumption("that is sparse, as of a laser scanner: KITTI stores 1/256 m (--depth-unit 1/256)"))
        return 1e-3, facts
    for unit, label in _OTHER_UNITS:
        if _NEAREST <= middle * unit <= _FARTHEST:
            why = f"as millimetres the median would be {middle * 1e-3:.3g} m, now {middle * unit:.3g} m"
            return unit, [Assumption(f"whole numbers are taken for {label}", why)]
    raise ValueError(f"{name}: no usual unit makes its median of {middle:g} a distance; give one with --depth-unit")


def decode(values: np.ndarray, holes: np.ndarray, encoding: Encoding, camera: Camera) -> Tensor:
    """Return orthogonal depth in metres, (1, h, w) float32, NaN in holes.

    Args:
        values: (h, w) as stored.
        holes: (h, w) bool, where they are unknown.
        encoding: what they mean.
        camera: of these very pixels.

    """
    known = np.where(holes, np.nan, values.astype(np.float64)) * encoding.unit
    return from_range(torch.from_numpy(known)[None], camera, encoding.range_type).float()


def encode(depth: Tensor, encoding: Encoding, camera: Camera) -> tuple[np.ndarray, int]:
    """Return depth as a file stores it, and how many known pixels it cannot hold: those become holes.

    GlobalContext numbers are rounded to the nearest.

    Args:
        depth: (1, H, W) orthogonal metres, NaN in holes.
        encoding: how to count.
        camera: of these very pixels.

    """
    values = to_range(depth.double(), camera, encoding.range_type)[0].cpu().numpy() / encoding.unit
    dtype, known = np.dtype(encoding.dtype), np.isfinite(values)
    if dtype.kind in "iu":
        values = np.round(values)
    held = known & (values >= (1 if dtype.kind in "iu" else 0)) & (values <= _largest(dtype))
    return np.where(held, values, encoding.hole).astype(dtype), int((known & ~held).sum())


def _largest(dtype: np.dtype) -> float:
    """Return the largest value of a type that is not taken for a hole."""
    return np.iinfo(dtype).max - 1 if dtype.kind in "iu" else float(np.finfo(dtype).max)
