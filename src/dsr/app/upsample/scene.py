"""Exports of all frames of a run together, made of the frames' folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dsr.app.upsample.outputs import INFO
from dsr.app.upsample.parts import METRES, Part
from dsr.app.upsample.stored import read_camera, read_info, read_up
from dsr.io.scene_files import RGBD, Frame, parse_pose
from dsr.utils.files import write_text
from dsr.utils.guards import is_number, parse_json, path_within, read_limited

EXPORTS = "exports.json"
"""The record of exports, in the folder of the results."""


@dataclass
class SceneResult:
    """What was written, by part, and the problems, one line each."""

    files: dict[str, Path] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def write_scene(output: Path, folders: Mapping[str, Path], parts: Sequence[Part], *, overwrite: bool) -> SceneResult:
    """Write exports of frames that are complete, and record them in ``exports.json``.

    A problem with one export does not stop the others.

    Args:
        output: the folder of the results.
        folders: the folder of each frame, by its name.
        parts: parts of all frames together.
        overwrite: whether to replace what is there and not recorded.

    """
    result = SceneResult()
    try:
        frames = [read_frame(name, folder) for name, folder in folders.items()]
        expect_distinct(frames)
        recorded = _read_record(output)
    except (ValueError, OSError) as error:
        result.problems.append(str(error))
        return result
    for part in parts:
        assert part.write_all is not None  # noqa: S101 - they are of all frames
        name = part.files[0]
        path = output / name
        there = [output / each for each in part.files if (output / each).exists()]
        if there and name not in recorded and not overwrite:
            result.problems.append(f"{there[0]}: is there already and not of an earlier run; --overwrite replaces it")
            continue
        try:
            files = part.write_all(path, frames)
        except (ValueError, OSError) as error:
            result.problems.append(str(error))
            continue
        stale = set(recorded.get(name, ())) - {file.relative_to(output).as_posix() for file in files}
        for old in stale:  # of frames that are no longer there
            if old.split("/")[0] in part.files:
                (output / old).unlink(missing_ok=True)
        recorded[name] = sorted(file.relative_to(output).as_posix() for file in files)
        write_text(output / EXPORTS, json.dumps({"exports": recorded}, indent=2) + "\n")
        result.files[part.name] = path
    return result


def read_frame(name: str, folder: Path) -> Frame:
    """Return the frame whose results are in a folder.

    Its pose is the entry ``pose`` of ``info.json``: a camera-to-world matrix of four lists of four numbers, in metres.

    Raises:
        ValueError: the folder is not complete, or the pose is none.

    """
    path = folder / INFO
    info = read_info(path)
    depth, colour = folder / METRES, folder / "rgbd" / RGBD[0]
    if not (depth.is_file() and colour.is_file()):
        raise ValueError(f"{folder}: expected {METRES} and rgbd/{RGBD[0]} of this run, one is missing")
    pose, time = parse_pose(f"{path}: pose", info.get("pose")), info.get("time")
    time = time if is_number(time) else None
    return Frame(name, read_camera(path, info), pose, colour, depth, read_up(info), time)


def expect_distinct(frames: Sequence[Frame]) -> None:
    """Check that frames have different names as files.

    Raises:
        ValueError: two have the same.

    """
    seen: dict[str, str] = {}
    for frame in frames:
        if frame.stem in seen:
            raise ValueError(f"expected frames of different names as files, got {seen[frame.stem]} and {frame.name}")
        seen[frame.stem] = frame.name


def _read_record(output: Path) -> dict[str, list[str]]:
    """Return the exports of earlier runs, with their files."""
    path = output / EXPORTS
    if not path.is_file():
        return {}
    try:
        exports = dict(parse_json(read_limited(path))["exports"])
        lists = [files if isinstance(files, list) else [None] for files in exports.values()]
        if not all(isinstance(file, str) for files in lists for file in files):
            raise TypeError
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else") from error
    for name, files in exports.items():
        for file in files:
            path_within(output, file, f"{path}: exports.{name}")
    return exports
