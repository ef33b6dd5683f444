"""Checks of a camera: against its image, of the registration of photo and depth, and of the range type."""

from __future__ import annotations

import math
from collections.abc import Callable

from dsr.doctor.depth_checks import find_rounding
from dsr.doctor.finding import Array, Finding, metres
from dsr.geometry.edges import APART, MAX_SHIFT, SHIFT, WORKING_SIZE, Match, best_match, find_edges
from dsr.geometry.planes import range_votes
from dsr.geometry.plausible import judge_camera, offset_of, view_of
from dsr.sample import Scene

_DIVISOR = 8

_STRICTER = 1.5
"""Factor of the thresholds for a flipped photo, because three flips are tried."""
_TURNS: dict[str, Callable[[Array], Array]] = {
    "mirrored left to right": lambda photo: photo[:, :, ::-1],
    "mirrored top to bottom": lambda photo: photo[:, ::-1],
    "turned by 180 degrees": lambda photo: photo[:, ::-1, ::-1],
}


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
    """Check whether the photo's edges coincide with the depth edges."""
    every = math.ceil(max(scene.camera.height, scene.camera.width) / WORKING_SIZE)
    depth, photo = _reduce(scene, every)
    radius = max(round(max(depth.shape) * MAX_SHIFT), APART)
    edges = find_edges(depth, radius)
    if not edges.enough():
        return [Finding("registration", "note", f"not enough depth edges for this check ({edges.count} pixels)")]
    match = best_match(edges, photo, radius)
    if match.found:
        return [_report(match, every)]
    for name, turn in _TURNS.items():
        if best_match(edges, turn(photo), radius, _STRICTER).found:
            advice = "flip or rotate the photo or the depth"
            return [Finding("registration", "problem", f"the photo is {name} relative to the depth", advice)]
    message = f"the photo's edges match the depth edges at no shift within {radius * every} px"
    return [
        Finding(
            "registration", "note", message, "check that they belong together; noisy depth can have the same effect"
        )
    ]


def _reduce(scene: Scene, every: int) -> tuple[Array, Array]:
    """Return depth and photo reduced by a factor; depth is subsampled, which keeps its edges sharp."""
    photo = scene.rgb.double().numpy()
    height, width = (size // every for size in photo.shape[1:])
    blocks = photo[:, : height * every, : width * every].reshape(3, height, every, width, every)
    depth = metres(scene)[every // 2 :: every, every // 2 :: every][:height, :width]
    return depth, blocks.mean(axis=(2, 4))


def _report(match: Match, every: int) -> Finding:
    """Return the finding for a shift between photo and depth."""
    across = f"{abs(match.right) * every} px {'left' if match.right < 0 else 'right'}"
    down = f"{abs(match.down) * every} px {'above' if match.down < 0 else 'below'}"
    shifted = bool(match.right or match.down)
    text = (
        f"the photo's edges are {across}, {down} of the depth edges"
        if shifted
        else "the photo's edges match the depth edges"
    )
    if max(abs(match.right), abs(match.down)) < SHIFT or not match.needed:
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
