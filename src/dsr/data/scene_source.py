"""The base classes of data sets: scenes by name, resized and cropped once and kept in the cache.

The name of a cached file contains a hash of the scene's files, the settings, and :data:`dsr.utils.versions.SCENES`. So
a change of any of them prepares the scene again.
"""

import contextlib
import copy
import functools
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from dsr.data.reference_depth import fit, inpaint_depth
from dsr.sample import Scene
from dsr.synthetic import Rendering, cache_directory, expect_room_for, load_or_render
from dsr.utils.guards import derived, readable
from dsr.utils.progress import SILENT, Progress
from dsr.utils.versions import SCENES, hash_once

# Names of scenes; None for those that belong to the data set, ``found`` for all that are on disk
SceneSelection = Sequence[str] | Literal["found"] | None
Frames = Mapping[str, tuple[Any, ...]]  # arguments of a function that loads a frame, by the frame's name
# Note of a scene whose ``doffs`` is replaced by 0: z = baseline fx / d instead of baseline fx / (d + doffs)
WITHOUT_OFFSET = "depth is not metric: the disparity offset is left out, as in the paper"
_MOST_MISSING, _MOST_KNOWN = 30, 60  # numbers of scenes that messages name
_MAX_HASHED = 1 << 28  # largest size in bytes of files whose content is hashed


class SceneSource:
    """A data set: named scenes that are loaded one at a time."""

    name: str  # in ``scores.csv``
    evaluation: bool  # whether methods are compared on its scenes, so that none may be trained on them
    regions: tuple[str, ...] = ()  # names of those that its scenes may have, in the order of tables
    soft_edges: bool = False  # whether pixels at depth steps are mixtures of both sides
    _scenes: Sequence[str]

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene, or raise a ValueError that names a file that is missing or damaged."""
        raise NotImplementedError

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes whenever the scene's content changes."""
        raise NotImplementedError

    def content(self, scene: str) -> str:
        """Return a text that is equal for two data sets' scenes of the same files."""
        return self.fingerprint(scene)

    def prepare(self, scenes: Sequence[str], say: Callable[[str], None]) -> Iterable[str] | None:
        """Prepare scenes, several at a time, and yield the name of each that is ready; None if none needs it."""
        return None


def prepare_scenes(source: SceneSource, names: Sequence[str], progress: Progress) -> None:
    """Have a data set that renders or resizes its scenes make some of them ready."""
    ready = source.prepare(names, progress.say)
    if ready is not None:
        for _ in progress.track(ready, "prepare", len(names)):
            pass


def subset(source: SceneSource, names: Sequence[str]) -> SceneSource:
    """Return a data set of some of its scenes."""
    part = copy.copy(source)
    vars(part)["scenes"] = functools.partial(list, names)  # whatever the class's method returns
    return part


def as_source(made: Any) -> SceneSource:
    """Return what a node of the configuration makes as a data set, with the defaults of what it leaves out."""
    if isinstance(made, SceneSource):
        return made
    source = SceneSource()
    for member in ("name", "evaluation", *vars(SceneSource)):
        if not member.startswith("_") and hasattr(made, member):
            setattr(source, member, getattr(made, member))
    return source


def select_scenes(available: Sequence[str], wanted: SceneSelection) -> list[str]:
    """Return the ``wanted`` scenes, or all available ones for None."""
    if wanted == "found":
        wanted = None
    if wanted is not None and (not wanted or len(set(wanted)) < len(wanted)):
        came = ", ".join(wanted) or "an empty list"
        raise ValueError(f"scenes: expected names, each once, or null for all; got {came}")
    for name in wanted or ():
        if name not in available:
            rest = f", ... ({len(available)} in all)" if len(available) > _MOST_KNOWN else ""
            some = ", ".join(available[:_MOST_KNOWN])
            raise ValueError(f"scenes: {name!r} is not there; expected some of {some}{rest}")
    chosen = list(available) if wanted is None else list(wanted)
    for name in chosen:
        if name != readable(name):
            raise ValueError(f"scenes: expected names in UTF-8, got {name!r}; rename it, or name other scenes")
    return chosen


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
    note: str | Callable[..., str] = "",
    **settings: Any,
) -> dict[str, SceneRecord]:
    """Return the records of frames on disk, by their names with _ in place of /.

    ``load`` gets a frame's entry of ``frames``, the names of data set and scene, and ``settings``; ``note`` the entry.
    """
    records = {}
    for frame, arguments in frames.items():
        name = frame.replace("/", "_")
        files = tuple(path for path in arguments if isinstance(path, Path))
        which = json.dumps([each for each in arguments if not isinstance(each, Path)])
        read = functools.partial(load, *arguments, dataset, name, **settings)
        told = note if isinstance(note, str) else note(*arguments)
        records[name] = SceneRecord(files, read, which, json.dumps(settings), told)
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
        if self.size is not None:
            expect_room_for(self.size)
        if self.crop is not None and not 0 <= self.crop <= 1:
            raise ValueError(f"crop: expected a number from 0 to 1, or null, got {self.crop}")

    def __call__(self, scene: Scene) -> Rendering:
        """Return the scene prepared as it is cached, its photo in 8 bits."""
        if self.size is not None:
            scene = fit(scene, self.size, self.crop, enlarge=self.enlarge)
        depth = inpaint_depth(scene.true_depth) if scene.name in self.fill else scene.true_depth.double()
        photo = (scene.rgb * 255).round().to(torch.uint8).permute(1, 2, 0)
        return Rendering(photo.numpy(), depth[0].numpy(), scene.camera)


class PreparedDataset(SceneSource):
    """A data set in its original format; the base class of those in this package.

    ``named`` are the names of the scenes that belong to it, None for all that are on disk, ``count`` is their number if
    their names are not known.
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
                listed = ", ".join(missing[:_MOST_MISSING]) or "all scenes"
                rest = f" and {len(missing) - _MOST_MISSING} more" if len(missing) > _MOST_MISSING else ""
                raise ValueError(
                    f"dataset={name}: expected {listed}{rest} in {folder}, got {len(named) - len(missing)} of {total} "
                    f"scenes; {remedy}; or use what is there: dataset.scenes=found"
                )
            scenes = named
        self._scenes = select_scenes(list(found), scenes)
        unknown = [scene for scene in self._preparation.fill if scene not in (*named, *found)]
        if unknown:
            raise ValueError(f"fill: expected names of scenes, got {', '.join(unknown)}")

    def load(self, scene: str) -> Scene:
        """Return one scene, prepared."""
        record = self._found[scene]
        if self._preparation.size is None and scene not in self._preparation.fill:
            found = record.load()
        else:
            kept = load_or_render(self._path(scene), lambda: self._preparation(record.load()))
            found = kept.scene(self.name, scene)
        return derived(found, notes=(record.note,) if record.note else ())

    def fingerprint(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files and of the settings that they are read and prepared with."""
        plain = asdict(self._preparation) | {"fill": ()}
        settings = json.dumps([self._found[scene].settings, scene in self._preparation.fill, plain])
        return hashlib.sha256(f"{settings}{self.content(scene)}".encode()).hexdigest()

    def content(self, scene: str) -> str:
        """Return the SHA-256 of the scene's files alone; a large file counts by its name, size and time of change."""
        record = self._found[scene]
        digest = hashlib.sha256(record.frame.encode())
        for path in record.files:
            for file in sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]:
                if not file.is_file():
                    raise ValueError(f"{file}: expected a file, there is none")
                state = file.stat()
                large = state.st_size > _MAX_HASHED
                seal = f"{file.name} {state.st_size} {state.st_mtime_ns}" if large else hash_once(file)
                digest.update(seal.encode())
        return digest.hexdigest()

    def prepare(self, scenes: Sequence[str], _: Callable[[str], None] = SILENT.say) -> Iterator[str]:
        """Prepare scenes that are not in the cache, several at a time, and yield each that is ready, or fails."""
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
