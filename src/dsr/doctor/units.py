"""Check that depth is in metres: implausible distances indicate another unit, and often which one."""

from __future__ import annotations

import numpy as np

from dsr.doctor.finding import Array, Finding, Level, length, metres
from dsr.sample import Scene
from dsr.utils.ratios import round_ratio

_NEAREST, _FARTHEST = 0.05, 200.0
"""Metres; depth entirely below or above is in another unit."""
_NEAR, _FAR = 0.1, 30.0
"""Metres; a median below suggests macro photography, one above outdoors, or another unit."""
_TYPICAL = (0.4, 8.0)
"""Metres; range of the median depth of a room or a table."""
_FACTORS: tuple[tuple[float, str], ...] = (
    (1e-3, "millimetres read as metres"),
    (1e3, "metres read as millimetres"),
    (1e-2, "centimetres read as metres"),
    (1e2, "metres read as centimetres"),
    (1 / 5000, "values of 1/5000 m, as ICL-NUIM and TUM store them, read as metres"),
    (1 / 5, "values of 1/5000 m read as millimetres"),
    (1 / 8, "SUN RGB-D's values read without turning them by three bits"),
    (1 / 256, "values of 1/256 m, as KITTI stores them, read as metres"),
)
"""Most likely first."""
_BASELINES = (1e-3, 5.0)
"""Plausible range of baselines in metres."""
_AGREEMENT = 1.25
"""Largest ratio of measured and high-resolution depth."""


def check_units(scene: Scene) -> list[Finding]:
    """Check whether depth, baseline and measured maps are plausible in metres.

    Args:
        scene: scene with high-resolution depth.

    """
    depth = metres(scene)
    low, middle, high = np.nanpercentile(depth, (1, 50, 99))
    text = f"depth {length(low)} to {length(high)} (1st to 99th percentile), median {length(middle)}"
    level: Level
    level, remark = "ok", ""
    if high < _NEAREST or low > _FARTHEST:
        level, remark = "problem", f": {'nearer' if high < _NEAREST else 'farther'} than any room or table"
    elif middle < _NEAR or middle > _FARTHEST:
        level, remark = "warning", f": {'nearer' if middle < _NEAR else 'farther'} than most rooms and tables"
    elif middle > _FAR:
        level, remark = "note", ": too far for a room, plausible outdoors"
    findings = [Finding("units", level, text + remark, "" if level == "ok" else _advise(scene, middle))]
    return findings + _baseline(scene) + _measured(scene, depth)


def _advise(scene: Scene, middle: float) -> str:
    """Return the factors that make a median depth plausible."""
    fitting = [(factor, why) for factor, why in _FACTORS if _TYPICAL[0] <= middle * factor <= _TYPICAL[1]]
    if not fitting:
        return "check the unit"
    texts = [f"x {factor:g} would make the median {length(middle * factor)} ({why})" for factor, why in fitting[:2]]
    where = 'set "depth_unit" in camera.json'
    baseline = scene.camera.baseline
    if baseline is not None and not _plausible_baseline(baseline) and _plausible_baseline(baseline * fitting[0][0]):
        where = f'set "baseline_unit" in camera.json: the baseline of {length(baseline)} is off by the same factor'
    return f"{', or '.join(texts)}; {where}"


def _plausible_baseline(baseline: float) -> bool:
    return _BASELINES[0] <= baseline <= _BASELINES[1]


def _baseline(scene: Scene) -> list[Finding]:
    """Check whether the baseline is plausible."""
    baseline = scene.camera.baseline
    if baseline is None or _plausible_baseline(baseline):
        return []
    low, high = (length(limit) for limit in _BASELINES)
    message = f"baseline {length(baseline)}; {low} to {high} are usual"
    advice = 'check "baseline_unit" in camera.json; keep it if depth computed from it is plausible'
    return [Finding("units", "note", message, advice)]


def _measured(scene: Scene, depth: Array) -> list[Finding]:
    """Check the measured low-resolution maps against the high-resolution depth."""
    findings = []
    for factor, measured in sorted(scene.measured.items()):
        depth_lr = measured[0].double().numpy()
        rows, columns = (
            np.minimum(((np.arange(n) + 0.5) * factor).astype(int), size - 1)
            for n, size in zip(depth_lr.shape, depth.shape, strict=True)
        )
        subsampled = depth[rows[:, None], columns]
        both = np.isfinite(subsampled) & np.isfinite(depth_lr)
        if not both.any():
            continue
        ratio = float(np.median(depth_lr[both] / subsampled[both]))
        if not 1 / _AGREEMENT <= ratio <= _AGREEMENT:
            message = (
                f"the measured map at x{round_ratio(factor)} is {ratio:.3g} times as far as the high-resolution depth"
            )
            advice = "use one unit for both; the disparity of a low-resolution map is in its own pixels"
            findings.append(Finding("units", "problem", message, advice))
    return findings
