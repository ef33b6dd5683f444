"""What a reader of captures provides: one :class:`Capture`, which :mod:`dsr.io.captures.registry` lists."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from dsr.io.frames import CaptureFrame, Source
from dsr.io.pairs import Pair, PairingResult, has_name, match_times
from dsr.utils.guards import naming, natural_key

LIDAR = "bent edges, nothing thin"
KINECT1 = "stairs far away, smeared edges, shadows beside near things"
STEREO = "blobs, guesses on blank walls, wrong depth on glass"


@dataclass(frozen=True)
class Capture:
    """What is read of a device, program or data set, and what reads it.

    Args:
        name: of the device, program or data set.
        export: what to export, or what its files are called.
        found_by: what it is recognised by.
        read: depth, and which of intrinsics, poses, confidence, distortion and time.
        tried: the files that it was tried with: real ones, or ones that an independent program wrote.
        faults: of the sensor; empty where any sensor may have been used.
        source: address of the writer's own description or code.
        of_folder: returns the frames of a folder; None if it is another one.
        of_file: returns the frames of a file with one of the ``suffixes``.
        suffixes: of captures that are a single file, in lower case; a folder may have several of them.
        is_ours: whether a file in a folder is such a capture, not another one of its suffix.
        marks: patterns of paths below its folder, any of which distinguishes it from others; ``*`` in the last part
            stands for anything. Empty for single files, and for layouts without characteristic names.
        needs: names of its parts, each with patterns of which one has to match; those that do not are named to the user
            of a folder that has a mark.

    """

    name: str
    export: str
    found_by: str
    read: str
    tried: str = ""
    faults: str = ""
    source: str = ""
    of_folder: Callable[[Path], PairingResult | None] = lambda _: None
    of_file: Callable[[Path], PairingResult] | None = None
    suffixes: tuple[str, ...] = ()
    is_ours: Callable[[Path], bool] = lambda _: True
    marks: tuple[str, ...] = ()
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def frames(self, place: Path) -> PairingResult | None:
        """Return the frames of a file, of a folder, or of the files in a folder; None if it is another capture."""
        of_file = self.of_file
        if place.is_file():
            return of_file(place) if of_file is not None and place.suffix.lower() in self.suffixes else None
        found = self.of_folder(place)
        if found is not None or of_file is None:
            return found
        files = [path for path in place.iterdir() if path.suffix.lower() in self.suffixes and path.is_file()]
        files = sorted(filter(self.is_ours, files), key=natural_key)
        return join({path.stem: of_file(path) for path in files}) if files else None

    def lacks(self, folder: Path) -> list[str]:
        """Return the missing parts of a folder that looks like this capture; nothing if it does not."""
        if not _has(folder, self.marks):
            return []
        return [name for name, patterns in self.needs.items() if not _has(folder, patterns)]

    def rows(self) -> dict[str, str]:
        """Return the description, text by label, the name first; empty texts are left out."""
        texts = {"": self.name, "export": self.export, "found by": self.found_by, "read": self.read,
                 "tried": self.tried, "sensor": self.faults, "source": self.source}  # fmt: skip
        return {label: text.replace("`", "") for label, text in texts.items() if text}

    def __str__(self) -> str:
        return "\n".join(f"  {label:9}{text}" if label else text for label, text in self.rows().items())


class Shot(NamedTuple):
    """A photo or a depth map of a recording: the place that messages name, where it is, and when it was taken."""

    place: Path
    source: Source
    seconds: float


def pair_by_time(photos: Sequence[Shot], depths: Sequence[Shot], frame: CaptureFrame, unit: float) -> PairingResult:
    """Return the frames of a recording, named by the numbers of their photos; ``frame`` is what all have in common."""
    with naming(frame.description):
        partner = match_times(*([shot.seconds for shot in each] for each in (photos, depths)))
    if not partner:
        raise ValueError(f"{frame.description}: expected photos and depth maps within 20 ms of each other, found none")
    pairs = []
    for first, second in partner:
        photo, depth = photos[first], depths[second]
        own = replace(frame, photo=photo.source, depth=depth.source)
        pairs.append(Pair(f"{first:06}", photo.place, depth.place, unit=unit, capture=own, time=photo.seconds))
    used = [{place for place, _ in partner}, {place for _, place in partner}]
    lone = [shot.place for shots, known in zip((photos, depths), used, strict=True)
            for place, shot in enumerate(shots) if place not in known]  # fmt: skip
    return PairingResult(tuple(pairs), (), tuple(lone))


def join(parts: Mapping[str, PairingResult]) -> PairingResult:
    """Return the frames of several recordings, whose names begin with that of the recording, and each note once."""
    pairs: list[Pair] = []
    for stem, part in parts.items():
        pairs += (replace(pair, name=stem if pair.name == stem else f"{stem}/{pair.name}") for pair in part.pairs)
    notes = dict.fromkeys(note for part in parts.values() for note in part.assumptions)
    return PairingResult(tuple(pairs), tuple(notes), tuple(path for part in parts.values() for path in part.unpaired))


def _has(folder: Path, patterns: Iterable[str]) -> bool:
    """Return whether a folder has a file or folder of one of several patterns."""
    for pattern in patterns:
        parent, name = folder / Path(pattern).parent, Path(pattern).name
        if (parent / name).exists() or ("*" in name and parent.is_dir() and has_name(parent, *name.split("*"))):
            return True
    return False
