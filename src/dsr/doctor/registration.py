"""Check of the registration of photo and depth: edges of the depth should coincide with edges of the photo.

See :mod:`dsr.geometry.edges` for how they are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from dsr.doctor.finding import Array, Finding, metres
from dsr.geometry.edges import APART, MAX_SHIFT, SHIFT, WORKING_SIZE, Match, best_match, find_edges
from dsr.sample import Scene

_STRICTER = 1.5
"""Factor of the thresholds for a flipped photo, because three flips are tried."""
_TURNS: dict[str, Callable[[Array], Array]] = {
    "mirrored left to right": lambda photo: photo[:, :, ::-1],
    "mirrored top to bottom": lambda photo: photo[:, ::-1],
    "turned by 180 degrees": lambda photo: photo[:, ::-1, ::-1],
}


def check_registration(scene: Scene) -> list[Finding]:
    """Check whether the photo's edges coincide with the depth edges.

    Args:
        scene: scene with high-resolution depth.

    """
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
