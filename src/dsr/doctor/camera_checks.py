"""Checks of a camera: against its image, of the registration of photo and depth, and of the range type.

Planes become curved if distance along the ray is read as orthogonal depth: a plane is linear in 1 / z over the image.
If the values s follow z = s / |r|**k, with k = 0 for orthogonal depth, 1 for distance along the ray, and -1 for
orthogonal depth that was read as distance along the ray and divided by |r|, then 1 / s = (a u + b v + c) / |r|**k. This
is linear in a, b, c and, as |r| changes little within a window, in k: 1 / s = a u + b v + c - k log|r| / s. A robust
fit to windows of many sizes and positions estimates k. Windows with a good fit are planar and vote.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch

from dsr.doctor.depth_checks import find_rounding
from dsr.doctor.finding import Array, Finding, metres
from dsr.geometry.agreement import judge
from dsr.geometry.camera import Camera
from dsr.geometry.edges import SHIFT, WORKING_SIZE
from dsr.geometry.registration import Displacement, find_displacement
from dsr.sample import Scene

_VIEW, _USUAL_VIEW = (12.0, 130.0), (20.0, 120.0)
"""Horizontal fields of view in degrees that are plausible, and usual."""
_OFFSET, _SMALL_OFFSET = 0.25, 0.10
"""Distance of the principal point from the centre, as a fraction of the size."""
_RATIO = 1.10
"""Largest plausible ratio of fx and fy."""
_SCALES = (2.0, 3.0, 4.0, 8.0, 1.5, 2.5)
_NUMBERS = ("fx", "fy", "cx", "cy")
_DIVISOR = 8

_SIZES = (1.0, 2 / 3, 1 / 2, 1 / 3, 1 / 4, 1 / 6)
"""Sizes of windows, as fractions of the shorter image side."""
_CELLS = 16
"""Cells across a window; values are averaged within cells to reduce noise."""
_ITERATIONS = 12
_MIN_VALID, _INLIERS = 0.6, 0.55
"""Minimum fractions of a window's cells that are valid, and that are on the plane."""
_NOISE = 0.5
"""Largest deviation of a planar window from its fit, as a fraction of the curvature that k = 1 causes."""
_NEAR = 0.3
"""Largest distance of k from the value that a window votes for."""
_WHOLE = 0.95
"""Minimum fraction of valid pixels in a cell."""
_LARGEST = 1e3
"""Upper limit of inverse depth, as a multiple of the median's."""
_EXACT = 1e-12
_LEAST, _LEAD = 4, 3
"""Minimum number of votes for orthogonal depth, and their minimum ratio to all others."""
_LEAST_BENT, _MAJORITY_BENT = 6, 0.7
"""Minimum number of votes for another type, and their minimum fraction of the planar windows."""


def check_intrinsics(scene: Scene) -> list[Finding]:
    """Check the camera against the image."""
    camera = scene.camera
    findings = [*_view(camera), *(_other_picture(camera) or _centre(camera) + _shape(camera))]
    if findings:
        return findings
    text = f"{_degrees(camera):.0f} degrees across, principal point {_offset(camera):.1%} off the centre"
    return [Finding("intrinsics", "ok", text)]


def check_size(scene: Scene) -> list[Finding]:
    """Check whether the usual scales divide the image size."""
    height, width = scene.camera.height, scene.camera.width
    text = f"{height} x {width} pixels (height x width)"
    if height % _DIVISOR == 0 and width % _DIVISOR == 0:
        return [Finding("size", "ok", text)]
    inner = f"{height // _DIVISOR * _DIVISOR} x {width // _DIVISOR * _DIVISOR}"
    message = f"{text}, not divisible by {_DIVISOR}: at x{_DIVISOR} the top left {inner} pixels are used"
    return [Finding("size", "note", message, "crop the scene and its camera to choose another part")]


def _degrees(camera: Camera) -> float:
    """Return the horizontal field of view in degrees."""
    left, right = camera.cx + 0.5, camera.width - 0.5 - camera.cx
    return math.degrees(math.atan(left / camera.fx) + math.atan(right / camera.fx))


def _offsets(camera: Camera) -> tuple[float, float]:
    """Return the offset of the principal point from the centre, as fractions of the width and height."""
    return (camera.cx + 0.5) / camera.width - 0.5, (camera.cy + 0.5) / camera.height - 0.5


def _offset(camera: Camera) -> float:
    return max(map(abs, _offsets(camera)))


def _ratio(camera: Camera) -> float:
    return max(camera.fx, camera.fy) / min(camera.fx, camera.fy)


def _view(camera: Camera) -> list[Finding]:
    view = _degrees(camera)
    if _USUAL_VIEW[0] <= view <= _USUAL_VIEW[1]:
        return []
    message = f"fx {camera.fx:.4g} px gives a horizontal field of view of {view:.3g} degrees; 20 to 120 are usual"
    if _VIEW[0] <= view <= _VIEW[1]:
        return [Finding("intrinsics", "note", message, "correct for a telephoto or a very wide lens")]
    advice = (
        f"give fx and fy in pixels of this image, not in mm; 60 degrees correspond to {0.866 * camera.width:.0f} px"
    )
    return [Finding("intrinsics", "warning", message, advice)]


def _other_picture(camera: Camera) -> list[Finding]:
    """Check whether the numbers fit better in another order, or to an image of another size."""
    if _offset(camera) <= _SMALL_OFFSET and _ratio(camera) <= _RATIO:
        return []
    text = f"fx {camera.fx:.4g}, fy {camera.fy:.4g}, cx {camera.cx:.4g}, cy {camera.cy:.4g} px"
    order = _better_order(camera)
    if order is not None:
        correction = ", ".join(f"{name} is the number given as {other}" for name, other in order)
        message = f"{text} fit the {camera.height} x {camera.width} image in another order"
        return [Finding("intrinsics", "problem", message, f"correct the order: {correction}")]
    across, down = (2 * camera.cx + 1) / camera.width, (2 * camera.cy + 1) / camera.height
    for scale in (*_SCALES, *(1 / scale for scale in _SCALES)):
        if abs(across / scale - 1) < 0.05 and abs(down / scale - 1) < 0.05:
            size = f"{camera.height * scale:.0f} x {camera.width * scale:.0f}"
            message = f"{text} fit an image {scale:.3g} times as large ({size})"
            advice = f"divide them by {scale:.3g}, unless the image was cropped"
            return [Finding("intrinsics", "problem", message, advice)]
    return []


def _better_order(camera: Camera) -> list[tuple[str, str]] | None:
    """Return the numbers to exchange for a good fit, as (name, name under which its number is given), or None."""
    values = [getattr(camera, name) for name in _NUMBERS]
    best = None
    for order in itertools.permutations(range(4)):
        fx, fy, cx, cy = (values[index] for index in order)
        if min(fx, fy) <= 0:
            continue
        other = Camera(camera.width, camera.height, fx, fy, cx, cy)
        fits = _offset(other) < 0.05 and _ratio(other) < 1.03 and _USUAL_VIEW[0] <= _degrees(other) <= _USUAL_VIEW[1]
        moved = [(_NUMBERS[place], _NUMBERS[index]) for place, index in enumerate(order) if place != index]
        if fits and (best is None or len(moved) < len(best)):
            best = moved
    return best


def _centre(camera: Camera) -> list[Finding]:
    right, below = _offsets(camera)
    if _offset(camera) <= _SMALL_OFFSET:
        return []
    message = (
        f"principal point ({camera.cx:.4g}, {camera.cy:.4g}) px is {abs(right):.0%} of the width "
        f"{'right' if right > 0 else 'left'} of the centre and {abs(below):.0%} of the height "
        f"{'below' if below > 0 else 'above'} it"
    )
    if _offset(camera) <= _OFFSET:
        return [Finding("intrinsics", "note", message, "correct for a cropped image")]
    advice = "check cx and cy; if the image was cropped or resized, the camera must be adapted"
    return [Finding("intrinsics", "warning", message, advice)]


def _shape(camera: Camera) -> list[Finding]:
    if _ratio(camera) <= _RATIO:
        return []
    message = f"fx {camera.fx:.4g} and fy {camera.fy:.4g} px differ by {_ratio(camera) - 1:.0%}"
    return [
        Finding(
            "intrinsics", "warning", message, "pixels are usually square: check both, and the aspect ratio of the image"
        )
    ]


def check_registration(scene: Scene) -> list[Finding]:
    """Check whether the photo shows what the depth map shows, and its edges coincide with the depth edges."""
    verdict = judge(metres(scene), scene.rgb)
    if verdict is None:
        return [Finding("registration", "note", "no edges in the depth map or in the photo for this check")]
    if verdict.turned:
        return [Finding("registration", "problem", str(verdict), "flip or rotate the photo or the depth")]
    found = find_displacement(torch.from_numpy(metres(scene))[None], scene.rgb)
    if found is not None and found.certain:
        return [_report(found, math.ceil(max(scene.rgb.shape[1:]) / WORKING_SIZE))]
    if verdict.fits:
        return [Finding("registration", "ok", verdict.statement)]
    if verdict.apart or verdict.other:
        return [Finding("registration", "warning", str(verdict), "check that photo and depth belong together")]
    advice = "check that they belong together; few edges or noisy depth can have the same effect"
    return [Finding("registration", "note", str(verdict), advice)]


def _report(found: Displacement, every: int) -> Finding:
    """Return the finding for a displacement between photo and depth, compared in steps of ``every`` pixels."""
    right, down = round(found.right), round(found.down)
    scale = f", at {found.scale:.3f} times the size" if round(found.scale, 3) != 1 else ""
    text = (
        f"the photo's edges are {abs(right)} px {'left' if right < 0 else 'right'}, "
        f"{abs(down)} px {'above' if down < 0 else 'below'} of the depth edges{scale}"
    )
    if not found.visible or (max(abs(right), abs(down)) < SHIFT * every and not scale):
        return Finding("registration", "ok", text)
    advice = "shift one of them; check for a crop, a resize or a lens correction applied to only one of them"
    return Finding("registration", "warning", text, advice)


@dataclass(frozen=True)
class Windows:
    """Square windows of a map of inverse depth, averaged within cells.

    Args:
        inverse: (N, cells) 1 / s, as a multiple of the window's median; 0 where invalid.
        valid: (N, cells) bool.
        u, v: (N, cells) position within the window, about -1 to 1.
        bend: (N, cells) logarithm of |r|, minus its mean over the window.

    """

    inverse: Array
    valid: np.ndarray
    u: Array
    v: Array
    bend: Array


def check_planes(scene: Scene) -> list[Finding]:
    """Check whether planar surfaces are planar if the depth is orthogonal."""
    depth = metres(scene)
    rounding = find_rounding(scene)
    votes = plane_votes(depth, scene.camera, 0.0 if rounding is None else rounding.relative)
    flat, ray, reverse = (int((np.abs(votes - k) < _NEAR).sum()) for k in (0, 1, -1))
    bent = f"{{}} of {votes.size} planar windows support this, {flat} support the present type"
    if ray >= _LEAST_BENT and ray > _MAJORITY_BENT * votes.size:
        message = f"depth looks like distance along the ray: {bent.format(ray)}"
        return [Finding("planes", "problem", message, 'set "range_type": "perspective" in camera.json')]
    if reverse >= _LEAST_BENT and reverse > _MAJORITY_BENT * votes.size:
        message = f"depth was read as distance along the ray but looks orthogonal in the file: {bent.format(reverse)}"
        return [Finding("planes", "problem", message, 'set "range_type": "orthogonal" in camera.json')]
    if flat >= _LEAST and flat > _LEAD * (ray + reverse):
        return [Finding("planes", "ok", f"{flat} of {votes.size} planar windows support orthogonal depth")]
    counts = f"planar windows: {flat} and {ray}"
    message = f"too few planes to distinguish orthogonal depth from distance along the ray ({counts})"
    return [Finding("planes", "note", message)]


def plane_votes(values: Array, camera: Camera, step: float = 0.0) -> Array:
    """Estimate the exponent k of each planar window: near 0 orthogonal, 1 along the ray, -1 the reverse.

    Args:
        values: (H, W) positive, in any unit, NaN in holes.
        camera: camera of these pixels.
        step: rounding step of the values, as a fraction of them.

    """
    windows = _windows(values, camera)
    if not windows.inverse.size:
        return np.empty(0)
    columns = np.stack((np.ones_like(windows.u), windows.u, windows.v, -windows.bend * windows.inverse), axis=-1)
    scale = np.sqrt(np.square(columns).mean(axis=1, keepdims=True))
    columns = columns / scale
    fit, weight = _robust_fit(columns, windows)
    residual = windows.inverse - _product(columns, fit)
    bent = columns[..., 3] * scale[..., 3]
    bent = bent - _product(columns[..., :3], _solve(columns[..., :3], weight, bent))
    signal, noise = (_spread(values, weight) for values in (bent, residual))
    noise = np.hypot(noise, step / np.sqrt(12))
    planar = (weight.mean(axis=1) > _INLIERS) & (noise < _NOISE * signal)
    exponents: Array = (fit[:, 3] / scale[:, 0, 3])[planar]
    return exponents


def _windows(values: Array, camera: Camera) -> Windows:
    """Return the windows of a map that have enough valid pixels."""
    valid = np.isfinite(values)
    inverse = np.where(valid, np.nanmedian(values) / values, 0).clip(max=_LARGEST)
    tops, lefts, sizes = _places(*values.shape)
    ends = np.round(np.arange(_CELLS + 1) * sizes[:, None] / _CELLS).astype(int)
    rows, columns = tops[:, None] + ends, lefts[:, None] + ends
    area = np.diff(rows)[:, :, None] * np.diff(columns)[:, None, :]
    count = _totals(valid.astype(np.float64), rows, columns)
    whole = count > _WHOLE * area
    enough = whole.mean(axis=(1, 2)) > _MIN_VALID
    rows, columns, whole, count = rows[enough], columns[enough], whole[enough], count[enough]
    means = np.where(whole, _totals(inverse, rows, columns) / np.maximum(count, 1), 0)
    v, u = (((part[:, 1:] + part[:, :-1]) - 1) / 2 for part in (rows, columns))
    slopes = np.square((u - camera.cx) / camera.fx)[:, None, :] + np.square((v - camera.cy) / camera.fy)[:, :, None]
    bend = np.log1p(slopes) / 2
    bend -= bend.mean(axis=(1, 2), keepdims=True)
    u, v = (2 * (part - part.mean(axis=1, keepdims=True)) / sizes[enough, None] for part in (u, v))
    u, v = np.broadcast_to(u[:, None, :], bend.shape), np.broadcast_to(v[:, :, None], bend.shape)
    shape = (len(means), _CELLS**2)
    means, whole, u, v, bend = (field.reshape(shape) for field in (means, whole, u, v, bend))
    scale = np.array([np.median(mean[own]) for mean, own in zip(means, whole, strict=True)])[:, None]
    return Windows(means / scale, whole, u, v, bend)


def _places(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first rows, first columns and sizes of windows that overlap by half."""
    found = []
    for fraction in _SIZES:
        size = int(min(height, width) * fraction)
        if size >= _CELLS:
            tops, lefts = (
                np.linspace(0, n - size, round(2 * (n - size) / size) + 1).astype(int) for n in (height, width)
            )
            found += [(top, left, size) for top in tops for left in lefts]
    tops, lefts, sizes = np.array(found, dtype=int).reshape(-1, 3).T
    return tops, lefts, sizes


def _totals(values: Array, rows: np.ndarray, columns: np.ndarray) -> Array:
    """Return the sums over the cells with borders at rows (N, n + 1) and columns (N, n + 1), (N, n, n)."""
    sums = np.pad(values.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    totals: Array = np.diff(np.diff(sums[rows[:, :, None], columns[:, None, :]], axis=1), axis=2)
    return totals


def _robust_fit(columns: Array, windows: Windows) -> tuple[Array, Array]:
    """Return coefficients (N, 4), and weights (N, cells), 1 for inliers and 0 for outliers.

    The first iterations minimise absolute deviations, which tolerates up to half of the cells as outliers; the others
    use Tukey's biweight.
    """
    valid = windows.valid.astype(np.float64)
    weight = valid
    for iteration in range(_ITERATIONS):
        size = np.abs(windows.inverse - _product(columns, _solve(columns, weight, windows.inverse)))
        ratio = size / _deviation(size, windows.valid)
        absolute = iteration < _ITERATIONS // 2
        weight = valid * (
            1 / np.maximum(ratio, 0.05) if absolute else np.square((1 - np.square(ratio / 4)).clip(min=0))
        )
    fit = _solve(columns, weight, windows.inverse)
    size = np.abs(windows.inverse - _product(columns, fit))
    return fit, valid * (size < 3 * _deviation(size, windows.valid))


def _deviation(size: Array, valid: np.ndarray) -> Array:
    """Estimate the standard deviation from the median absolute residual, (N, 1)."""
    return 1.4826 * np.nanmedian(np.where(valid, size, np.nan), axis=1, keepdims=True) + _EXACT


def _solve(columns: Array, weight: Array, target: Array) -> Array:
    """Return the weighted least-squares coefficients (N, k) of columns (N, cells, k)."""
    weighted = columns.swapaxes(1, 2) * weight[:, None, :]
    ridge = _EXACT * np.eye(columns.shape[-1]) * (1 + weight.sum(axis=1))[:, None, None]
    solution: Array = np.linalg.solve(weighted @ columns + ridge, weighted @ target[..., None])[..., 0]
    return solution


def _product(columns: Array, fit: Array) -> Array:
    product: Array = (columns @ fit[..., None])[..., 0]
    return product


def _spread(values: Array, weight: Array) -> Array:
    """Return the weighted root mean square, (N,)."""
    return np.sqrt((np.square(values) * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1))
