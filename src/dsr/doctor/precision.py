"""Whether depth is fine enough for a surface: rounded values make terraces, whose steps tilt the normals.

Rounded values are multiples of a unit, in depth, in inverse depth (as disparity) or in distance along the ray. That
alone may be so by construction, as of the rows of a level floor; where it was rounding, the slope of a smooth surface
jitters by one unit from pixel to pixel. Values that were rounded and then changed are no multiples any more, but still
stay exactly equal for some pixels of a slope and then step, which those of other surfaces do not.
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
"""Relative: a larger difference of neighbours is an edge, no step of a slope."""
_SAME = 3e-7
"""Relative: what a conversion in single precision may change."""
_LEVELS = 4
"""Gaps between values to judge by."""
_MULTIPLES = 0.95
"""Share of the gaps between values that have to be multiples of the unit."""
_JITTER, _OF_ALL = 0.01, 0.5
"""Shares of the smooth pixels, and of those whose slope changes, where it does so by one or two units."""
_TERRACED, _SPREAD = 0.2, 0.02
"""Shares of the slopes, and of all smooth pixels, that have to be terraced where no unit shows."""
_TILT, _STEEP = 3.0, 20.0
"""Degrees that one step may tilt a normal: beyond the first the renderings show it, beyond the second little else."""
_LEAST = 100
"""Pixels to judge by."""
_REPEATED = (8, 6, 5, 4, 3, 2)


@dataclass(frozen=True)
class Rounding:
    """What the values of a depth map were rounded to.

    Args:
        quantity: that was rounded.
        step: in metres, of inverse depth in 1 / m.
        relative: the step as a share of the median value.
        tilt: by which one step tilts a surface that faces the camera, in degrees, at the median depth.

    """

    quantity: Quantity
    step: float
    relative: float
    tilt: float


def check_precision(scene: Scene) -> list[Finding]:
    """Return whether the depth was rounded so much that it shows.

    Args:
        scene: with high-resolution depth.

    """
    depth = metres(scene)
    factor = repeated(depth)
    if factor > 1:
        message = f"every value is repeated {factor} times across and down: a smaller map, enlarged"
        advice = f"give the smaller map itself, as depth_lr{factor}, or find the high-resolution one"
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
    advice = "find the unrounded map (float, or 16 bits of a smaller unit); normals and renderings of this one mislead"
    return [Finding("precision", level, f"{text}, which renderings show as terraces", advice)]


def find_rounding(scene: Scene) -> Rounding | None:
    """Return what the depth of a scene was rounded to, None where it does not look rounded."""
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


def repeated(depth: Array) -> int:
    """Return how many times each value of a map is repeated across and down, 1 for a map that is not enlarged."""
    for factor in _REPEATED:
        if all(_in_phase(lines, factor) for lines in (depth, depth.T)):
            return factor
    return 1


def _in_phase(lines: Array, factor: int) -> bool:
    """Return whether values change along the lines at every ``factor``-th pixel alone."""
    change = np.diff(lines)
    counts = (np.isfinite(change) & (change != 0)).sum(axis=0)
    phases = np.bincount(np.arange(counts.size) % factor, counts, minlength=factor)
    everywhere = np.count_nonzero(counts) > 0.5 * counts.size / factor
    return bool(everywhere and phases.sum() >= _LEAST and phases.max() > 0.99 * phases.sum())


def _unit(values: Array) -> float:
    """Return what all values are multiples of, up to an offset; 0 where there is nothing."""
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
    """Return whether slopes change from pixel to pixel by one or two units, and seldom otherwise."""
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
    """Return the size of the smaller steps of slopes that rise in steps; 0 where they do not."""
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
    """Return what the values look like: half precision, or steps of some size."""
    known = depth[np.isfinite(depth)]
    if known.max() < 6e4 and np.array_equal(known.astype(np.float16).astype(np.float64), known):
        return "values of half precision (float16)"
    if rounding.quantity != "inverse depth":
        return f"{rounding.quantity} comes in steps of {length(rounding.step)}"
    if scene.camera.baseline is None:
        return f"inverse depth comes in steps of {rounding.step:.2g} / m"
    return f"disparity comes in steps of {rounding.step * baseline_times_focal(scene.camera):.2g} px"
