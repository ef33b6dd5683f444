"""Open3D's reconstruction system: two folders, intrinsics as JSON, and a trajectory.

https://www.open3d.org/docs/release/tutorial/reconstruction_system/system_overview.html; the trajectory:
http://redwood-data.org/indoor/fileformat.html.

    color/000012.jpg, depth/000012.png     (or image/, rgb/) photos, and depth in 16-bit millimetres
    camera_intrinsic.json                  or camera_primesense.json, intrinsic.json: width, height, intrinsic_matrix
    scene/trajectory.log                   or trajectory.log: for each frame a line of three whole numbers, and the four
                                           rows of the pose from camera (x right, y down, z forward) to world

The n-th pose, by the first of the three numbers, is that of the n-th photo, by the numbers in the names.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np

from dsr.io.captures.poses import check_pose, read_text
from dsr.io.encoding import Assumption
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.pairs import Pair, PairingResult
from dsr.io.poses import order_of

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
        geometry = functools.partial(_geometry, f"{path}: pose {rank}", rows)
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


def _geometry(place: str, rows: _Rows, _: tuple[int, int]) -> Geometry:
    """Return the pose of a frame; its camera is read from the file beside the pictures."""
    try:
        matrix = np.array([[float(word) for word in row.split()] for row in rows])
        if matrix.shape != (4, 4):
            raise ValueError
    except ValueError as error:
        raise ValueError(f"{place}: expected a matrix of 4 x 4 numbers, got {' '.join(rows)!r:.80}") from error
    return Geometry(None, check_pose(place, matrix))
