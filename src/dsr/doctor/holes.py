"""How much of the depth is known, and whether one value stands for what is not."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dsr.doctor.finding import Array, Finding, Level, metres
from dsr.sample import Scene

_MANY, _MOST = 0.10, 0.40
"""Shares of holes."""
_SHARE = 0.02
"""Of the known pixels that one value has to cover."""
_GAP = 1.5
"""Ratio of an extreme value and the next one beyond which it lies apart."""
_TINY = 0.011
"""Metres."""
_MARKS = (*(10.0, 20.0, 25.0, 50.0, 80.0, 100.0, 255.0, 1e3, 1e4), *(65535 * 10.0**-p for p in range(6)), 65535 / 5000)
"""Values in metres that stand for holes or for whatever is too far: round ones, and the largest of 16 bits."""
_DIGITS = 6


def check_holes(scene: Scene) -> list[Finding]:
    """Return how many pixels are holes, and which value of depth looks as if it meant one.

    Args:
        scene: with high-resolution depth.

    """
    depth = metres(scene)
    share = float(np.isnan(depth).mean())
    text = f"{1 - share:.1%} of the pixels known"
    level: Level
    if share > _MOST:
        level, advice = "warning", "expect little where most is unknown; fill the holes, or crop to the known part"
    elif share > _MANY:
        level, advice = "note", "scores leave holes out"
    else:
        level, advice = "ok", ""
    return [Finding("holes", level, text, advice), *_marks(scene, depth)]


def _marks(scene: Scene, depth: Array) -> list[Finding]:
    """Return the extreme values that look like marks, as depth or, failing that, as distance along the ray."""
    for values in (depth, depth * scene.camera.ray_lengths().numpy()):
        rounded = _rounded(values)
        known, counts = np.unique(rounded[np.isfinite(rounded)], return_counts=True)
        if known.size == 1 and counts[0] > 1:
            message = f"every known pixel has the same value, {known[0]:g} m"
            return [Finding("holes", "warning", message, "check that this is the depth map")]
        findings = []
        for extreme, beside, count in ((known[0], known[1:2], counts[0]), (known[-1], known[-2:-1], counts[-1])):
            if beside.size and count / counts.sum() > _SHARE:
                findings += _judged(rounded == extreme, float(extreme), float(beside[0]), count / counts.sum())
        if findings:
            return findings
    return []


def _rounded(values: Array) -> Array:
    """Return values to six digits."""
    with np.errstate(invalid="ignore"):
        power = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(values)))
        rounded: Array = np.round(values * power) / power
    return rounded


def _judged(where: np.ndarray, value: float, beside: float, share: float) -> list[Finding]:
    """Return what an extreme value that many pixels have is: a mark, perhaps a mark, or (nothing) a flat wall."""
    smallest = value < beside
    apart = max(value, beside) / min(value, beside) > _GAP
    mark = value < _TINY if smallest else bool(np.isclose(value, _MARKS, rtol=1e-5, atol=0).any())
    if not apart and not mark:
        return []
    message = (
        f"{share:.1%} of the known pixels have exactly the {'smallest' if smallest else 'largest'} value, {value:g} m"
    )
    if mark or _scattered(where):
        advice = 'if it stands for holes, give it as "hole_value" in camera.json (as the file has it), or mask.png'
        return [Finding("holes", "warning", f"{message}, which looks like a mark", advice)]
    message += f", apart from the next, {beside:g} m"
    return [Finding("holes", "note", message, 'right for a flat wall; if it marks holes, give it as "hole_value"')]


def _scattered(where: np.ndarray) -> bool:
    """Return whether pixels lie in many places, as holes do and a wall does not."""
    labels, count = ndimage.label(where)
    return count > 20 and np.bincount(labels.ravel())[1:].max() < 0.5 * where.sum()
