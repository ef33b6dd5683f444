"""Check of the rounding of depth, which turns smooth surfaces into terraces and tilts the normals at their steps.

Rounded values are multiples of a unit, in depth, in inverse depth (as disparity) or in distance along the ray. Values
may also be multiples of a unit by construction, such as those of the rows of a level floor. If they were rounded, the
slope of a smooth surface changes by one unit from pixel to pixel. Values that were processed after rounding are no
longer multiples, but along a slope they are still exactly equal for some pixels and then step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dsr.doctor.finding import Array, Finding, Level, length, metres
from dsr.geometry.camera import baseline_times_focal
from dsr.sample import Scene

Quantity = Literal["depth", "inverse depth", "distance along the ray"]

_JUMP = 0.03
"""Relative difference of neighbouring pixels beyond which they are an edge."""
_SAME = 3e-7
"""Largest relative error of a conversion in single precision."""
_LEVELS = 4
"""Minimum number of gaps between values."""
_MULTIPLES = 0.95
"""Minimum fraction of the gaps between values that are multiples of the unit."""
_JITTER, _OF_ALL = 0.01, 0.5
"""Minimum fractions, of smooth pixels and of those whose slope changes, with a change of one or two units."""
_TERRACED, _SPREAD = 0.2, 0.02
"""Minimum fractions of terraced pixels, of the slopes and of all smooth pixels, if no unit is found."""
_TILT, _STEEP = 3.0, 20.0
"""Tilt of a normal by one step, in degrees, that becomes visible in renderings, and that dominates them."""
_LEAST = 100
"""Minimum number of pixels."""
_REPEATED = (8, 6, 5, 4, 3, 2)


@dataclass(frozen=True)
class Rounding:
    """The rounding of a depth map.

    Args:
        quantity: quantity that was rounded.
        step: rounding step in metres, of inverse depth in 1 / m.
        relative: the step as a fraction of the median value.
        tilt: tilt in degrees that one step causes on a surface that faces the camera at the median depth.

    """

    quantity: Quantity
    step: float
    relative: float
    tilt: float


def check_precision(scene: Scene) -> list[Finding]:
    """Check whether the rounding of the depth is visible in renderings.

    Args:
        scene: scene with high-resolution depth.

    """
    depth = metres(scene)
    factor = find_repetition(depth)
    if factor > 1:
        message = f"every value is repeated {factor} times across and down: an enlarged smaller map"
        advice = f"provide the smaller map as depth_lr{factor}, or the original high-resolution map"
        return [Finding("precision", "problem", message, advice)]
    rounding = find_rounding(scene)
    count = np.unique(depth[np.isfinite(depth)]).size
    if rounding is None:
        return [Finding("precision", "ok", f"{count} distinct values")]
    source = f"{_source(scene, depth, rounding)}, {count} distinct values{' (8 bits hold 256)' if count <= 256 else ''}"
    text = f"{source}; one step tilts a surface by {rounding.tilt:.2g} degrees"
    if rounding.tilt <= _TILT:
        return [Finding("precision", "ok", text)]
    level: Level = "problem" if rounding.tilt > _STEEP else "warning"
    advice = "use the unrounded map (float, or 16 bits of a smaller unit); normals and renderings of this map are wrong"
    return [Finding("precision", level, f"{text}, visible as terraces in renderings", advice)]


def find_rounding(scene: Scene) -> Rounding | None:
    """Return the rounding of a scene's depth, or None if it does not look rounded."""
    depth, camera = metres(scene), scene.camera
    quantities: dict[Quantity, Array] = {
        "depth": depth,
        "inverse depth": 1 / depth,
        "distance along the ray": depth * camera.ray_lengths().numpy(),
    }
    steps = ((quantity, _unit(values)) for quantity, values in quantities.items())
    found = ((quantity, step) for quantity, step in steps if step and _jitters(quantities[quantity], step))
    quantity, step = next(found, ("depth", _terrace(depth)))
    if not step:
        return None
    relative = step / float(np.nanmedian(quantities[quantity]))
    tilt = math.degrees(math.atan(relative * math.sqrt(camera.fx * camera.fy)))
    return Rounding(quantity, step, relative, tilt)


def find_repetition(depth: Array) -> int:
    """Return the factor by which a map was enlarged by repeating pixels, 1 for a map that was not."""
    for factor in _REPEATED:
        if all(_in_phase(lines, factor) for lines in (depth, depth.T)):
            return factor
    return 1


def _in_phase(lines: Array, factor: int) -> bool:
    """Return whether values along the lines change only at every ``factor``-th pixel."""
    change = np.diff(lines)
    counts = (np.isfinite(change) & (change != 0)).sum(axis=0)
    phases = np.bincount(np.arange(counts.size) % factor, counts, minlength=factor)
    everywhere = np.count_nonzero(counts) > 0.5 * counts.size / factor
    return bool(everywhere and phases.sum() >= _LEAST and phases.max() > 0.99 * phases.sum())


def _unit(values: Array) -> float:
    """Return the unit that all values are multiples of, up to an offset; 0 if there is none."""
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > _SAME * levels[1:]]
    if gaps.size < _LEVELS:
        return 0.0
    unit = float(np.percentile(gaps, 5))
    multiple = gaps / unit
    even = np.abs(multiple - np.round(multiple)) < 0.05
    return unit if even.mean() > _MULTIPLES else 0.0


def _jitters(values: Array, unit: float) -> bool:
    """Return whether most changes of slope between pixels are of one or two units."""
    smooth = jitter = bent = 0
    for lines in (values, values.T):
        before, after = np.diff(lines[:, :-1]), np.diff(lines[:, 1:])
        limit = np.maximum(_JUMP * lines[:, 1:-1], 1.5 * unit)
        with np.errstate(invalid="ignore"):
            near = np.maximum(np.abs(before), np.abs(after)) < limit
        change = np.abs(after - before)[near] / unit
        smooth += change.size
        bent += int(np.count_nonzero(change > 0.5))
        jitter += int(np.count_nonzero((change > 0.5) & (change < 2.5)))
    return jitter >= _LEAST and jitter > _JITTER * smooth and jitter > _OF_ALL * bent


def _terrace(depth: Array) -> float:
    """Return the size of the smaller steps of terraced slopes; 0 if slopes are not terraced."""
    steps, slopes, smooth = [], 0, 0
    for lines in (depth, depth.T):
        before, after = np.diff(lines[:, :-1]), np.diff(lines[:, 1:])
        with np.errstate(invalid="ignore"):
            near = np.maximum(np.abs(before), np.abs(after)) < _JUMP * lines[:, 1:-1]
        steps.append(np.abs(before + after)[near & ((before == 0) != (after == 0))])
        slopes += int(np.count_nonzero(near & ((before != 0) | (after != 0))))
        smooth += int(np.count_nonzero(near))
    step = np.concatenate(steps)
    if step.size < max(_LEAST, _TERRACED * slopes, _SPREAD * smooth):
        return 0.0
    return float(np.percentile(step, 25))


def _source(scene: Scene, depth: Array, rounding: Rounding) -> str:
    """Describe the rounding: half precision, or the size of the steps."""
    valid = depth[np.isfinite(depth)]
    if valid.max() < 6e4 and np.array_equal(valid.astype(np.float16).astype(np.float64), valid):
        return "values have half precision (float16)"
    if rounding.quantity != "inverse depth":
        return f"{rounding.quantity} comes in steps of {length(rounding.step)}"
    if scene.camera.baseline is None:
        return f"inverse depth comes in steps of {rounding.step:.2g} / m"
    return f"disparity comes in steps of {rounding.step * baseline_times_focal(scene.camera):.2g} px"
