"""The frames that ``dsr upsample`` works on: all, or a shard."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from dsr.app.upsample.request import FrameChoice, UpsampleRequest
from dsr.io.captures.colmap import add_model
from dsr.io.inputs import FolderUnits
from dsr.io.layouts import NoPairError, find_pairs_of_folder
from dsr.io.pairs import (
    Pair,
    PairingResult,
    Role,
    add_confidence,
    find_pairs_of_lists,
    in_order,
    role_of,
    role_of_words,
    words_of,
)
from dsr.notes import Assumption
from dsr.utils.guards import path_within


@dataclass(frozen=True)
class Frames:
    """Frames to work on, and what they depend on."""

    found: PairingResult  # the frames to work on, and notes on them
    whole: tuple[Pair, ...]  # all frames that were found; poses, neighbours and units depend on them
    single: bool  # whether there is a single picture, whose results are in the output folder itself
    units: FolderUnits  # units and range types, identified from the values of all of them
    # of :mod:`dsr.app.upsample.checks`, which looks at several frames, by the name of each frame
    warnings: Mapping[str, tuple[Assumption, ...]] = field(default_factory=dict)

    def target(self, output: Path, pair: Pair) -> Path:
        """Return the folder of a frame's results; OutsideError if a link leads it out of that of all."""
        return output if self.single else path_within(output, pair.name, output)


def find_frames(request: UpsampleRequest) -> Frames:
    """Return the frames of a request; a ValueError if there are none."""
    choice = request.frames
    found = _search(choice, request.results.output)
    if choice.confidence:
        found = replace(found, pairs=add_confidence(found.pairs, choice.confidence))
    if choice.rgb:
        found = replace(found, pairs=_by_number(found.pairs))
    if choice.model is not None:
        found = add_model(found, choice.model)
        if not any(pair.capture is not None and pair.capture.description == choice.model for pair in found.pairs):
            raise ValueError(f"{choice.model}: expected images named as the photos, such as {found.pairs[0].rgb.name}")
    whole = found.pairs
    single = len(whole) == 1 and not choice.folders and not choice.rgb[0].is_dir()
    if choice.shard is not None:
        found = replace(found, pairs=tuple(whole[number] for number in choice.shard.block(len(whole))))
    return Frames(found, whole, single, FolderUnits(whole))


def _by_number(pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    """Return pairs whose photos come as a shell lists them, 1 10 2, in the order of their numbers; others as given."""
    photos = [pair.rgb for pair in pairs]
    if photos != sorted(photos, key=str):
        return pairs
    ranks = {photo: rank for rank, photo in enumerate(in_order(photos))}
    return tuple(sorted(pairs, key=lambda pair: ranks[pair.rgb]))


def _search(choice: FrameChoice, output: Path) -> PairingResult:
    """Return the pairs in the user's files and folders."""
    if not choice.folders:
        return find_pairs_of_lists(choice.rgb, choice.depth, choice.mask)
    try:
        parts = [find_pairs_of_folder(folder, output) for folder in choice.folders]
    except NoPairError as error:
        _expect_both(choice.folders, error)
        raise
    if len(parts) == 1:
        return parts[0]
    pairs = [
        replace(pair, name=f"{folder.resolve().name}/{pair.name}")
        for folder, part in zip(choice.folders, parts, strict=True)
        for pair in part.pairs
    ]
    if len({pair.name for pair in pairs}) < len(pairs):
        raise ValueError("expected folders of different names; give those of one name in commands of their own")
    facts = tuple(dict.fromkeys(fact for part in parts for fact in part.assumptions))
    return PairingResult(tuple(pairs), facts, tuple(path for part in parts for path in part.unpaired))


def _expect_both(places: tuple[Path, ...], error: NoPairError) -> None:
    """Say how photos and depth maps are named that came as two folders or files, where their names say so."""
    roles = {path: _role(path) for path in places if path.exists()}
    rgb, depth = ([path for path, role in roles.items() if role == wanted] for wanted in ("rgb", "depth"))
    if len(places) == 2 and len(rgb) == len(depth) == 1:
        raise ValueError(
            f"{places[0]} and {places[1]}: expected folders that hold both; photos and depth maps apart are given as "
            f"--rgb {rgb[0]} --depth {depth[0]}"
        ) from error


def _role(path: Path) -> Role | None:
    """Return the role that a folder's name says, or a file's, or that of its folder; None where they say nothing."""
    path = path.resolve()
    if not path.is_file():
        return role_of_words(words_of(path.name))
    role = role_of(path)  # "rgb" of a name that says nothing
    return role_of_words(words_of(path.stem)) or _role(path.parent) if role == "rgb" else role
