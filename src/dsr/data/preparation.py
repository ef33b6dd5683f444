"""Data sets in their original formats, whose scenes are resized and cropped once and kept in the cache.

The name of a cached file contains a hash of the scene's files, the settings, and :data:`dsr.utils.versions.SCENES`. So
a change of any of them prepares the scene again.
"""

from __future__ import annotations

import contextlib
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

from dsr.data.reference_depth import fit, inpaint_depth
from dsr.data.scene_source import SceneSelection, SceneSource, select_scenes
from dsr.sample import Scene
from dsr.synthetic.rendering import Rendering, cache_directory, expect_room_for, load_or_render
from dsr.utils.progress import SILENT
from dsr.utils.versions import SCENES, file_hash

_MIN_SIZE = 32
_MAX_LISTED = 30
_MAX_HASHED = 1 << 28  # largest size in bytes of files whose content is hashed


Frames = Mapping[str, tuple[Any, ...]]  # arguments of a function that loads a frame, by the frame's name


@dataclass(frozen=True)
class SceneRecord:
    """A scene on disk."""

    files: tuple[Path, ...]  # that the scene is read from; a folder stands for all files in it
    load: Callable[[], Scene]  # at its original size
    frame: str = ""  # part of the files that holds the scene, where they hold several
    settings: str = ""  # how the files are read
    note: str = ""  # for readers of the scene's scores


def make_records(
    frames: Frames,
    load: Callable[..., Scene],
    dataset: str,
    note_of: Callable[..., str] = lambda *_: "",
    **settings: Any,
) -> dict[str, SceneRecord]:
    """Return the records of frames on disk, by their names with _ in place of /.

    ``load`` gets a frame's entry of ``frames``, the names of data set and scene, and ``settings``.
    """
    records = {}
    for frame, arguments in frames.items():
        name = frame.replace("/", "_")
        files = tuple(path for path in arguments if isinstance(path, Path))
        which = json.dumps([each for each in arguments if not isinstance(each, Path)])
        read = functools.partial(load, *arguments, dataset, name, **settings)
        records[name] = SceneRecord(files, read, which, json.dumps(settings), note_of(*arguments))
    return records


def rename_frames(frames: Frames, names: Mapping[str, str]) -> Frames:
    """Return the frames that are there of ``names``, new names with old ones, and then the others."""
    old = {frame.replace("/", "_"): files for frame, files in frames.items()}
    wanted = {name: frame.replace("/", "_") for name, frame in names.items()}
    new = {name: old[frame] for name, frame in wanted.items() if frame in old}
    replaced = new.keys() | set(wanted.values())
    return new | {frame: files for frame, files in old.items() if frame not in replaced}


@dataclass(frozen=True)
class Preparation:
    """Resizing, cropping and inpainting of scenes after they are read."""

    size: int | None = 512  # length of the shorter side in pixels; None for the original size
    crop: float | None = 0.5  # place of a square window along the longer side, 0 (top or left) to 1; None for no window
    enlarge: bool = True  # whether smaller scenes are enlarged
    fill: tuple[str, ...] = ()  # names of the scenes whose holes are inpainted

    def __post_init__(self) -> None:
        """Check the values."""
        if self.size is not None and self.size < _MIN_SIZE:
            raise ValueError(f"size: expected at least {_MIN_SIZE} pixels, or null, got {self.size}")
        expect_room_for(self.size or _MIN_SIZE)
        if self.crop is not None and not 0 <= self.crop <= 1:
            raise ValueError(f"crop: expected a number from 0 to 1, or null, got {self.crop}")

    def __call__(self, scene: Scene) -> Scene:
        """Return the scene prepared."""
        if self.size is not None:
            scene = fit(scene, self.size, self.crop, enlarge=self.enlarge)
        if scene.name in self.fill and scene.depth is not None:
            scene = replace(scene, depth=inpaint_depth(scene.depth))
        return scene


class PreparedDataset(SceneSource):
    """A data set in its original format; the base class of those in this package.

    Args:
        found: records of the scenes on disk.
        scenes: names of the scenes to use; None for those of ``named``, ``found`` for all that are on disk.
        named: names of the scenes that belong to the data set; None for all that are on disk.
        count: number of scenes that belong to the data set, if their names are not known.

    """

    evaluation = True

    def __init__(
        self,
        name: str,
        root: str,
        found: Mapping[str, SceneRecord],
        scenes: SceneSelection,
        named: Sequence[str] | None = None,
        preparation: Preparation | None = None,
        count: int | None = None,
    ) -> None:
        self.name, self._found, self._preparation = name, found, preparation or Preparation(None)
        folder, named = Path(root).expanduser(), tuple(found if named is None else named)
        remedy = f"get it with: dsr data get {name}; or say where it is: dataset.root=DIR"
        if not found:
            there = "no scene of it" if folder.is_dir() else "no such directory"
            raise ValueError(f"dataset={name}: expected its files in {folder}, got {there}; {remedy}")
        if scenes is None:
            missing, total = [scene for scene in named if scene not in found], count or len(named)
            if missing or len(named) < total:
                listed = ", ".join(missing[:_MAX_LISTED]) or "all scenes"
                rest = f" and {len(missing) - _MAX_LISTED} more" if len(missing) > _MAX_LISTED else ""
                raise ValueError(
                    f"dataset={name}: expected {listed}{rest} in {folder}, got {len(named) - len(missing)} of {total} "
                    f"scenes; {remedy}; or use what is there: dataset.scenes=found"
                )
            scenes = named
        self._scenes = select_scenes(list(found), scenes)
        unknown = [scene for scene in self._preparation.fill if scene not in (*named, *found)]
        if unknown:
            raise ValueError(f"fill: expected names of scenes, got {', '.join(unknown)}")

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene, prepared."""
        record = self._found[scene]
        notes = (record.note,) if record.note else ()
        if self._preparation.size is None and scene not in self._preparation.fill:
            return replace(record.load(), notes=notes)
        prepared = load_or_render(self._path(scene), lambda: _rendering(self._preparation(record.load())))
        return replace(prepared.scene(self.name, scene), notes=notes)

    def fingerprint(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files and of the settings that they are read and prepared with."""
        plain = asdict(self._preparation) | {"fill": ()}
        settings = json.dumps([self._found[scene].settings, scene in self._preparation.fill, plain])
        return hashlib.sha256(f"{settings}{self.content(scene)}".encode()).hexdigest()

    def content(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files alone."""
        record = self._found[scene]
        digest = hashlib.sha256(record.frame.encode())
        for path in record.files:
            files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
            for file in files:
                digest.update(content_hash(file).encode())
        return digest.hexdigest()

    def prepare(self, scenes: Sequence[str], _: Callable[[str], None] = SILENT.say) -> Iterator[str]:
        """Prepare scenes that are not in the cache, several at a time, and yield the name of each that is ready.

        The name of a scene that fails is yielded, too; loading the scene raises the error.
        """
        with ThreadPoolExecutor(min(len(scenes), os.cpu_count() or 1) or 1) as pool:
            missing = []
            for scene in scenes if self._preparation.size is not None else ():
                with contextlib.suppress(OSError, ValueError):  # loading the scene raises it again
                    if not (cache_directory() / self._path(scene)).is_file():
                        missing.append(scene)
            jobs = {pool.submit(self.load, scene): scene for scene in missing}
            yield from (scene for scene in scenes if scene not in missing)
            try:
                for job in as_completed(jobs):
                    yield jobs[job]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _path(self, scene: str) -> Path:
        key = hashlib.sha256(f"{self.fingerprint(scene)}{SCENES}".encode()).hexdigest()[:16]
        return Path("prepared", self.name, f"{scene.replace('/', '_')}-{key}.npz")


class FrameSet(PreparedDataset):
    """A data set of which one function finds the frames in a directory, and another one loads them."""

    note = ""  # for readers of the scores

    def __init__(
        self,
        name: str,
        root: str,
        find: Callable[[Path], Frames],
        load: Callable[..., Scene],
        scenes: SceneSelection,
        named: Sequence[str] | None = None,
        preparation: Preparation | None = None,
        count: int | None = None,
        **settings: Any,
    ) -> None:
        found = make_records(find(Path(root).expanduser()), load, name, self.note_of, **settings)
        super().__init__(name, root, found, scenes, named, preparation, count)

    def note_of(self, *_: Any) -> str:
        """Return what readers of a frame's scores are to know, by its files."""
        return self.note


def content_hash(path: Path) -> str:
    """Return the SHA-256 of a file; of a file above 256 MiB, its name, size and time of the last change."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    status = path.stat()
    if status.st_size > _MAX_HASHED:
        return f"{path.name} {status.st_size} {status.st_mtime_ns}"
    return _hash_of(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _hash_of(path: Path, _size: int, _changed: int) -> str:
    return file_hash(path)


def _rendering(scene: Scene) -> Rendering:
    """Return a scene as it is cached, with its rgb in 8 bits."""
    if scene.depth is None:
        raise ValueError(f"{scene.name}: expected a high-resolution depth map, there is none")
    photo = (scene.rgb * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    return Rendering(photo, scene.depth[0].double().numpy(), scene.camera)
