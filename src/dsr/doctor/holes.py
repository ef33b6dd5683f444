"""Check of the fraction of valid depth, and of values that may mark missing depth."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dsr.doctor.finding import Array, Finding, Level, metres
from dsr.sample import Scene

_MANY, _MOST = 0.10, 0.40
"""Fractions of missing pixels."""
_MIN_FRACTION = 0.02
"""Fraction of the valid pixels that a suspicious value has at least."""
_GAP = 1.5
"""Ratio of an extreme value and the next one above which it counts as separate."""
_TINY = 0.011
"""Metres; smaller depths are treated as marks."""
_MARKS = (*(10.0, 20.0, 25.0, 50.0, 80.0, 100.0, 255.0, 1e3, 1e4), *(65535 * 10.0**-p for p in range(6)), 65535 / 5000)
"""Values in metres that usually mark missing or too distant depth: round ones, and the largest of 16 bits."""
_DIGITS = 6


def check_holes(scene: Scene) -> list[Finding]:
    """Check the fraction of missing pixels, and whether a depth value seems to mark missing pixels.

    Args:
        scene: scene with high-resolution depth.

    """
    depth = metres(scene)
    missing = float(np.isnan(depth).mean())
    text = f"{1 - missing:.1%} of the pixels are valid"
    level: Level
    if missing > _MOST:
        level, advice = (
            "warning",
            "results are unreliable where most depth is missing; inpaint the holes, or crop to the valid part",
        )
    elif missing > _MANY:
        level, advice = "note", "scores ignore holes"
    else:
        level, advice = "ok", ""
    return [Finding("holes", level, text, advice), *_marks(scene, depth)]


def _marks(scene: Scene, depth: Array) -> list[Finding]:
    """Return the extreme values that look like marks, of the depth or else of the distance along the ray."""
    for values in (depth, depth * scene.camera.ray_lengths().numpy()):
        rounded = _round(values)
        levels, counts = np.unique(rounded[np.isfinite(rounded)], return_counts=True)
        if levels.size == 1 and counts[0] > 1:
            message = f"all valid pixels have the same value, {levels[0]:g} m"
            return [Finding("holes", "warning", message, "check that this is the depth map")]
        findings = []
        for extreme, beside, count in ((levels[0], levels[1:2], counts[0]), (levels[-1], levels[-2:-1], counts[-1])):
            if beside.size and count / counts.sum() > _MIN_FRACTION:
                findings += _judge(rounded == extreme, float(extreme), float(beside[0]), count / counts.sum())
        if findings:
            return findings
    return []


def _round(values: Array) -> Array:
    """Round values to six significant digits."""
    with np.errstate(invalid="ignore"):
        power = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(values)))
        rounded: Array = np.round(values * power) / power
    return rounded


def _judge(where: np.ndarray, value: float, beside: float, fraction: float) -> list[Finding]:
    """Return a finding if an extreme value that many pixels have is, or may be, a mark."""
    smallest = value < beside
    apart = max(value, beside) / min(value, beside) > _GAP
    mark = value < _TINY if smallest else bool(np.isclose(value, _MARKS, rtol=1e-5, atol=0).any())
    if not apart and not mark:
        return []
    name = "smallest" if smallest else "largest"
    message = f"{fraction:.1%} of the valid pixels have exactly the {name} value, {value:g} m"
    if mark or _is_scattered(where):
        advice = 'if it marks holes, set "hole_value" in camera.json, in the unit of the file, or add a mask.png'
        return [Finding("holes", "warning", f"{message}, which looks like a mark of missing depth", advice)]
    message += f"; the next value is {beside:g} m"
    return [
        Finding("holes", "note", message, 'correct for a flat wall; if it marks holes, set "hole_value" in camera.json')
    ]


def _is_scattered(where: np.ndarray) -> bool:
    """Return whether pixels form many separate regions, which is typical of holes but not of a wall."""
    labels, count = ndimage.label(where)
    return count > 20 and np.bincount(labels.ravel())[1:].max() < 0.5 * where.sum()
