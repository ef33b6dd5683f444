"""Whether photo and depth edges lie apart, for ``dsr upsample``: a warning, or with ``--register`` the cure."""

from __future__ import annotations

from dataclasses import replace

from dsr.geometry.registration import Displacement, find_displacement, undo
from dsr.io.inputs import Picture
from dsr.notes import Assumption


def align(picture: Picture, *, register: bool) -> Picture:
    """Return a picture whose depth map is moved to the photo's edges, or with a note that it should be.

    Args:
        picture: the picture.
        register: whether to move the depth map; otherwise it stays as it is.

    """
    if min(picture.depth_lr.shape[-2:]) < 2:
        return picture
    found = find_displacement(picture.depth_lr, picture.rgb)
    certain = found is not None and found.certain
    if register:
        depth_lr = undo(picture.depth_lr, found) if found is not None and certain else picture.depth_lr
        return replace(picture, depth_lr=depth_lr, assumptions=(*picture.assumptions, _cure(found)))
    if found is None or not found.visible:
        return picture
    detail = f"{_where(found)}; --register moves the depth map"
    warning = Assumption("the photo's edges lie beside the depth edges", detail, "edges-beside", found.moved)
    return replace(picture, assumptions=(*picture.assumptions, warning))


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
