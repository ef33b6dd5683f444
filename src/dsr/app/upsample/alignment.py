"""Alignment of photo and depth map for ``dsr upsample``: warnings, or with ``--register`` a correction."""

from __future__ import annotations

from dataclasses import replace

from dsr.geometry.agreement import (
    Outlines,
    Size,
    Verdict,
    depth_outlines,
    find_misplaced,
    judge,
    photo_outlines,
    reduce_photo,
    significances,
    working_size,
)
from dsr.geometry.registration import Displacement, find_displacement, undo
from dsr.io.inputs import Picture
from dsr.io.pairs import Pair
from dsr.notes import LIMITS, Assumption


def align(picture: Picture, *, register: bool) -> Picture:
    """Return a picture whose depth map is moved to the photo's edges, or with a note that it should be.

    Args:
        picture: the picture.
        register: whether to move the depth map; otherwise it stays as it is.

    """
    if min(picture.depth_lr.shape[-2:]) < 2:
        return picture
    verdict = judge(picture.depth_lr[0].cpu().numpy(), picture.rgb)
    if verdict is not None and verdict.kind == "turned":  # no displacement is the cure
        return replace(picture, assumptions=(*picture.assumptions, *_doubts(verdict)))
    found = find_displacement(picture.depth_lr, picture.rgb)
    certain = found is not None and found.certain
    notes = [] if certain or verdict is None else _doubts(verdict)
    if register:
        depth_lr = undo(picture.depth_lr, found) if found is not None and certain else picture.depth_lr
        return replace(picture, depth_lr=depth_lr, assumptions=(*picture.assumptions, _cure(found), *notes))
    if found is not None and found.visible:
        detail = f"{_where(found)}; --register moves the depth map"
        notes = [Assumption("the photo's edges lie beside the depth edges", detail, "edges-beside", found.moved)]
    return replace(picture, assumptions=(*picture.assumptions, *notes))


class Order:
    """Whether depth maps fit their own photos better than those of other pairs."""

    def __init__(self) -> None:
        self._pairs: list[Pair] = []
        self._depths: list[Outlines] = []
        self._photos: list[Outlines] = []
        self._size: Size | None = None

    def add(self, pair: Pair, picture: Picture) -> None:
        """Add a pair."""
        depth = picture.depth_lr[0].cpu().numpy()
        if self._size is None:
            self._size = working_size(depth, picture.rgb)
        self._pairs.append(pair)
        self._depths.append(depth_outlines(depth, self._size))
        self._photos.append(photo_outlines(reduce_photo(picture.rgb, self._size), max(self._size) / max(depth.shape)))

    def warnings(self) -> list[Assumption]:
        """Return a warning if too many fit another photo better."""
        found = find_misplaced(significances(self._depths, self._photos)) if len(self._pairs) > 1 else []
        if len(found) < LIMITS["photo-order"]:
            return []
        text = f"of {len(self._pairs)} pairs {len(found)} fit another photo better: are the lists in the same order?"
        own, other = (self._pairs[number] for number in found[0])
        return [Assumption(text, f"such as {own.depth.name} with {other.rgb.name}", "photo-order", float(len(found)))]


def _doubts(verdict: Verdict) -> list[Assumption]:
    """Return a warning if a pair can hardly belong together."""
    if not verdict.code:
        return []
    cure = {
        "photo-turned": "turn one of the two",
        "field-of-view": "crop one of the two, or register them",
        "edges-beside": "was one of the two cropped?",
        "photo-other": "are the two of the same moment?",
    }[verdict.code]
    score = "" if verdict.kind == "apart" else "agreement of edges "
    return [Assumption(verdict.statement, f"{score}{verdict.figures}; {cure}", verdict.code, verdict.value)]


def _cure(found: Displacement | None) -> Assumption:
    """Return what ``--register`` did."""
    if found is None:
        return Assumption("--register: there are not enough depth edges to compare, the depth map stays where it is")
    if not found.certain:
        return Assumption("--register: no displacement is certain, the depth map stays where it is")
    return Assumption("--register: the depth map is moved to the photo's edges", f"by {found}")


def _where(found: Displacement) -> str:
    """Return where the photo's edges are."""
    parts = [
        f"{abs(pixels):.1f} px {side}"
        for pixels, side in (
            (found.right, "to the right" if found.right > 0 else "to the left"),
            (found.down, "below" if found.down > 0 else "above"),
        )
        if round(abs(pixels), 1)
    ]
    scale = [f"at {found.scale:.3f} times the size"] if found.scale != 1 else []
    return ", ".join([*parts, *scale]) + ", in pixels of the depth map"
