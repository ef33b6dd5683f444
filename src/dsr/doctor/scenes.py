"""Checks of scenes with ``dsr doctor DIR``: units, camera, registration, holes, rounding, range type and size.

Rounded values are multiples of a unit, in depth, in inverse depth (as disparity) or in distance along the ray. Values
may also be multiples of a unit by construction, such as those of the rows of a level floor. If they were rounded, the
slope of a smooth surface changes by one unit from pixel to pixel. Values that were processed after rounding are no
longer multiples, but along a slope they are still exactly equal for some pixels and then step.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch.nn import functional

from dsr.data.detection import find_scenes
from dsr.doctor import Finding, Level, show_findings
from dsr.geometry.agreement import judge
from dsr.geometry.camera import baseline_times_focal
from dsr.geometry.planes import range_votes
from dsr.geometry.plausible import implausible_distance, judge_camera, offset_of, plausible_baseline, view_of
from dsr.geometry.registration import SHIFT, WORKING_SIZE, find_displacement
from dsr.notes import LIMITS
from dsr.sample import Scene
from dsr.utils.console import USAGE_ERROR, ConsoleProgress, one_line, open_console, print_error
from dsr.utils.progress import show_length
from dsr.utils.ratios import round_ratio

_MANY_SCENES = 8  # beyond which checks without a finding are not listed
# units: metres
_NEAR, _FAR = 0.1, 30.0  # a median below suggests macro photography, one above outdoors, or another unit
_TYPICAL = (0.4, 8.0)  # range of the median depth of a room or a table
_FACTORS = {  # most likely first
    1e-3: "millimetres read as metres",
    1e3: "metres read as millimetres",
    1e-2: "centimetres read as metres",
    1e2: "metres read as centimetres",
    1 / 5000: "values of 1/5000 m, as ICL-NUIM and TUM store them, read as metres",
    1 / 5: "values of 1/5000 m read as millimetres",
    1 / 8: "SUN RGB-D's values read without turning them by three bits",
    1 / 256: "values of 1/256 m, as KITTI stores them, read as metres",
}
_AGREEMENT = 1.25  # largest ratio of measured and high-resolution depth
# holes
_MANY, _MOST = 0.10, 0.40  # fractions of missing pixels
_MIN_FRACTION = 0.02  # fraction of the valid pixels that a suspicious value has at least
_GAP = 1.5  # ratio of an extreme value and the next one above which it counts as separate
_TINY = 0.011  # metres; smaller depths are treated as marks
# metres that usually mark missing or too distant depth: round ones, and the largest of 16 bits
_MARKS = (*(10.0, 20.0, 25.0, 50.0, 80.0, 100.0, 255.0, 1e3, 1e4), *(65535 * 10.0**-p for p in range(6)), 65535 / 5000)
_DIGITS = 6
# rounding
_JUMP = 0.03  # relative difference of neighbouring pixels beyond which they are an edge
_SAME = 3e-7  # largest relative error of a conversion in single precision
_LEVELS, _MULTIPLES = 4, 0.95  # minimum number of gaps between values, and fraction of them that are multiples
_JITTER, _OF_ALL = 0.01, 0.5  # minimum fractions, of smooth and of bent pixels, whose slope changes by a unit or two
_TERRACED, _SPREAD = 0.2, 0.02  # minimum fractions of terraced pixels, of the slopes and of all smooth pixels
_TILT, _STEEP = 3.0, 20.0  # degrees by which one step tilts a normal, visible in renderings, and dominating them
_LEAST = 100  # minimum number of pixels
_REPEATED = (8, 6, 5, 4, 3, 2)
_DIVISOR = 8  # of the size, for the usual scales

Quantity = Literal["depth", "inverse depth", "distance along the ray"]
Array = NDArray[np.float64]


class Rounding(NamedTuple):
    """The rounding of a depth map."""

    quantity: Quantity  # that was rounded
    step: float  # metres, of inverse depth 1 / m
    relative: float  # the step as a fraction of the median value
    tilt: float  # degrees by which one step tilts a surface that faces the camera at the median depth


def examine_directory(folder: Path, most: int | None = None) -> int:
    """Print findings on at most so many scenes of a directory, taken at equal distances, and return the exit code.

    It is 1 after a warning or a problem, and 2, with one line on stderr, if there is no scene.
    """
    try:
        scenes = list(find_scenes(folder)) if folder.is_dir() else []
        if not scenes:
            came = "no scene in it" if folder.is_dir() else "no such directory"
            raise ValueError(f"{folder}: expected a scene or a directory of scenes, got {came}")
    except (ValueError, OSError) as error:
        print_error(str(error))
        return USAGE_ERROR
    console = open_console()
    if most is not None and len(scenes) > most:
        console.print(f"{most} of {len(scenes)} scenes, at equal distances", highlight=False)
        scenes = [scenes[index * len(scenes) // most] for index in range(most)]
    verdicts: Counter[Level] = Counter()
    for name, load in ConsoleProgress(console).track(scenes, "examine", label=lambda scene: scene[0], lines=False):
        title = name
        try:
            scene = load()
        except (ValueError, OSError) as error:
            message = f"cannot be read: {one_line(error)}"
            findings = [Finding("files", "problem", message, "correct the file or its description")]
        else:
            title += "" if scene.depth is not None else f" (the map measured at x{round_ratio(min(scene.measured))})"
            findings = examine(scene)
        verdicts[show_findings(console, title, findings, brief=len(scenes) > _MANY_SCENES)] += 1
    fine = verdicts["ok"] + verdicts["note"]
    parts = [f"{fine} fine"] if fine else []
    parts += [f"{verdicts[level]} with {level}s" for level in ("warning", "problem") if verdicts[level]]
    text = f"{len(scenes)} scene{'s' if len(scenes) > 1 else ''}: {', '.join(parts)}"
    console.print(text, style="bold", highlight=False)
    return 1 if fine < len(scenes) else 0


def examine(scene: Scene) -> list[Finding]:
    """Run all checks on a scene and return their findings, in the order of :data:`CHECKS`."""
    scene = with_depth(scene)
    return [finding for check in CHECKS for finding in check(scene)]


def with_depth(scene: Scene) -> Scene:
    """Return the scene at the resolution of its high-resolution depth, else of its largest measured map."""
    if scene.depth is not None:
        return scene
    depth = scene.measured[min(scene.measured)]
    height, width = depth.shape[-2:]
    camera, ratio = scene.camera.reduce(width, height), scene.camera.ratio_to(width, height)
    rgb = scene.rgb[:, : camera.height * ratio, : camera.width * ratio] if isinstance(ratio, int) else scene.rgb
    rgb = functional.interpolate(rgb[None], (height, width), mode="area")[0]
    return replace(scene, rgb=rgb.clamp(0, 1), camera=camera, depth=depth, measured={})


def metres(scene: Scene) -> Array:
    """Return the depth of a scene :func:`with_depth`, (H, W) float64 in metres, NaN in holes."""
    assert scene.depth is not None  # noqa: S101 - as said
    depth: Array = scene.depth[0].double().numpy()
    return depth


def check_units(scene: Scene) -> list[Finding]:
    """Check whether depth, baseline and measured maps are plausible in metres."""
    depth = metres(scene)
    low, middle, high = np.nanpercentile(depth, (1, 50, 99))
    text = f"depth {show_length(low)} to {show_length(high)} (1st to 99th percentile), median {show_length(middle)}"
    level: Level
    level, remark = "ok", ""
    beyond = implausible_distance(low, high)
    if beyond is not None:
        level, remark = "problem", f": {'nearer' if beyond == 'depth-near' else 'farther'} than any room or table"
    elif middle < _NEAR or middle > LIMITS["depth-far"]:
        level, remark = "warning", f": {'nearer' if middle < _NEAR else 'farther'} than most rooms and tables"
    elif middle > _FAR:
        level, remark = "note", ": too far for a room, plausible outdoors"
    findings = [Finding("units", level, text + remark, "" if level == "ok" else _advise(scene, middle))]
    baseline = scene.camera.baseline
    if baseline is not None and not plausible_baseline(baseline):
        usual = " to ".join(show_length(LIMITS[code]) for code in ("baseline-short", "baseline-long"))
        advice = 'check "baseline_unit" in camera.json; keep it if depth computed from it is plausible'
        message = f"baseline {show_length(baseline)}; {usual} are usual"
        findings.append(Finding("units", "note", message, advice))
    return findings + _measured(scene, depth)


def _advise(scene: Scene, middle: float) -> str:
    """Return the factors that make a median depth plausible."""
    fitting = [(factor, why) for factor, why in _FACTORS.items() if _TYPICAL[0] <= middle * factor <= _TYPICAL[1]]
    if not fitting:
        return "check the unit"
    texts = [
        f"x {factor:g} would make the median {show_length(middle * factor)} ({why})" for factor, why in fitting[:2]
    ]
    where = 'set "depth_unit" in camera.json'
    baseline = scene.camera.baseline
    if baseline is not None and not plausible_baseline(baseline) and plausible_baseline(baseline * fitting[0][0]):
        where = f'set "baseline_unit" in camera.json: the baseline of {show_length(baseline)} is off by the same factor'
    return f"{', or '.join(texts)}; {where}"


def _measured(scene: Scene, depth: Array) -> list[Finding]:
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
            which = f"the measured map at x{round_ratio(factor)}"
            message = f"{which} is {ratio:.3g} times as far as the high-resolution depth"
            advice = "use one unit for both; the disparity of a low-resolution map is in its own pixels"
            findings.append(Finding("units", "problem", message, advice))
    return findings


def check_intrinsics(scene: Scene) -> list[Finding]:
    """Check the camera against the image."""
    text = f"{view_of(scene.camera):.0f} degrees across, principal point {offset_of(scene.camera):.1%} off the centre"
    found = [Finding("intrinsics", each.level, each.message, each.advice) for each in judge_camera(scene.camera)]
    return found or [Finding("intrinsics", "ok", text)]


def check_registration(scene: Scene) -> list[Finding]:
    """Check whether photo and depth map show the same scene, and whether their edges coincide."""
    verdict = judge(metres(scene), scene.rgb)
    if verdict is None:
        return [Finding("registration", "note", "no edges in the depth map or in the photo for this check")]
    text = f"{verdict.statement} ({verdict.figures})"
    if verdict.kind == "turned":
        return [Finding("registration", "problem", text, "flip, rotate or crop the photo or the depth")]
    found = find_displacement(torch.from_numpy(metres(scene))[None], scene.rgb)
    if found is not None and found.certain:
        right, down = round(found.right), round(found.down)
        scale = f", at {found.scale:.3f} times the size" if round(found.scale, 3) != 1 else ""
        text = (
            f"the photo's edges are {abs(right)} px {'left' if right < 0 else 'right'}, "
            f"{abs(down)} px {'above' if down < 0 else 'below'} of the depth edges{scale}"
        )
        smallest = SHIFT * math.ceil(max(scene.rgb.shape[1:]) / WORKING_SIZE)  # of steps in which they are compared
        if not found.visible or (max(abs(right), abs(down)) < smallest and not scale):
            return [Finding("registration", "ok", text)]
        advice = "shift one of them; check for a crop, a resize or a lens correction applied to only one of them"
        return [Finding("registration", "warning", text, advice)]
    level: Level = "note"
    advice = "check that they belong together; few edges or noisy depth can have the same effect"
    if verdict.kind == "fits":
        level, text, advice = "ok", verdict.statement, ""
    elif verdict.kind in ("apart", "other"):
        level, advice = "warning", "check that photo and depth belong together"
    return [Finding("registration", level, text, advice)]


def check_holes(scene: Scene) -> list[Finding]:
    """Check the fraction of missing pixels, and whether a depth value seems to mark missing pixels."""
    depth = metres(scene)
    missing = float(np.isnan(depth).mean())
    level: Level = "warning" if missing > _MOST else "note" if missing > _MANY else "ok"
    advice = {
        "warning": "results are unreliable where most depth is missing; inpaint the holes, or crop to the valid part",
        "note": "scores ignore holes",
    }.get(level, "")
    return [Finding("holes", level, f"{1 - missing:.1%} of the pixels are valid", advice), *_marks(scene, depth)]


def _marks(scene: Scene, depth: Array) -> list[Finding]:
    """Return the extreme values that look like marks, of the depth or else of the distance along the ray."""
    for values in (depth, depth * scene.camera.ray_lengths().numpy()):
        with np.errstate(invalid="ignore"):
            power = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(values)))
            rounded = np.round(values * power) / power
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


def _judge(where: np.ndarray, value: float, beside: float, fraction: float) -> list[Finding]:
    smallest = value < beside
    apart = max(value, beside) / min(value, beside) > _GAP
    mark = value < _TINY if smallest else bool(np.isclose(value, _MARKS, rtol=1e-5, atol=0).any())
    if not apart and not mark:
        return []
    name = "smallest" if smallest else "largest"
    message = f"{fraction:.1%} of the valid pixels have exactly the {name} value, {value:g} m"
    labels, regions = ndimage.label(where)
    scattered = regions > 20 and np.bincount(labels.ravel())[1:].max() < 0.5 * where.sum()  # holes are, a wall is not
    if mark or scattered:
        advice = 'if it marks holes, set "hole_value" in camera.json, in the unit of the file, or add a mask.png'
        return [Finding("holes", "warning", f"{message}, which looks like a mark of missing depth", advice)]
    message += f"; the next value is {beside:g} m"
    advice = 'correct for a flat wall; if it marks holes, set "hole_value" in camera.json'
    return [Finding("holes", "note", message, advice)]


def check_precision(scene: Scene) -> list[Finding]:
    """Check whether the rounding of the depth is visible in renderings."""
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
        return f"{rounding.quantity} comes in steps of {show_length(rounding.step)}"
    if scene.camera.baseline is None:
        return f"inverse depth comes in steps of {rounding.step:.2g} / m"
    return f"disparity comes in steps of {rounding.step * baseline_times_focal(scene.camera):.2g} px"


def check_planes(scene: Scene) -> list[Finding]:
    """Check whether planar surfaces are planar if the depth is orthogonal."""
    rounding = find_rounding(scene)
    votes = range_votes(metres(scene), scene.camera, 0.0 if rounding is None else rounding.relative)
    if votes.verdict == "orthogonal":
        return [Finding("planes", "ok", f"{votes.flat} of {votes.windows} planar windows support orthogonal depth")]
    if votes.verdict is None:
        counts = f"planar windows: {votes.flat} and {votes.ray}"
        message = f"too few planes to distinguish orthogonal depth from distance along the ray ({counts})"
        return [Finding("planes", "note", message)]
    message, support, other = "depth looks like distance along the ray", votes.ray, "perspective"
    if votes.verdict == "reverse":
        message = "depth was read as distance along the ray but looks orthogonal in the file"
        support, other = votes.reverse, "orthogonal"
    message += f": {support} of {votes.windows} planar windows support this, {votes.flat} support the present type"
    return [Finding("planes", "problem", message, f'set "range_type": "{other}" in camera.json')]


def check_size(scene: Scene) -> list[Finding]:
    """Check whether the usual scales divide the image size."""
    height, width = scene.camera.height, scene.camera.width
    text = f"{height} x {width} pixels (height x width)"
    if height % _DIVISOR == 0 and width % _DIVISOR == 0:
        return [Finding("size", "ok", text)]
    inner = f"{height // _DIVISOR * _DIVISOR} x {width // _DIVISOR * _DIVISOR}"
    message = f"{text}, not divisible by {_DIVISOR}: at x{_DIVISOR} the top left {inner} pixels are used"
    return [Finding("size", "note", message, "crop the scene and its camera to choose another part")]


CHECKS: tuple[Callable[[Scene], list[Finding]], ...] = (
    check_units, check_intrinsics, check_registration, check_holes, check_precision, check_planes, check_size,
)  # fmt: skip
