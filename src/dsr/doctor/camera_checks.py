"""Checks of a camera: against its image, of the registration of photo and depth, and of the range type."""

from __future__ import annotations

import math

import torch

from dsr.doctor.depth_checks import Finding, find_rounding, metres
from dsr.geometry.agreement import judge
from dsr.geometry.planes import range_votes
from dsr.geometry.plausible import judge_camera, offset_of, view_of
from dsr.geometry.registration import SHIFT, WORKING_SIZE, Displacement, find_displacement
from dsr.sample import Scene

_DIVISOR = 8


def check_intrinsics(scene: Scene) -> list[Finding]:
    """Check the camera against the image."""
    found = judge_camera(scene.camera)
    if found:
        return [Finding("intrinsics", each.level, each.message, each.advice) for each in found]
    view, offset = view_of(scene.camera), offset_of(scene.camera)
    return [Finding("intrinsics", "ok", f"{view:.0f} degrees across, principal point {offset:.1%} off the centre")]


def check_size(scene: Scene) -> list[Finding]:
    """Check whether the usual scales divide the image size."""
    height, width = scene.camera.height, scene.camera.width
    text = f"{height} x {width} pixels (height x width)"
    if height % _DIVISOR == 0 and width % _DIVISOR == 0:
        return [Finding("size", "ok", text)]
    inner = f"{height // _DIVISOR * _DIVISOR} x {width // _DIVISOR * _DIVISOR}"
    message = f"{text}, not divisible by {_DIVISOR}: at x{_DIVISOR} the top left {inner} pixels are used"
    return [Finding("size", "note", message, "crop the scene and its camera to choose another part")]


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
        return [_report(found, math.ceil(max(scene.rgb.shape[1:]) / WORKING_SIZE))]
    if verdict.kind == "fits":
        return [Finding("registration", "ok", verdict.statement)]
    if verdict.kind in ("apart", "other"):
        return [Finding("registration", "warning", text, "check that photo and depth belong together")]
    advice = "check that they belong together; few edges or noisy depth can have the same effect"
    return [Finding("registration", "note", text, advice)]


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


def check_planes(scene: Scene) -> list[Finding]:
    """Check whether planar surfaces are planar if the depth is orthogonal."""
    rounding = find_rounding(scene)
    votes = range_votes(metres(scene), scene.camera, 0.0 if rounding is None else rounding.relative)
    bent = f"{{}} of {votes.windows} planar windows support this, {votes.flat} support the present type"
    if votes.verdict == "ray":
        message = f"depth looks like distance along the ray: {bent.format(votes.ray)}"
        return [Finding("planes", "problem", message, 'set "range_type": "perspective" in camera.json')]
    if votes.verdict == "reverse":
        message = (
            f"depth was read as distance along the ray but looks orthogonal in the file: {bent.format(votes.reverse)}"
        )
        return [Finding("planes", "problem", message, 'set "range_type": "orthogonal" in camera.json')]
    if votes.verdict == "orthogonal":
        return [Finding("planes", "ok", f"{votes.flat} of {votes.windows} planar windows support orthogonal depth")]
    counts = f"planar windows: {votes.flat} and {votes.ray}"
    message = f"too few planes to distinguish orthogonal depth from distance along the ray ({counts})"
    return [Finding("planes", "note", message)]
