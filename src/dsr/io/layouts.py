"""Finding pairs of photo and depth map in folders as recorders, data sets and people lay them out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dsr.data.formats.files import read_pixels
from dsr.io.depth_files import DEPTH_SUFFIXES
from dsr.io.encoding import Assumption
from dsr.io.names import match_times, role_of, role_of_words, words_of
from dsr.io.pairs import Pair, PairingResult, camera_beside, matched, named_apart, pairs_of_two_folders, pictures_in

_COARSE = re.compile(r"(depth|disparity)_lr(\d+)")
_TUM_UNIT = 1 / 5000
_DEEPEST = 3
"""Folders below the one given that are looked through."""


def pairs_of_folder(folder: Path, leave: Path | None = None) -> PairingResult:
    """Return the pairs in a folder of any layout, or in the folders in it.

    Known are: a scene of dsr (``rgb.png``, ``camera.json`` and ``depth*`` or ``disparity*``); lists of TUM RGB-D
    (``rgb.txt`` and ``depth.txt``, https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats); two folders named
    for photos and depth maps; and files side by side, told apart by their names or by what they hold.

    Args:
        folder: the folder.
        leave: a folder that is not looked into, as that of the results.

    Raises:
        ValueError: there is no such folder, or no pair in it.

    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of photos and depth maps, there is none")
    found = _search(folder, folder, None if leave is None else leave.resolve(), 0)
    if not found.pairs:
        alone = f"; {len(found.alone)} pictures have no partner" if found.alone else ""
        raise ValueError(f"{folder}: expected photos and depth maps that belong together, found no pair{alone}")
    return PairingResult(named_apart(found.pairs), found.facts, found.alone)


def _search(folder: Path, root: Path, leave: Path | None, depth: int) -> PairingResult:
    """Return the pairs in a folder, else those of the folders in it together."""
    for layout in (_scene, _tum, _role_folders, _side_by_side):
        found = layout(folder)
        if found.pairs:
            camera = camera_beside(folder, root)
            return replace(found, pairs=tuple(replace(pair, camera=pair.camera or camera) for pair in found.pairs))
    deeper = [
        (path, _search(path, root, leave, depth + 1))
        for path in sorted(folder.iterdir())
        if depth < _DEEPEST and path.is_dir() and not path.name.startswith(".") and path.resolve() != leave
    ]
    pairs = [
        replace(pair, name=path.name if pair.name in ("rgb", path.name) else f"{path.name}/{pair.name}")
        for path, below in deeper
        for pair in below.pairs
    ]
    facts = tuple(dict.fromkeys(fact for _, below in deeper for fact in below.facts))
    alone = (*found.alone, *(path for _, below in deeper for path in below.alone))
    return PairingResult(tuple(pairs), facts, alone)


def _scene(folder: Path) -> PairingResult:
    """Return the pair of dsr's own layout: its LR map, the finest of several, else the HR one."""
    photo = next((folder / name for name in ("rgb.png", "rgb.jpg", "rgb.jpeg") if (folder / name).is_file()), None)
    if photo is None or not (folder / "camera.json").is_file():
        return PairingResult(())
    maps = sorted(path for path in folder.iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    coarse = {path: int(match[2]) for path in maps if (match := _COARSE.fullmatch(path.stem)) and int(match[2]) > 0}
    camera = folder / "camera.json"
    if coarse:
        path = min(coarse, key=coarse.__getitem__)
        return PairingResult((Pair(folder.name, photo, path, camera, None, None, coarse[path]),))
    fine = [path for path in maps if path.stem in ("depth", "disparity")]
    mask = folder / "mask.png"
    pairs = [Pair(folder.name, photo, path, camera, mask if mask.is_file() else None) for path in fine[:1]]
    return PairingResult(tuple(pairs))


def _tum(folder: Path) -> PairingResult:
    """Return the pairs of TUM's lists of times and files."""
    lists = folder / "rgb.txt", folder / "depth.txt"
    if not all(path.is_file() for path in lists):
        return PairingResult(())
    photos, depths = (_timed(path) for path in lists)
    partner = match_times(photos, depths)
    pairs = tuple(Pair(path.stem, path, partner[path], unit=_TUM_UNIT) for path in photos if path in partner)
    alone = [path for path in (*photos, *depths) if path not in partner and path not in partner.values()]
    return PairingResult(pairs, (Assumption("rgb.txt and depth.txt of TUM RGB-D: depth in 1/5000 m"),), tuple(alone))


def _timed(path: Path) -> dict[Path, float]:
    """Return the files that a list of TUM names, and their times."""
    times: dict[Path, float] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            times[path.parent / words[1]] = float(words[0])
        except (IndexError, ValueError) as error:
            raise ValueError(f"{path}: line {number}: expected a time and a file name, got {line!r:.60}") from error
    return times


def _role_folders(folder: Path) -> PairingResult:
    """Return the pairs of two folders in a folder that are named for photos and for depth maps."""
    named: dict[str, list[Path]] = {"rgb": [], "depth": [], "other": []}
    for path in sorted(folder.iterdir(), key=lambda path: (len(path.name), path.name)):
        role = role_of_words(words_of(path.name)) if path.is_dir() else None
        if role is not None and pictures_in(path):
            named[role].append(path)
    if not named["rgb"] or not named["depth"]:
        return PairingResult(())
    found = pairs_of_two_folders(named["rgb"][0], named["depth"][0], ())
    extra = [path.name for paths in (named["rgb"], named["depth"]) for path in paths[1:]]
    text = f"folders {named['rgb'][0].name} and {named['depth'][0].name}"
    fact = Assumption(text + (f"; not looked at: {', '.join(extra)}" if extra else ""))
    return replace(found, facts=(fact, *found.facts))


def _side_by_side(folder: Path) -> PairingResult:
    """Return the pairs among the files of a folder."""
    roles = {path: role_of(path) for path in pictures_in(folder)}
    photos = [path for path, role in roles.items() if role == "rgb"]
    if "depth" not in roles.values():  # the names do not tell: a depth map has one channel of 16 bits or floats
        depths = [path for path in photos if path.suffix.lower() in DEPTH_SUFFIXES and _looks_like_depth(path)]
        photos = [path for path in photos if path not in depths]
    else:
        depths = [path for path, role in roles.items() if role == "depth"]
    return matched(photos, depths)


def _looks_like_depth(path: Path) -> bool:
    """Return whether a picture has one channel of more than 8 bits."""
    try:
        pixels = read_pixels(path, cv2.IMREAD_UNCHANGED)
    except ValueError:
        return False
    return pixels.ndim == 2 and pixels.dtype != np.uint8
