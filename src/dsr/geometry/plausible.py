"""Implausible and impossible cameras, baselines and distances: the checks that all commands share."""

import itertools
import math
from typing import Literal, NamedTuple

from dsr.geometry.camera import Camera
from dsr.notes import LIMITS

_USUAL_VIEW = (20.0, 120.0)  # horizontal fields of view in degrees
_FITTING = 0.05  # relative error up to which numbers fit another size, or the principal point is in the middle
_SCALES = (2.0, 3.0, 4.0, 8.0, 1.5, 2.5)
_NUMBERS = ("fx", "fy", "cx", "cy")


class Remark(NamedTuple):
    """A remark on a camera: that of a ``note`` may be right, of a ``warning`` hardly, and of a ``problem`` is wrong."""

    level: Literal["note", "warning", "problem"]
    kind: str  # a text without the camera's numbers
    message: str
    advice: str
    code: str = ""  # one of LIMITS, empty for a note
    value: float | None = None  # what the limit was compared with


def judge_camera(camera: Camera, size_lr: tuple[int, int] | None = None) -> list[Remark]:
    """Return remarks on a camera; ``size_lr`` is (height, width) of a depth map that another one may have taken."""
    found = []
    view, offset, (low, high) = view_of(camera), offset_of(camera), _USUAL_VIEW
    ratio = max(camera.fx, camera.fy) / min(camera.fx, camera.fy)
    if not low <= view <= high:
        text = f"fx {camera.fx:.4g} px gives a horizontal field of view of {view:.3g} degrees"
        remark = ("hardly any camera has this field of view", f"{text}; {low:g} to {high:g} are usual")
        if LIMITS["view-narrow"] <= view <= LIMITS["view-wide"]:
            found.append(Remark("note", *remark, "correct for a telephoto or a very wide lens"))
        else:
            degrees = f"60 degrees correspond to {0.866 * camera.width:.0f} px"
            advice = f"give fx and fy in pixels of this image, not in mm; {degrees}"
            found.append(Remark("warning", *remark, advice, "view-narrow" if view < low else "view-wide", view))
    if offset > LIMITS["other-picture"] or ratio > LIMITS["focal-ratio"]:
        other = _other_picture(camera, size_lr)
        if other is not None:
            return [*found, Remark("problem", *other, "other-picture", offset)]
    if offset > LIMITS["other-picture"]:
        right, below = _from_middle(camera.cx, camera.cy, camera.width, camera.height)
        message = (
            f"principal point ({camera.cx:.4g}, {camera.cy:.4g}) px is {abs(right):.0%} of the width "
            f"{'right' if right > 0 else 'left'} of the centre and {abs(below):.0%} of the height "
            f"{'below' if below > 0 else 'above'} it"
        )
        remark = ("the principal point is far from the middle", message)
        if offset <= LIMITS["off-centre"]:
            found.append(Remark("note", *remark, "correct for a cropped image"))
        else:
            advice = "check cx and cy; if the image was cropped or resized, the camera must be adapted"
            found.append(Remark("warning", *remark, advice, "off-centre", offset))
    if ratio > LIMITS["focal-ratio"]:
        message = f"fx {camera.fx:.4g} and fy {camera.fy:.4g} px differ by {ratio - 1:.0%}"
        advice = "pixels are usually square: check both, and the aspect ratio of the image"
        found.append(Remark("warning", "fx and fy differ", message, advice, "focal-ratio", ratio))
    return found


def expect_possible(camera: Camera, name: str) -> None:
    """Check that a camera could see its picture: a lens without distortion shows some of its rays."""
    axes = (camera.cx, camera.width, camera.fx), (camera.cy, camera.height, camera.fy)
    beyond = (max(-0.5 - middle, middle - size + 0.5, 0) / focal for middle, size, focal in axes)
    angle = math.degrees(math.atan(math.hypot(*beyond)))
    if angle > LIMITS["beside-axis"]:
        size = f"{camera.width} x {camera.height} pixels (width x height)"
        got = f"cx {camera.cx:g} and cy {camera.cy:g} with fx {camera.fx:g} and fy {camera.fy:g}"
        raise ValueError(f"{name}: expected a principal point in or near the picture of {size}, got {got}")


def plausible_baseline(baseline: float) -> bool:
    """Return whether two cameras may be so many metres apart."""
    return LIMITS["baseline-short"] <= baseline <= LIMITS["baseline-long"]


def implausible_distance(low: float, high: float) -> Literal["depth-near", "depth-far"] | None:
    """Return the limit beyond which a whole depth map lies, which extends from ``low`` to ``high`` metres, if any."""
    if high < LIMITS["depth-near"]:
        return "depth-near"
    return "depth-far" if low > LIMITS["depth-far"] else None


def view_of(camera: Camera) -> float:
    """Return the horizontal field of view in degrees."""
    left, right = camera.cx + 0.5, camera.width - 0.5 - camera.cx
    return math.degrees(math.atan(left / camera.fx) + math.atan(right / camera.fx))


def offset_of(camera: Camera) -> float:
    """Return how far the principal point is off the centre, as a fraction of the width or height, the larger one."""
    return max(map(abs, _from_middle(camera.cx, camera.cy, camera.width, camera.height)))


def may_be_of(cx: float, cy: float, width: int, height: int) -> bool:
    """Return whether a principal point may be that of a picture of this size."""
    return max(map(abs, _from_middle(cx, cy, width, height))) <= LIMITS["off-centre"]


def _from_middle(cx: float, cy: float, width: int, height: int) -> tuple[float, float]:
    """Return how far a principal point is right of and below the middle, as fractions of the width and height."""
    return (cx + 0.5) / width - 0.5, (cy + 0.5) / height - 0.5


def _other_picture(camera: Camera, size_lr: tuple[int, int] | None) -> tuple[str, str, str] | None:
    """Return kind, message and advice if the numbers fit better in another order, or to an image of another size."""
    text = f"fx {camera.fx:.4g}, fy {camera.fy:.4g}, cx {camera.cx:.4g}, cy {camera.cy:.4g} px"
    order = _better_order(camera)
    if order is not None:
        message = f"{text} fit the {camera.height} x {camera.width} image in another order"
        advice = f"correct the order: {', '.join(f'{name} is the number given as {other}' for name, other in order)}"
        return "the intrinsics are in another order", message, advice
    kind = "the intrinsics fit another picture"
    across, down = (2 * camera.cx + 1) / camera.width, (2 * camera.cy + 1) / camera.height
    if size_lr is not None and size_lr != (camera.height, camera.width):
        height, width = size_lr
        wide, high = width / camera.width, height / camera.height
        if abs(across / wide - 1) < _FITTING and abs(down / high - 1) < _FITTING:
            of_map, of_photo = f"{width} x {height}", f"{camera.width} x {camera.height}"
            message = f"{text} fit the depth map of {of_map}, not the photo of {of_photo}"
            return kind, message, "give the intrinsics of the photo's camera, in pixels of the photo"
    for scale in (*_SCALES, *(1 / each for each in _SCALES)):
        if abs(across / scale - 1) < _FITTING and abs(down / scale - 1) < _FITTING:
            size = f"{camera.height * scale:.0f} x {camera.width * scale:.0f}"
            message = f"{text} fit an image {scale:.3g} times as large ({size})"
            return kind, message, f"divide them by {scale:.3g}, unless the image was cropped"
    return None


def _better_order(camera: Camera) -> list[tuple[str, str]] | None:
    """Return the numbers to exchange for a good fit, as (name, name under which its number is given), or None."""
    best = None
    for order in itertools.permutations(_NUMBERS):
        fx, fy, cx, cy = (getattr(camera, name) for name in order)
        if min(fx, fy) <= 0:
            continue
        other = Camera(camera.width, camera.height, fx, fy, cx, cy)
        usual = _USUAL_VIEW[0] <= view_of(other) <= _USUAL_VIEW[1]
        moved = [(name, given) for name, given in zip(_NUMBERS, order, strict=True) if name != given]
        fits = offset_of(other) < _FITTING and max(fx, fy) / min(fx, fy) < 1.03 and usual
        if fits and (best is None or len(moved) < len(best)):
            best = moved
    return best
