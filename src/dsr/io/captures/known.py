"""Missing files of a folder that resembles a capture of :data:`dsr.io.formats.FORMATS`, and a list of its contents."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

from dsr.io.formats import FORMATS
from dsr.io.pairs import has_name
from dsr.utils.guards import natural_key

_MOST_FILES = 100_000
"""Largest number of files that are counted."""
_KINDS = 6
"""Largest number of kinds of files that are named."""


def lacking(folder: Path) -> list[str]:
    """Return the layouts that a folder resembles, each with its missing files: ``like ScanNet, without depth/``."""
    return [
        f"like {each.name}, without {', '.join(missing)}"
        for each in FORMATS
        if _has(folder, each.marks)
        and (missing := [name for name, patterns in each.needs.items() if not _has(folder, patterns)])
    ]


def _has(folder: Path, patterns: tuple[str, ...]) -> bool:
    """Return whether a folder has a file or folder of one of several patterns."""
    for pattern in patterns:
        parent, name = folder / Path(pattern).parent, Path(pattern).name
        if (parent / name).exists() or ("*" in name and parent.is_dir() and has_name(parent, *name.split("*"))):
            return True
    return False


def describe_content(folder: Path, deep: int) -> str:
    """Describe a folder in one line: the numbers of its files by kind, and the layouts that it nearly matches.

    Args:
        folder: the folder.
        deep: levels of subfolders that are looked at.

    """
    kinds, near, count = Counter[str](), list[str](), 0
    for place, below, names in os.walk(folder):
        below[:] = sorted((name for name in below if not name.startswith(".")), key=natural_key)
        level = len(Path(place).relative_to(folder).parts)
        if level >= deep:
            below.clear()
        kinds.update(Path(name).suffix.lower() or "no suffix" for name in names if not name.startswith("."))
        near += [f"{text} in {Path(place).relative_to(folder)}" if level else text for text in lacking(Path(place))]
        count += len(names)
        if count > _MOST_FILES:
            break
    found = [f"{number} {kind}" for kind, number in kinds.most_common(_KINDS)]
    more = len(kinds) - len(found)
    text = f"the folder has {', '.join(found)}" + (f" and {more} more kinds" if more > 0 else "")
    near = list(dict.fromkeys(near))[:2]
    return (text if kinds else "the folder is empty") + "".join(f"; it looks {each}" for each in near)
