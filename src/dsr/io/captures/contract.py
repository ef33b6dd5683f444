"""What a reader of captures provides: one :class:`Capture`, which :mod:`dsr.io.captures` lists."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dsr.utils.guards import natural_key, opened

if TYPE_CHECKING:
    from dsr.io.pairs import PairingResult

_HEAD = 1 << 20  # bytes at the beginning of a file in which its mark is


@dataclass(frozen=True)
class Capture:
    """What is read of a device, program or data set, and what reads it."""

    name: str
    export: str  # what to export, or what its files are called
    found_by: str  # what it is recognised by
    read: str  # depth, and which of intrinsics, poses, confidence, distortion and time
    tried: str = ""  # the files that it was tried with: real ones, or ones that an independent program wrote
    faults: str = ""  # of the sensor; empty where any sensor may have been used
    source: str = ""  # address of the writer's own description or code
    of_folder: Callable[[Path], PairingResult | None] = lambda _: None  # the frames; None of another folder
    of_file: Callable[[Path], PairingResult] | None = None  # the frames of a file with one of the suffixes
    suffixes: tuple[str, ...] = ()  # in lower case, of captures that are a single file; a folder may have several
    mark: Callable[[Path], bool] = lambda _: True  # tells such a file from others of its suffix
    fallback: bool = False  # whether a folder is asked only if its files make no pairs
    marks: tuple[str, ...] = ()  # patterns of paths in its folder, any of which distinguishes it; * in the last part
    needs: tuple[str, ...] = ()  # patterns of its parts, "A or B"; a user is told which are missing beside a mark

    def frames(self, place: Path) -> PairingResult | None:
        """Return the frames of a file, of a folder, or of the files in a folder; None if it is another capture."""
        of_file = self.of_file
        if place.is_file():
            if of_file is None or place.suffix.lower() not in self.suffixes:
                return None
            if self.mark(place):
                return of_file(place)
            if self.fallback:
                return None
            raise ValueError(f"{place}: expected {self.name}, got another {place.suffix} file")
        found = self.of_folder(place)
        if found is not None or of_file is None:
            return found
        files = [path for path in place.iterdir() if path.suffix.lower() in self.suffixes and path.is_file()]
        if not files:
            return None
        from dsr.io.pairs import join  # noqa: PLC0415 - torch takes seconds to import, and the table needs none

        files = sorted(filter(self.mark, files), key=natural_key)
        last = {path.stem: path for path in files}  # of a.JPG and a.jpg, the first is named with its suffix
        parts = {path.stem if path == last[path.stem] else path.name: of_file(path) for path in files}
        return join(parts) if parts else None

    def rows(self) -> dict[str, str]:
        """Return the description, text by label, the name first; empty texts are left out."""
        texts = {"": self.name, "export": self.export, "found by": self.found_by, "read": self.read,
                 "tried": self.tried, "sensor": self.faults, "source": self.source}  # fmt: skip
        return {label: text.replace("`", "") for label, text in texts.items() if text}

    def __str__(self) -> str:
        return "\n".join(f"  {label:9}{text}" if label else text for label, text in self.rows().items())


def in_head(pattern: bytes, path: Path) -> bool:
    """Return whether a pattern is in the first megabyte of a file."""
    with opened(path) as file:
        return re.search(pattern, file.read(_HEAD)) is not None


def has_name(folder: Path, first: str, last: str) -> bool:
    """Return whether a file or folder in a folder has a name that begins and ends so."""
    with os.scandir(folder) as entries:  # a folder may have a million
        return any(entry.name.startswith(first) and entry.name.endswith(last) for entry in entries)


def has_any(folder: Path, patterns: Iterable[str]) -> bool:
    """Return whether a folder has a file or folder of one of several patterns."""
    for pattern in patterns:
        parent, name = folder / Path(pattern).parent, Path(pattern).name
        if (parent / name).exists() or ("*" in name and parent.is_dir() and has_name(parent, *name.split("*"))):
            return True
    return False
