"""Data sets in their owners' formats, prepared: resized and cropped once, and kept in the cache.

What is kept is named by the content of the files, the settings, and the code that reads and resizes, so that whatever
changes makes it anew.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from dsr.data.base import SceneSelection, chosen
from dsr.data.preparation.inpainting import filled_depth
from dsr.data.preparation.resizing import fitted
from dsr.sample import Scene
from dsr.synthetic.rendering import Rendering, cache_directory, cached
from dsr.utils.hashing import file_hash, hash_of_code

_SMALLEST = 32
_READING_CODE = ("geometry/camera.py", "data/preparation", "data/formats")
_HASHED_WHOLE = 1 << 28
"""Bytes; of a larger file the name, the size and the time of its last change stand for the content."""


@dataclass(frozen=True)
class Record:
    """A scene on disk.

    Args:
        files: all that it is read from; a folder for all that is in it.
        load: reads it at its own size.
        frame: which part of the files it is, where they hold several scenes.
        settings: how the files are read.
        note: what somebody who reads its scores should know; empty for nothing.

    """

    files: tuple[Path, ...]
    load: Callable[[], Scene]
    frame: str = ""
    settings: str = ""
    note: str = ""


def records_of(
    frames: Mapping[str, tuple[Any, ...]], load: Callable[..., Scene], dataset: str, **settings: Any
) -> dict[str, Record]:
    """Return frames on disk as records, by their names with _ for /.

    Args:
        frames: the first arguments of ``load`` by name, as the readers in :mod:`dsr.data.formats` list them.
        load: reads a frame; called with these, the data set's and the scene's name, and ``settings``.
        dataset: name of the data set.
        settings: further arguments of ``load``.

    """
    records = {}
    for frame, arguments in frames.items():
        name = frame.replace("/", "_")
        files = tuple(path for path in arguments if isinstance(path, Path))
        which = json.dumps([each for each in arguments if not isinstance(each, Path)])
        read = functools.partial(load, *arguments, dataset, name, **settings)
        records[name] = Record(files, read, which, json.dumps(settings))
    return records


def _files_of(path: Path) -> list[Path]:
    """Return a file, or the files of a folder and those below it."""
    return [path] if not path.is_dir() else sorted(file for file in path.rglob("*") if file.is_file())


def renamed(records: Mapping[str, Record], names: Mapping[str, str]) -> dict[str, Record]:
    """Return records, some under other names.

    Args:
        records: by name.
        names: the frame on disk that each new name stands for, with / or _; those that are not there are left out.

    """
    frames = {name: frame.replace("/", "_") for name, frame in names.items()}
    chosen = {name: _named(records[frame], name) for name, frame in frames.items() if frame in records}
    taken = set(frames.values())
    return {**chosen, **{name: record for name, record in records.items() if name not in taken | chosen.keys()}}


def _named(record: Record, name: str) -> Record:
    """Return a record whose scene has another name."""
    return replace(record, load=lambda: replace(record.load(), name=name))


@dataclass(frozen=True)
class Preparation:
    """What is done to scenes after they are read.

    Args:
        size: of the shorter side in pixels; None for the scenes as they are.
        crop: where along the longer side a square window lies: 0 at the top or left, 1 at the bottom or right; None for
            no window.
        enlarge: whether smaller scenes are enlarged.
        fill: names of the scenes whose holes are filled; see :mod:`dsr.data.preparation.inpainting`.

    Raises:
        ValueError: a value is out of range.

    """

    size: int | None = 512
    crop: float | None = 0.5
    enlarge: bool = True
    fill: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        if self.size is not None and self.size < _SMALLEST:
            raise ValueError(f"size: expected at least {_SMALLEST} pixels, or null, got {self.size}")
        if self.crop is not None and not 0 <= self.crop <= 1:
            raise ValueError(f"crop: expected a number from 0 to 1, or null, got {self.crop}")

    def __call__(self, scene: Scene) -> Scene:
        """Return the scene prepared."""
        if self.size is not None:
            scene = fitted(scene, self.size, self.crop, enlarge=self.enlarge)
        if scene.name in self.fill and scene.depth is not None:
            scene = replace(scene, depth=filled_depth(scene.depth))
        return scene


class PreparedDataset:
    """A data set in its own format; the base of those in this package.

    Args:
        name: as in ``scores.csv``, and what ``dsr data get`` calls it.
        folder: where it was looked for.
        found: the scenes on disk.
        named: the scenes that belong to the data set.
        wanted: the scenes to use.
        preparation: what is done to them.

    Raises:
        ValueError: a scene is not on disk; the message says what to do.

    """

    evaluation = True

    def __init__(
        self,
        name: str,
        folder: Path,
        found: Mapping[str, Record],
        named: Sequence[str],
        wanted: SceneSelection,
        preparation: Preparation,
    ) -> None:
        self.name = name
        remedy = f"get it with: dsr data get {name}; or say where it is: dataset.root=DIR"
        if not found:
            there = "no scene of it" if folder.is_dir() else "no such directory"
            raise ValueError(f"dataset={name}: expected its files in {folder}, got {there}; {remedy}")
        if wanted is None:
            missing = [scene for scene in named if scene not in found]
            if missing:
                raise ValueError(
                    f"dataset={name}: expected {', '.join(missing)} in {folder}, got {len(named) - len(missing)} "
                    f"of {len(named)} scenes; {remedy}; or use what is there: dataset.scenes=found"
                )
            wanted = named
        self._scenes = chosen(list(found), wanted)
        unknown = [scene for scene in preparation.fill if scene not in (*named, *found)]
        if unknown:
            raise ValueError(f"fill: expected names of scenes, got {', '.join(unknown)}")
        self._found, self._preparation = found, preparation

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene; see :class:`dsr.data.base.SceneSource`."""
        record = self._found[scene]
        notes = (record.note,) if record.note else ()
        if self._preparation.size is None and scene not in self._preparation.fill:
            return replace(record.load(), notes=notes)
        prepared = cached(self._path(scene), lambda: _rendering(self._preparation(record.load())))
        return replace(prepared.scene(self.name, scene), notes=notes)

    def fingerprint(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files and of what is done to them."""
        plain = asdict(replace(self._preparation, fill=()))
        settings = json.dumps([self._found[scene].settings, scene in self._preparation.fill, plain])
        return hashlib.sha256(f"{settings}{self.content(scene)}".encode()).hexdigest()

    def content(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files, whatever is done to them."""
        record = self._found[scene]
        digest = hashlib.sha256(record.frame.encode())
        for path in record.files:
            for file in _files_of(path):
                digest.update(content_hash(file).encode())
        return digest.hexdigest()

    def prepare(self, scenes: Sequence[str]) -> Iterator[str]:
        """Prepare what the cache lacks of some scenes, several at a time, and yield the names as they are done.

        A scene that fails is yielded, too; loading it says why.
        """
        with ThreadPoolExecutor(min(len(scenes), os.cpu_count() or 1) or 1) as pool:
            ready = {scene: self._is_ready(scene) for scene in scenes}
            jobs = {pool.submit(self.load, scene): scene for scene in scenes if not ready[scene]}
            yield from (scene for scene in scenes if ready[scene])
            try:
                for job in as_completed(jobs):
                    yield jobs[job]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _is_ready(self, scene: str) -> bool:
        try:
            return self._preparation.size is None or (cache_directory() / self._path(scene)).is_file()
        except (OSError, ValueError):  # loading it says why
            return True

    def _path(self, scene: str) -> Path:
        key = hashlib.sha256((self.fingerprint(scene) + _rules_hash()).encode()).hexdigest()[:16]
        return Path("prepared", self.name, f"{scene.replace('/', '_')}-{key}.npz")


def listed(find: Callable[..., Mapping[str, tuple[Any, ...]]], folder: Path, *arguments: Any) -> Mapping[str, Any]:
    """Return what a reader finds in a directory; nothing where there is none."""
    return find(folder, *arguments) if folder.is_dir() else {}


@functools.lru_cache(maxsize=4096)
def _hash_of(path: Path, size: int, changed: int) -> str:
    if size > _HASHED_WHOLE:
        return f"{path.name} {size} {changed}"
    return file_hash(path)


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file; of a very large one, a text of its name, size and time of change.

    Raises:
        ValueError: there is no such file.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    status = path.stat()
    return _hash_of(path, status.st_size, status.st_mtime_ns)


@functools.cache
def _rules_hash() -> str:
    """Return a hash of the code that reads and resizes."""
    return hash_of_code(_READING_CODE)


def _rendering(scene: Scene) -> Rendering:
    """Return a scene as it is kept: its photo in 8 bits."""
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected a high-resolution depth map, there is none")
    photo = (scene.rgb * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    return Rendering(photo, scene.depth[0].double().numpy(), scene.camera)
