"""Detection of the scenes in a directory of any layout that dsr reads."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from dsr.data import (
    arkitscenes,
    cleargrasp,
    ddrnet_frames,
    eight_bit,
    hammer,
    ibims,
    icl,
    middlebury,
    nyu,
    rgbdd,
    sintel,
    stereo_board,
    sunrgbd,
    tartanair,
    tofmark,
)
from dsr.data.download.collections import CATALOGUE
from dsr.data.folder import load_scene
from dsr.data.frame_files import load_pair
from dsr.sample import Scene
from dsr.utils.guards import natural_key
from dsr.utils.versions import file_hash

Loader = Callable[[], Scene]
_YEARS = {"view1.png": 2006, "im2.png": 2003, "im2.ppm": 2001}


def _boards(folder: Path) -> dict[str, tuple[Path, Path, str]]:
    """Return the frames of ``stereo_board`` by their checksums: recordings of others have files of the same names."""
    pinned = {item.sha256 for item in CATALOGUE["stereo_board"].items}
    return {name: files for name, files in stereo_board.find_frames(folder).items() if file_hash(files[0]) in pinned}


_FRAMES: tuple[tuple[Callable[[Path], Mapping[str, tuple[Any, ...]]], Callable[..., Scene], str], ...] = (
    (icl.find_frames, icl.load_frame, "icl"),
    (sunrgbd.find_frames, sunrgbd.load_frame, "sunrgbd"),
    (tartanair.find_frames, tartanair.load_frame, "tartanair"),
    (sintel.find_frames, sintel.load_frame, "sintel"),
    (tofmark.find_frames, tofmark.load_frame, "tofmark"),
    (ddrnet_frames.find_frames, ddrnet_frames.load_frame, "ddrnet"),
    (rgbdd.find_frames, load_pair, "rgbdd"),
    (nyu.find_files, nyu.load_files, "nyu"),
    (arkitscenes.find_frames, arkitscenes.load_frame, "arkitscenes"),
    (cleargrasp.find_captures, cleargrasp.load_capture, "cleargrasp"),
    (cleargrasp.find_renderings, cleargrasp.load_rendering, "cleargrasp_synthetic"),
    (ibims.find_pictures, ibims.load_pictures, "ibims"),
    (hammer.find_frames, hammer.load_frame, "hammer"),
    (_boards, stereo_board.load_frame, "stereo_board"),
    *(
        (functools.partial(eight_bit.find_frames, dataset=benchmark), eight_bit.load_frame, benchmark)
        for benchmark in eight_bit.BENCHMARKS
    ),
)


def find_scenes(folder: Path) -> Iterator[tuple[str, Loader]]:
    """Yield the name and the loader of each scene in a directory, or of the scene that the directory is."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a directory, there is none")
    below = (path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    for place in (folder, *sorted(below, key=natural_key)):
        if (place / "camera.json").is_file():
            yield place.name, functools.partial(load_scene, place, "folder")
        yield from _stereo(place, itself=place == folder)
        labelled = place / "nyu_depth_v2_labeled.mat"
        if labelled.is_file():
            for name, arguments in itertools.islice(nyu.find_frames(labelled).items(), 0, None, 100):
                yield name, functools.partial(nyu.load_frame, *arguments, "nyu", name)
    for find, load, dataset in _FRAMES:
        for name, arguments in find(folder).items():
            if not any((path.parent / "camera.json").is_file() for path in arguments if isinstance(path, Path)):
                yield name, functools.partial(load, *arguments, dataset, name)


def _stereo(place: Path, *, itself: bool) -> Iterator[tuple[str, Loader]]:
    """Yield the Middlebury scenes directly below a folder, and the one that the folder is."""
    for name, scene in middlebury.find_2014(place).items():
        yield name, functools.partial(middlebury.load_2014, scene, "middlebury", name)
    for name, files in middlebury.find_levels(place).items():
        yield name, _levels(name, files)
    if itself and (place / "calib.txt").is_file():
        yield place.name, functools.partial(middlebury.load_2014, place, "middlebury", place.name)
    if itself and any((place / photo).is_file() for photo in _YEARS):
        name = place.resolve().name.casefold()
        yield name, _levels(name, middlebury.find_levels(place.resolve().parent)[name])


def _levels(name: str, files: middlebury.Files) -> Loader:
    year = _YEARS.get(files.photo.name, 2005)
    return functools.partial(middlebury.load_levels, files, f"middlebury{year}", name, year)
