"""Names of files: whether one that a file gives stays within its folder, and their order, with numbers by value."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePath, PurePosixPath

_LONGEST = 100
"""Characters of a name that a message shows."""
_TURNS = re.compile("([0-9]+|/)")
NaturalKey = tuple[tuple[str | tuple[int, str], ...], str]
"""Texts and numbers of a name in turns, numbers as their number of digits and the digits, ``/`` as -1; and the name."""


class OutsideError(ValueError):
    """A name in a file leads out of the folder that it belongs to."""


def leads_outside(name: str) -> bool:
    """Return whether a name leads out of its folder on any system: absolute, with ``..``, of a drive, or with NUL."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or "\0" in name or re.match("[A-Za-z]:", name) is not None


def path_within(folder: Path, name: str, source: object, form: str = "{}") -> Path:
    """Return the path of a file that another file names, which has to lie in a folder or below it.

    The folder may be a link; links that the name leads through may not lead out of it.

    Args:
        folder: the folder.
        name: the name, from the folder on.
        source: what gives the name, such as ``FILE: line 3``, for the message.
        form: the path that the name is a part of, from the folder on, with ``{}`` for the name.

    Raises:
        OutsideError: the name leads out of the folder; the message begins with ``source``.

    """
    expected = f"{source}: expected a name within {folder}, got {name[:_LONGEST]!r}"
    if leads_outside(name):
        raise OutsideError(expected)
    path = folder / form.format(name)
    real = Path(os.path.realpath(path))  # unlike resolve, it takes loops
    if not real.is_relative_to(os.path.realpath(folder)):
        raise OutsideError(f"{expected}, a link to {real}; name the folder that has the files themselves, or copy them")
    return path


def natural_key(name: str | PurePath) -> NaturalKey:
    """Return a key that sorts names, or paths folder by folder, with the numbers in them by value: 2 before 10."""
    text = str(name).replace(os.sep, "/")
    parts: list[str | tuple[int, str]] = list(_TURNS.split(text))
    for place in range(1, len(parts), 2):
        digits = str(parts[place]).lstrip("0")
        parts[place] = (-1, "") if digits == "/" else (len(digits), digits)
    return tuple(parts), text
