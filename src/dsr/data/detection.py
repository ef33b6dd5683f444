"""Detection of the scenes in a directory of any layout that dsr reads.

A module of this package whose frames are detected has ``DETECTED``: for each kind of them, a function that finds their
files below a directory, by name, one that loads the scene of such files, and the name of the data set.
"""

import functools
import importlib
import itertools
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path

import dsr.data
from dsr.data import middlebury, nyu
from dsr.data.folder import load_scene
from dsr.sample import Scene
from dsr.utils.guards import natural_key

Loader = Callable[[], Scene]
_YEARS = {"view1.png": 2006, "im2.png": 2003, "im2.ppm": 2001}


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
    # the renderer of dsr.data.rendered, which has no files, takes half a second to import
    names = {module.name for module in pkgutil.iter_modules(dsr.data.__path__, "dsr.data.")} - {"dsr.data.rendered"}
    modules = map(importlib.import_module, sorted(names))
    for find, load, dataset in itertools.chain.from_iterable(getattr(each, "DETECTED", ()) for each in modules):
        for name, arguments in find(folder).items():
            if not any((path.parent / "camera.json").is_file() for path in arguments if isinstance(path, Path)):
                yield name, functools.partial(load, *arguments, dataset, name)


def _stereo(place: Path, *, itself: bool) -> Iterator[tuple[str, Loader]]:
    """Yield the Middlebury scenes directly below a folder, and the one that the folder is."""
    for name, record in middlebury.records_2014(place, "middlebury").items():
        yield name, record.load
    levels = middlebury.find_levels(place)
    if itself and (place / "calib.txt").is_file():
        yield place.name, functools.partial(middlebury.load_2014, place, "middlebury", place.name)
    if itself and any((place / photo).is_file() for photo in _YEARS):
        name = place.resolve().name.casefold()
        levels[name] = middlebury.find_levels(place.resolve().parent)[name]
    for name, files in levels.items():
        year = _YEARS.get(files.photo.name, 2005)
        yield name, functools.partial(middlebury.load_levels, files, f"middlebury{year}", name, year)
