"""Results of ``dsr upsample`` read back, for ``dsr view``, ``dsr fuse`` and exports of all frames."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dsr.app.upsample.outputs import INFO
from dsr.app.upsample.parts import ERRORS, METRES, Part, Results
from dsr.evaluation.results import load_errors
from dsr.geometry.camera import Camera
from dsr.inference import find_filled
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import INPUT, read_input
from dsr.io.frames import UPS
from dsr.io.scene_files import RGBD, Frame, parse_pose
from dsr.sample import expect_distances
from dsr.utils.arrays import array_headers
from dsr.utils.files import write_text
from dsr.utils.guards import TooLargeError, is_number, natural_key, parse_json, path_within, pixels_beside, read_limited
from dsr.utils.progress import show_length

if TYPE_CHECKING:
    from dsr.report.surface_page import ViewedResult

_DEEPEST = 6
"""Folders below the given one in which results are looked for."""
_LARGEST_INFO = 16 << 20
EXPORTS = "exports.json"
"""The record of exports, in the folder of the results."""


def find_results(folder: Path) -> list[Path]:
    """Return the folders of results at and below a folder, in the order of their names, numbers by value.

    Raises:
        ValueError: there is none.

    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected the folder of a result of `dsr upsample`, there is no such folder")
    found = []
    for root, names, files in os.walk(folder):
        if INFO in files:
            found.append(Path(root))
        if INFO in files or len(Path(root).relative_to(folder).parts) >= _DEEPEST:
            names.clear()
    if not found:
        raise ValueError(f"{folder}: expected a result of `dsr upsample`, or a folder of them, got one without {INFO}")
    return sorted(found, key=natural_key)


def read_result(folder: Path, name: str) -> ViewedResult:
    """Read a result.

    Args:
        folder: that of the result.
        name: its name on the page.

    Raises:
        ValueError: the folder holds no complete result, or a file is damaged.

    """
    from dsr.report.surface_page import ViewedResult  # noqa: PLC0415 - pages need Matplotlib

    info = read_info(folder / INFO)
    camera = read_camera(folder / INFO, info)
    depth = read_depth(folder, camera)
    said = info.get("assumptions")
    notes = [str(text) for text in said] if isinstance(said, list) else []
    errors: tuple[np.ndarray, np.ndarray] | None = None
    if (folder / ERRORS).is_file():
        errors = read_errors(folder / ERRORS, camera)
    photo = depth_lr = None
    try:
        photo, depth_lr = read_input(folder / INPUT)
    except FileNotFoundError:
        notes.append(f"without {INPUT} there is neither the photo nor the input; the same `dsr upsample` again adds it")
    settings = info.get("settings")
    limit = settings.get("max_error") if isinstance(settings, dict) else None
    filled = None if depth_lr is None else find_filled(*(torch.from_numpy(each)[None] for each in (depth, depth_lr)))
    return ViewedResult(
        name=name,
        depth=depth,
        camera=camera,
        photo=photo,
        depth_lr=depth_lr,
        depth_error=None if errors is None else errors[0],
        angle_error=None if errors is None else errors[1],
        filled=None if filled is None else filled[0].numpy(),
        max_error=float(limit) if is_number(limit) and 0 < limit < 1e9 else Results.max_error / 100,
        facts=_facts(info, depth),
        notes=notes,
    )


def read_info(path: Path) -> Mapping[str, Any]:
    """Read ``info.json`` of a complete result.

    Raises:
        ValueError: it is damaged or foreign, or the run was interrupted.

    """
    try:
        info = parse_json(read_limited(path, _LARGEST_INFO), finite=False)
        complete, _ = info["complete"], info["files"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else") from error
    if complete is not True:
        raise ValueError(f"{path}: expected a complete result, got that of an interrupted run; run it again")
    return info


def read_up(info: Mapping[str, Any]) -> str:
    """Return the axis of the world that points up, one of :data:`dsr.io.frames.UPS`."""
    up = info.get("up")
    return up if isinstance(up, str) and up in UPS else ""


def read_camera(path: Path, info: Mapping[str, Any]) -> Camera:
    """Return the camera of the photo.

    Args:
        path: ``info.json``, named in an error.
        info: its entries.

    Raises:
        ValueError: they hold no camera.

    """
    try:
        return Camera(**info["camera"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        came = f"{info.get('camera')!r:.200}"
        raise ValueError(f"{path}: expected the photo's camera under `camera`, got {came}") from error


def read_depth(folder: Path, camera: Camera) -> np.ndarray:
    """Return the depth of a result, (H, W) float32 in metres, NaN in holes.

    Raises:
        ValueError: the file is missing, damaged or foreign, or has no depth.

    """
    path, size = folder / METRES, (camera.height, camera.width)
    if not path.is_file():
        raise ValueError(f"{folder}: expected a result with depth, got one without {METRES}; run it with --only depth")
    try:
        stored = read_depth_file(path, pixels_beside(*size))
    except TooLargeError:
        raise
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: expected a map of depths, got a damaged or foreign file") from error
    if stored.shape != size or stored.dtype != np.float32:
        text = f"{stored.dtype} of shape {stored.shape}"
        raise ValueError(f"{path}: expected float32 of shape {size}, the photo's, got {text}")
    if min(size) < 2:
        raise ValueError(f"{path}: expected a map of at least 2 x 2 pixels, got {size}")
    depth = np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(math.nan))
    if not np.isfinite(depth).any():
        raise ValueError(f"{path}: expected depths, all pixels are holes")
    expect_distances(str(path), torch.from_numpy(depth))
    return depth


def read_errors(path: Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected errors of depth and normal, (H, W) float32 each, in metres and degrees.

    Raises:
        ValueError: the file is damaged or foreign.

    """
    size = (camera.height, camera.width)
    shapes = {name: shape for name, (shape, _) in array_headers(path).items()}
    if any(shapes.get(name) != size for name in ("depth_error", "angle_error")):
        raise ValueError(f"{path}: expected depth_error and angle_error of shape {size}, the photo's, got {shapes}")
    errors = load_errors(path)
    if errors is None:
        raise ValueError(f"{path}: expected depth_error and angle_error, got {shapes}")
    return errors[0][0].numpy(), errors[1][0].numpy()


def _facts(info: Mapping[str, Any], depth: np.ndarray) -> dict[str, str]:
    """Return what is written below the surface."""
    known = depth[np.isfinite(depth)]
    near, middle, far = np.percentile(known, (1, 50, 99))
    facts = {
        "method": f"{info.get('method', 'unknown')} x{info.get('scale', '?')}",
        "photo": _size(info.get("photo_size")),
        "input": _size(info.get("input_size")),
        "depth": f"{near:.2f} to {far:.2f} m, median {middle:.2f} m",
    }
    noise = info.get("noise")
    if isinstance(noise, dict) and is_number(noise.get("deviation")):
        facts["noise of the input"] = f"about {show_length(noise['deviation'], 2)}"
    return facts


def _size(size: Any) -> str:
    """Return a size as text."""
    return f"{size[0]} x {size[1]}" if isinstance(size, list) and len(size) == 2 else "unknown"


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
