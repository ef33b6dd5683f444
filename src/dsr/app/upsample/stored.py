"""Results of ``dsr upsample`` read back, for ``dsr view``, ``dsr fuse`` and exports of all frames."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dsr.app.upsample.parts import ERRORS, METRES, Part, Results
from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid
from dsr.inference.plausibility import find_filled
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import INPUT, read_input
from dsr.io.frames import UPS
from dsr.io.posed_frames import Frame, read_errors
from dsr.io.scene_files import (
    RGBD,
    write_open3d,
    write_rerun,
    write_splatting,
    write_transforms,
)
from dsr.notes import Assumption, read_warning
from dsr.sample import expect_distances
from dsr.utils.files import write_text
from dsr.utils.guards import is_number, natural_key, parse_json, path_within, pixels_beside, read_limited, refusing
from dsr.utils.progress import show_length

if TYPE_CHECKING:
    from dsr.report.surface_page import ViewedResult

INFO = "info.json"
EXPORTS = "exports.json"  # the record of exports, in the folder of the results
_OPTIONAL: Mapping[str, Any] = {  # entries that ``info.json`` may lack, as while a run is not complete
    "noise": None,
    "shares": {},
    "seconds": {},
    "assumptions": [],
    "warnings": [],
    "photo_size": [],
    "input_size": [],
}
_FOREIGN = "{}: expected a file of `dsr upsample`, got something else"
_DEEPEST = 6  # folders below the given one in which results are looked for


def find_results(folder: Path) -> list[Path]:
    """Return the folders of results at and below a folder, in the order of their names; a ValueError for none."""
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
    """Read a result for a page on which it has a name; a ValueError if it is not complete, or a file is damaged."""
    from dsr.report.surface_page import ViewedResult  # noqa: PLC0415 - pages need Matplotlib

    info = read_complete(folder)
    camera = read_camera(folder, info)
    depth, notes = read_depth(folder, camera), list(info["assumptions"])
    depth_error = angle_error = None
    if (folder / ERRORS).is_file():
        depth_error, angle_error = read_errors(folder / ERRORS, camera)
    photo = depth_lr = filled = None
    try:
        photo, depth_lr = read_input(folder / INPUT)
        filled = find_filled(*(torch.from_numpy(each)[None] for each in (depth, depth_lr)))[0].numpy()
    except FileNotFoundError:
        notes.append(f"without {INPUT} there is neither the photo nor the input; the same `dsr upsample` again adds it")
    near, middle, far = np.nanpercentile(depth, (1, 50, 99))
    sizes = {name: " x ".join(map(str, info[f"{name}_size"])) or "unknown" for name in ("photo", "input")}
    facts = {
        "method": f"{info.get('method', 'unknown')} x{info.get('scale', '?')}",
        **sizes,
        "depth": f"{near:.2f} to {far:.2f} m, median {middle:.2f} m",
    }
    if info["noise"] is not None and is_number(info["noise"].get("deviation")):
        facts["noise of the input"] = f"about {show_length(info['noise']['deviation'], 2)}"
    return ViewedResult(
        name=name,
        depth=depth,
        camera=camera,
        photo=photo,
        depth_lr=depth_lr,
        depth_error=depth_error,
        angle_error=angle_error,
        filled=filled,
        max_error=_max_error(info),
        facts=facts,
        notes=notes,
    )


def read_info(folder: Path) -> dict[str, Any] | None:
    """Return the ``info.json`` of a run, complete or not; None if there is none, a ValueError if it is not ours."""
    path = folder / INFO
    if not path.is_file():
        return None
    with refusing(_FOREIGN.format(path), ValueError, KeyError, TypeError, AttributeError):
        info = {**_OPTIONAL, **parse_json(read_limited(path), finite=False)}
        lists = [info[name] for name in ("files", "assumptions", "warnings", "photo_size", "input_size")]
        records = [info[name] for name in ("inputs", "settings", "shares", "seconds")]
        records += [*info["inputs"].values(), *([] if info["noise"] is None else [info["noise"]])]
        if not all(isinstance(each, list) for each in lists) or not all(isinstance(each, dict) for each in records):
            raise TypeError
        if not all(isinstance(text, str) for text in (*info["files"], *info["assumptions"])):
            raise TypeError
        if not all(map(is_number, (*info["shares"].values(), *info["seconds"].values()))):
            raise TypeError
        warnings_of(info)
        up = info.get("up")
        return {**info, "complete": info["complete"] is True, "up": up if up in UPS else ""}


def warnings_of(info: Mapping[str, Any]) -> tuple[Assumption, ...]:
    """Return the warnings that a run gave."""
    return tuple(read_warning(each) for each in info["warnings"])


def read_complete(folder: Path) -> dict[str, Any]:
    """Return the ``info.json`` of a complete result; a ValueError if there is none."""
    info = read_info(folder)
    if info is None:
        raise ValueError(f"{folder}: expected a result of `dsr upsample`, got a folder without {INFO}")
    if not info["complete"]:
        raise ValueError(f"{folder / INFO}: expected a complete result, got that of an interrupted run; run it again")
    return info


def read_camera(folder: Path, info: Mapping[str, Any]) -> Camera:
    """Return the camera of the photo of a result; a ValueError if its ``info.json`` has none."""
    try:
        return Camera(**info["camera"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        came = f"{info.get('camera')!r:.200}"
        raise ValueError(f"{folder / INFO}: expected the photo's camera under `camera`, got {came}") from error


def read_depth(folder: Path, camera: Camera) -> np.ndarray:
    """Return the depth of a result, (H, W) float32 in metres, NaN in holes; a ValueError if there is none."""
    path, size = folder / METRES, (camera.height, camera.width)
    if not path.is_file():
        raise ValueError(f"{folder}: expected a result with depth, got one without {METRES}; run it with --only depth")
    stored = read_depth_file(path, pixels_beside(*size))
    if stored.shape != size or stored.dtype != np.float32:
        text = f"{stored.dtype} of shape {stored.shape}"
        raise ValueError(f"{path}: expected float32 of shape {size}, the photo's, got {text}")
    depth = np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(math.nan))
    if not np.isfinite(depth).any():
        raise ValueError(f"{path}: expected depths, all pixels are holes")
    expect_distances(str(path), torch.from_numpy(depth))
    return depth


def read_frame(name: str, folder: Path) -> Frame:
    """Return the frame whose results are in a folder; a ValueError if they are not complete."""
    info = read_complete(folder)
    depth, colour = folder / METRES, folder / "rgbd" / RGBD[0]
    if not (depth.is_file() and colour.is_file()):
        raise ValueError(f"{folder}: expected {METRES} and rgbd/{RGBD[0]} of this run, one is missing")
    pose, time = info.get("pose"), info.get("time")
    if pose is not None:
        as_rigid(pose, f"{folder / INFO}: pose")
        pose = np.vstack((np.array(pose, np.float64)[:3], (0, 0, 0, 1)))
    return Frame(
        name, read_camera(folder, info), pose, colour, depth, info["up"], time if is_number(time) else None,
        errors=folder / ERRORS if (folder / ERRORS).is_file() else None, max_error=_max_error(info),
    )  # fmt: skip


def _max_error(info: Mapping[str, Any]) -> float:
    """Return the limit of a result's expected errors, as a fraction of the depth."""
    limit = info["settings"].get("max_error")
    return float(limit) if is_number(limit) and 0 < limit < 1e9 else Results.max_error / 100


def write_scene(
    output: Path, folders: Mapping[str, Path], parts: Sequence[Part], *, overwrite: bool
) -> tuple[dict[str, Path], list[str]]:
    """Write exports of frames that are complete; return them by part, and the problems, one line each.

    They are recorded in ``exports.json``. A problem with one export does not stop the others. ``folders`` are those of
    the frames, by their names; with ``overwrite`` what is there and not recorded is replaced.
    """
    written: dict[str, Path] = {}
    problems: list[str] = []
    try:
        frames = [read_frame(name, folder) for name, folder in folders.items()]
        names: dict[str, str] = {}
        for frame in frames:
            if frame.stem in names:
                other = names[frame.stem]
                raise ValueError(f"expected frames of different names as files, got {other} and {frame.name}")
            names[frame.stem] = frame.name
        recorded = read_exports(output)
    except (ValueError, OSError) as error:
        return written, [str(error)]
    for part in parts:
        name = part.files[0]
        own = {file.split("/")[0] for file in recorded.get(name, ())}
        there = [output / each for each in part.files if each not in own and (output / each).exists()]
        if there and not overwrite:
            problems.append(f"{there[0]}: is there already and not of an earlier run; --overwrite replaces it")
            continue
        try:
            paths = _EXPORTERS[part.name](output / name, frames)
        except (ValueError, OSError) as error:
            problems.append(str(error))
            continue
        files = sorted(path.relative_to(output).as_posix() for path in paths)
        for old in set(recorded.get(name, ())) - set(files):  # of frames that are no longer there
            if old.split("/")[0] in part.files:
                (output / old).unlink(missing_ok=True)
        recorded[name] = files
        write_text(output / EXPORTS, json.dumps({"exports": recorded}, indent=2) + "\n")
        written[part.name] = output / name
    return written, problems


_EXPORTERS = {
    "open3d": write_open3d,
    "nerfstudio": write_transforms,
    "gaussian": write_splatting,
    "rerun": write_rerun,
}


def read_exports(output: Path) -> dict[str, list[str]]:
    """Return the exports of earlier runs, with their files."""
    path = output / EXPORTS
    if not path.is_file():
        return {}
    with refusing(_FOREIGN.format(path), ValueError, KeyError, TypeError):
        exports = dict(parse_json(read_limited(path))["exports"])
        lists = [files if isinstance(files, list) else [None] for files in exports.values()]
        if not all(isinstance(file, str) for files in lists for file in files):
            raise TypeError
    for name, files in exports.items():
        for file in files:
            path_within(output, file, f"{path}: exports.{name}")
    return exports
