"""Checks of a camera against its image: field of view, principal point, focal lengths, and image size."""

from __future__ import annotations

import itertools
import math

from dsr.doctor.finding import Finding
from dsr.geometry.camera import Camera
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


def check_intrinsics(scene: Scene) -> list[Finding]:
    """Check the camera against the image.

    Args:
        scene: scene at any resolution.

    """
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
