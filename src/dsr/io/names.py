"""Information in file names: whether a file is a photo or a depth map, of which frame, and when it was taken."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from dsr.io.depth_files import READ_SUFFIXES
from dsr.utils.paths import natural_key

Role = Literal["rgb", "depth", "other"]
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm")
_DEPTH_ONLY = (".npy", ".npz", ".pfm", ".exr", ".depth")
_RGB_WORDS = frozenset({"rgb", "color", "colour", "image", "images", "img", "imgs", "photo", "photos", "picture"})
_DEPTH_WORDS = frozenset({"depth", "depths", "depthmap", "disparity", "disp", "range"})
_OTHER_WORDS = frozenset(
    {"mask", "masks", "confidence", "conf", "ir", "infrared", "normal", "normals", "label", "labels"}
)
_CONFIDENCE_WORDS = frozenset({"confidence", "conf"})
_FILLERS = frozenset({"raw", "aligned", "registered", "map", "to", "frame", "in"})
_SECONDS_BY_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}
"""Times since 1970 as whole seconds, milli-, micro- and nanoseconds."""
_MAX_GAP = 0.02
"""Largest time in seconds between the two pictures of a pair."""


def words_of(name: str) -> list[str]:
    """Return the words and numbers of a name, in lower case, numbers without leading zeros."""
    split = re.findall(r"[a-z]+|[A-Z]+(?![a-z])|[A-Z][a-z]+|\d+|[^\W\d_A-Za-z]+", name)
    return [word.lstrip("0") or "0" if word.isdigit() else word.lower() for word in split]


def role_of(path: Path) -> Role:
    """Return the role of a file by its suffix and the words of its name, ``rgb`` where they say nothing."""
    suffix = path.suffix.lower()
    found = role_of_words(words_of(path.stem))
    if found == "other" or suffix not in (*PHOTO_SUFFIXES, *READ_SUFFIXES):
        return "other"
    if suffix in _DEPTH_ONLY:
        return "depth"
    return "rgb" if found is None else found


def role_of_words(words: Iterable[str]) -> Role | None:
    """Return the role that words name, None where they name none."""
    words = set(words)
    if words & _OTHER_WORDS:
        return "other"
    if words & _DEPTH_WORDS:
        return "depth"
    return "rgb" if words & _RGB_WORDS else None


def key_of(path: Path) -> tuple[str, ...]:
    """Return the words of a name without those that say its role, which are equal for the two files of a pair."""
    words = words_of(path.stem)
    return tuple(word for word in words if word not in _RGB_WORDS | _DEPTH_WORDS | _FILLERS)


def confidence_key(path: Path) -> tuple[str, ...]:
    """Return the key of the depth map that a confidence map belongs to, see :func:`key_of`."""
    return tuple(word for word in key_of(path) if word not in _CONFIDENCE_WORDS)


def time_of(path: Path) -> float | None:
    """Return the time in seconds in a name such as 1305031102.175304; None if there is none."""
    numbers = re.findall(r"\d+(?:\.\d+)?", path.stem)
    numbers = [number for number in numbers if len(number.split(".")[0]) in _SECONDS_BY_DIGITS]
    if len(numbers) != 1:
        return None
    return float(numbers[0]) * _SECONDS_BY_DIGITS[len(numbers[0].split(".")[0])]


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return files in the order of the times in their names, if all have one, else of the names, numbers by value."""
    times = {path: time_of(path) for path in paths}
    named = sorted(times, key=natural_key)
    return named if None in times.values() else sorted(named, key=lambda path: times[path] or 0.0)


def match_names(photos: Iterable[Path], depths: Iterable[Path]) -> list[tuple[Path, Path]]:
    """Return the pairs among photos and depth maps, in the photos' order.

    A pair has the same name but for words such as color and depth and for leading zeros; where a name is a time, the
    nearest within 20 ms that no other pair takes. A single photo and a single depth map are a pair whatever they are
    called.
    """
    photos, depths = in_order(photos), in_order(depths)
    if len(photos) == len(depths) == 1:
        return [(photos[0], depths[0])]
    by_key: dict[tuple[str, ...], list[Path]] = {}
    for path in depths:
        by_key.setdefault(key_of(path), []).append(path)
    partner = {path: by_key[key_of(path)].pop(0) for path in photos if by_key.get(key_of(path))}
    left = set(depths) - set(partner.values())
    partner |= match_times(
        {path: time for path in photos if path not in partner and (time := time_of(path)) is not None},
        {path: time for path in left if (time := time_of(path)) is not None},
    )
    return [(path, partner[path]) for path in photos if path in partner]


def match_times(photos: dict[Path, float], depths: dict[Path, float]) -> dict[Path, Path]:
    """Return which depth map was taken with which photo: the nearest first, each used once, within 20 ms."""
    order = sorted(depths, key=depths.__getitem__)
    candidates, first = [], 0
    for path in sorted(photos, key=photos.__getitem__):
        while first < len(order) and depths[order[first]] < photos[path] - _MAX_GAP:
            first += 1
        for other in order[first:]:
            gap = depths[other] - photos[path]
            if gap > _MAX_GAP:
                break
            candidates.append((abs(gap), path, other))
    partner: dict[Path, Path] = {}
    taken: set[Path] = set()
    for _, path, other in sorted(candidates):
        if path not in partner and other not in taken:
            partner[path] = other
            taken.add(other)
    return partner
