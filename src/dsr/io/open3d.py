"""Open3D's reconstruction system, read and written: two folders, intrinsics as JSON, and a trajectory.

https://www.open3d.org/docs/release/tutorial/reconstruction_system/system_overview.html; the trajectory:
http://redwood-data.org/indoor/fileformat.html.

    color/000012.jpg, depth/000012.png     (or image/, rgb/) photos, and depth in 16-bit millimetres, 0 in holes
    camera_intrinsic.json                  or camera_primesense.json, intrinsic.json: width, height, and column by
                                           column intrinsic_matrix, with pixel centres at integers
    scene/trajectory.log                   or trajectory.log: for each frame a line of three whole numbers, and the four
                                           rows of the pose from camera (x right, y down, z forward) to world

The n-th pose, by the first of the three numbers, is that of the n-th photo, by the numbers in the names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.io.frames import CaptureFrame, Geometry, stated
from dsr.io.pairs import Pair, PairingResult
from dsr.io.photos import write_png
from dsr.io.scene_files import RGBD, Frame, one_camera, to_millimetres
from dsr.io.trajectories import check_pose, order_of
from dsr.notes import Assumption
from dsr.utils.files import write_text
from dsr.utils.guards import numbers_in, read_text

_APP = "Open3D"
_TRAJECTORIES = ("scene/trajectory.log", "trajectory.log")
_Rows = tuple[str, ...]


def add_trajectory(folder: Path, found: PairingResult) -> PairingResult:
    """Return the pairs of a folder with the poses of its trajectory, if it has one that fits."""
    path = next((folder / name for name in _TRAJECTORIES if (folder / name).is_file()), None)
    if path is None or not found.pairs:
        return found
    entries = _read_entries(path)
    if found.unpaired or len(entries) != len(found.pairs):
        text = f"no poses: {path.name} has {len(entries)}, for {len(found.pairs)} pairs"
        text += f" and {len(found.unpaired)} pictures without a partner" if found.unpaired else ""
        return replace(found, assumptions=(*found.assumptions, Assumption(text)))
    pairs: list[Pair] = []
    for rank, (pair, rows) in enumerate(zip(found.pairs, entries, strict=True)):
        geometry = stated(_geometry, f"{path}: pose {rank}", rows)
        pairs.append(replace(pair, capture=CaptureFrame(_APP, geometry, path, "\n".join(rows).encode())))
    text = f"poses: {path.relative_to(folder).as_posix()} of {_APP}, one for each photo"
    return replace(found, pairs=tuple(pairs), assumptions=(*found.assumptions, Assumption(text)))


def _read_entries(path: Path) -> list[_Rows]:
    """Return the four rows of each pose as text, in the order of the poses' numbers."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    try:
        if len(lines) % 5 or any(len(line.split()) != 3 for line in lines[::5]):
            raise ValueError
        order = order_of([int(line.split()[0]) for line in lines[::5]])
    except ValueError:
        raise ValueError(
            f"{path}: expected a line of three whole numbers and four of a matrix for each pose, got {len(lines)} lines"
        ) from None
    return [tuple(lines[5 * place + 1 : 5 * place + 5]) for place in order]


def _geometry(place: str, rows: _Rows) -> Geometry:
    """Return the pose of a frame; its camera is read from the file beside the pictures."""
    values = [numbers_in(row.split()) for row in rows]
    if [len(row) for row in values] != [4] * 4:
        raise ValueError(f"{place}: expected a matrix of 4 x 4 numbers, got {' '.join(rows)!r:.80}")
    return Geometry(None, check_pose(place, np.array(values)))


def write_rgbd(folder: Path, rgb: Tensor, depth: Tensor, camera: Camera) -> list[Assumption]:
    """Write ``color.png``, ``depth.png`` and ``intrinsic.json`` of one frame; note pixels that are too far for 16 bits.

    ``rgb``: (3, H, W) in [0, 1]. ``depth``: (1, H, W) in metres, NaN in holes.
    """
    millimetres, lost = to_millimetres(depth[0].cpu().numpy())
    pixels = (rgb * 255).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy()
    write_png(folder / RGBD[0], np.ascontiguousarray(pixels[..., ::-1]))
    write_png(folder / RGBD[1], millimetres)
    _write_intrinsics(folder / RGBD[2], camera)
    if not lost:
        return []
    return [Assumption(f"{folder.name}/{RGBD[1]}: what is beyond 65.5 m is written as a hole", f"{lost} pixels")]


def write_open3d(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a folder as Open3D expects it, with a PNG for each frame in ``color/`` and ``depth/``.

    ``intrinsic.json`` is the camera, or ``intrinsics/`` that of each frame if they differ. ``trajectory.log`` has the
    poses, if all frames have one.
    """
    files, rows = list[Path](), list[str]()
    for number, frame in enumerate(frames):
        files += [folder / "color" / f"{frame.stem}.png", folder / "depth" / f"{frame.stem}.png"]
        frame.copy_colour(files[-2])
        frame.write_millimetres(files[-1])
        rows.append(f"{number} {number} {number + 1}\n")
        rows += (" ".join(f"{value:.12g}" for value in row) + "\n" for row in frame.matrix)
    camera = one_camera(frames)
    cameras = {f"intrinsics/{frame.stem}.json": frame.camera for frame in frames}
    for name, each in (cameras if camera is None else {RGBD[2]: camera}).items():
        files.append(folder / name)
        _write_intrinsics(files[-1], each)
    if all(frame.pose is not None for frame in frames):
        files.append(folder / "trajectory.log")
        write_text(files[-1], "".join(rows))
    return files


def _write_intrinsics(path: Path, camera: Camera) -> None:
    """Write Open3D's JSON of a camera."""
    matrix = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    entries = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix}
    write_text(path, json.dumps(entries, indent=2) + "\n")
