"""Checks of the pictures of ``dsr upsample``: each photo against its depth map, and a sample of the frames together.

Photo and depth map are compared by their edges (:func:`align`); with ``--register`` the depth map is moved to the
photo's. Warnings about a sample of the frames apply to all similar frames (:func:`check_together`).
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dsr.app.upsample.frames import FrameSequence
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
from dsr.geometry.planes import inverse_votes, range_votes, thinned
from dsr.geometry.registration import find_displacement, undo
from dsr.io.inputs import Picture
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.notes import LIMITS, Assumption

_SAMPLE = 12  # frames that are looked at, in groups of two that follow each other
_OF_PLANES = 4  # largest number of them whose planes are looked at, which takes longer
_HALF = 2**-10  # relative step of floats of 16 bits


def check_together(
    pairs: Sequence[Pair], reading: Reading, read: Callable[[Pair], Picture], sequence: FrameSequence
) -> dict[str, tuple[Assumption, ...]]:
    """Return the warnings from checks of a sample of all frames, by the name of each frame that they apply to.

    Frames of one folder are alike in what their values are, and their poses; a frame that is alone in its folder is
    like those in other folders beside it. A frame that cannot be read is reported when its turn comes.
    """
    compared: list[tuple[Pair, Outlines, Outlines]] = []
    size: Size | None = None
    posed: set[Path] = set()
    found = defaultdict[str, list[Assumption]](list)
    sampled = {pair.name for pair in _sample(pairs)} if len(pairs) > 1 else set[str]()
    for group in alike(pairs):
        asked, bent = 0, list[Assumption]()
        looked = [pair for pair in group if pair.name in sampled] or [group[len(group) // 2]]
        every = -(-len(looked) // _OF_PLANES)
        for number, pair in enumerate(looked):
            try:
                picture = read(pair)
            except (ValueError, OSError, MemoryError):
                continue
            if number % every == 0:
                asked += 1
                bent += check_planes(picture, pair, reading)
            if picture.pose is not None:
                posed.add(pair.depth.parent)
            if pair.name in sampled:
                depth = picture.depth_lr[0].cpu().numpy()
                size = size or working_size(depth, picture.rgb)
                photo = photo_outlines(reduce_photo(picture.rgb, size), max(size) / max(depth.shape))
                compared.append((pair, depth_outlines(depth, size), photo))
        votes = Counter(warning.code for warning in bent)
        firsts = {warning.code: warning for warning in reversed(bent)}
        common = [firsts[code] for code, count in votes.items() if 2 * count >= asked]
        for pair in group:
            found[pair.name] += common
    in_order = _check_order(compared)
    for folder, recording in sequence.recordings.items():
        fault = sequence.fault(recording) if folder in posed or sequence.given else None
        for pair in recording:
            found[pair.name] += [*([] if fault is None else [fault]), *in_order]
    return {name: tuple(warnings) for name, warnings in found.items() if warnings}


def alike(pairs: Sequence[Pair]) -> Iterable[list[Pair]]:
    """Group frames by folder, in their order; one that is alone in its folder, with those of the folders beside it."""
    folders = Counter(pair.depth.parent for pair in pairs)
    groups: dict[Path, list[Pair]] = {}
    for pair in pairs:
        folder = pair.depth.parent
        groups.setdefault(folder if folders[folder] > 1 else folder.parent, []).append(pair)
    return groups.values()


def _sample(pairs: Sequence[Pair]) -> list[Pair]:
    """Return pairs at equal distances, each with the next one, the same from either end."""
    if len(pairs) <= _SAMPLE:
        return list(pairs)
    first = np.linspace(0, len(pairs) - 2, _SAMPLE // 2).round().astype(int)
    return [pairs[number] for number in np.unique((first, first + 1))]


def check_planes(picture: Picture, pair: Pair, reading: Reading) -> list[Assumption]:
    """Return a warning if the planes of a picture are flat only if its values are read in another way.

    What a capture's format or ``--range-type`` says is believed.
    """
    if pair.capture is not None or reading.range_type is not None or reading.rig is not None:
        return []
    height, width = picture.depth_lr.shape[-2:]
    depth, camera = thinned(picture.depth_lr[0].double().numpy(), picture.camera.rescale(width, height))
    falls, encoding = inverse_votes(depth), picture.encoding
    disparity = encoding.range_type == "disparity"
    if falls.verdict == "falls":
        given = "disparities rise with distance, as depth does"
        given = given if disparity else "values fall with distance, as disparities do"
        detail = f"straight over {falls.falling} of {falls.falling + falls.rising} planes; --range-type sets it"
        return [Assumption(given, detail, "falls-with-distance", falls.ratio)]
    step = 0.0  # to which values are rounded, as a fraction of their median
    if encoding.dtype == "float16":
        step = _HALF
    elif np.dtype(encoding.dtype).kind != "f" and not disparity:
        step = float(encoding.unit / np.nanmedian(depth))
    votes = range_votes(depth, camera, step)
    if votes.verdict not in ("ray", "reverse") or disparity:
        return []
    text, support, other = "depth looks like distance along the ray", votes.ray, "perspective"
    if votes.verdict == "reverse":
        text, support, other = "distances along the ray look like depth along the axis", votes.reverse, "orthogonal"
    detail = f"{support} of {votes.windows} planes are flat then, {votes.flat} now; --range-type {other}"
    return [Assumption(text, detail, "along-the-ray", support / votes.windows)]


def align(picture: Picture, *, register: bool) -> Picture:
    """Return a picture whose depth map is moved to the photo's edges, or else with a note that it should be."""
    if min(picture.depth_lr.shape[-2:]) < 2:
        return picture
    verdict = judge(picture.depth_lr[0].cpu().numpy(), picture.rgb)
    if verdict is not None and verdict.kind == "turned":  # no displacement is the cure
        return replace(picture, assumptions=(*picture.assumptions, *_doubts(verdict)))
    found = find_displacement(picture.depth_lr, picture.rgb)
    notes = [] if verdict is None or (found is not None and found.certain) else _doubts(verdict)
    if register:
        if found is not None and found.certain:
            done = Assumption("--register: the depth map is moved to the photo's edges", f"by {found}")
            picture = replace(picture, depth_lr=undo(picture.depth_lr, found))
        else:
            why = "there are not enough depth edges to compare" if found is None else "no displacement is certain"
            done = Assumption(f"--register: {why}, the depth map stays where it is")
        return replace(picture, assumptions=(*picture.assumptions, done, *notes))
    if found is not None and found.visible:
        sides = "to the right" if found.right > 0 else "to the left", "below" if found.down > 0 else "above"
        shifts = zip((abs(found.right), abs(found.down)), sides, strict=True)
        where = [f"{pixels:.1f} px {side}" for pixels, side in shifts if round(pixels, 1)]
        where += [f"at {found.scale:.3f} times the size"] if found.scale != 1 else []
        detail = f"{', '.join(where)}, in pixels of the depth map; --register moves the depth map"
        notes = [Assumption("the photo's edges lie beside the depth edges", detail, "edges-beside", found.moved)]
    return replace(picture, assumptions=(*picture.assumptions, *notes))


def _check_order(compared: Sequence[tuple[Pair, Outlines, Outlines]]) -> list[Assumption]:
    """Return a warning if depth maps fit the photos of other pairs better; the outlines are of depth and photo."""
    if len(compared) < 2:
        return []
    pairs, depths, photos = zip(*compared, strict=True)
    found = find_misplaced(significances(depths, photos))
    if len(found) < LIMITS["photo-order"]:
        return []
    text = f"of {len(pairs)} pairs {len(found)} fit another photo better: are the lists in the same order?"
    own, other = (pairs[number] for number in found[0])
    return [Assumption(text, f"such as {own.depth.name} with {other.rgb.name}", "photo-order", float(len(found)))]


def _doubts(verdict: Verdict) -> list[Assumption]:
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
