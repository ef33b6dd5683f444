"""The command behind ``dsr fuse``: one mesh of the results of a sequence."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console

from dsr.app.requests import FuseRequest
from dsr.app.upsample.parts import ERRORS
from dsr.app.upsample.stored import INFO, read_camera, read_complete, read_depth, read_errors, read_up
from dsr.geometry.mesh import fuse_maps, suggest_voxel
from dsr.geometry.poses import PosedMap, as_rigid, check_poses
from dsr.io.exports import INPUT, read_input, world_comment, write_ply
from dsr.io.images import read_pixels
from dsr.io.scene_files import RGBD
from dsr.notes import Assumption, expect_no_warning
from dsr.utils.console import one_line, show
from dsr.utils.guards import natural_key
from dsr.utils.progress import show_length

_GREY = 190
_SEEN = 2.0  # voxels between a point and a frame's depth up to which the frame sees it
_LEAST_ERROR = 1e-4  # smallest expected error in metres that a weight distinguishes


def fuse(request: FuseRequest, console: Console) -> list[str]:
    """Fuse the depth of results into a mesh, and return the problems, one line each."""
    max_error = request.max_error / 100
    found = sorted({path.parent for folder in request.folders for path in folder.rglob(INFO)}, key=natural_key)
    frames: list[Path] = []
    problems: list[str] = []
    for folder in found:
        try:
            _load(folder, max_error)
            frames.append(folder)
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
    if not frames:
        what = problems[0] if problems else f"{request.folders[0]}: found no {INFO}"
        raise ValueError(f"expected results of `dsr upsample` with poses; {what}")

    def fault(folder: Path) -> Assumption | None:
        recording = [frame for frame in frames if frame.parent == folder]
        return check_poses(len(recording), lambda number: _load(recording[number], max_error))

    parents = dict.fromkeys(frame.parent for frame in frames)
    warnings = [each for each in dict.fromkeys(map(fault, parents)) if each is not None]
    if request.strict:
        expect_no_warning(str(request.folders[0]), warnings)
    for each in warnings:
        show(console, str(each))

    def maps() -> Iterator[PosedMap]:
        return (_load(folder, max_error) for folder in frames)

    try:
        voxel = suggest_voxel(maps()) if request.voxel is None else request.voxel
        mesh = fuse_maps(maps, voxel)
    except ValueError as error:
        raise ValueError(f"{frames[0]}{' and others' if len(frames) > 1 else ''}: {error}") from error
    colours = _colours(mesh.vertices, frames, max_error, _SEEN * voxel, problems)
    ups = {read_up(read_complete(folder)) for folder in frames}
    comment = world_comment(ups.pop() if len(ups) == 1 else "")
    write_ply(request.output, mesh.vertices, colours, mesh.normals, mesh.faces, frame=comment)
    size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, voxels of {show_length(voxel)}"
    count = "1 result" if len(frames) == 1 else f"{len(frames)} results"
    show(console, f"{count} -> {request.output}: {size}; in the world's frame of the poses")
    if request.score:
        show(console, f"successive results differ by {_difference(frames, max_error)} (OPW)")
    return problems


def _difference(frames: Sequence[Path], max_error: float) -> str:
    """Return the mean difference of successive results of each recording, with its unit and how many pairs it is of."""
    from dsr.metrics.temporal import opw  # noqa: PLC0415 - torchmetrics, which takes a second

    found = []
    for pair in itertools.pairwise(frames):
        first, second = (_load(folder, max_error) for folder in pair)
        if pair[0].parent == pair[1].parent and first.camera == second.camera:
            depths = torch.from_numpy(np.stack((first.depth, second.depth)))[:, None]
            found.append(float(opw(depths, first.camera, (first.pose, second.pose))))
    known = [each for each in found if not math.isnan(each)]
    mean = show_length(float(np.mean(known))) if known else "nan"
    return f"{mean}, {len(known)} pairs of a view in common"


def _load(folder: Path, max_error: float) -> PosedMap:
    """Return a result."""
    path, info = folder / INFO, read_complete(folder)
    if info.get("pose") is None:
        raise ValueError(f"{path}: expected a pose; run `dsr upsample` on a capture with poses, or with --poses")
    camera = read_camera(folder, info)
    depth = read_depth(folder, camera).astype(np.float64)
    deviation = None
    if (folder / ERRORS).is_file():
        deviation = np.maximum(read_errors(folder, camera)[0].astype(np.float64), _LEAST_ERROR)
        with np.errstate(invalid="ignore"):
            depth = np.where(deviation <= max_error * depth, depth, np.nan)
    return PosedMap(depth, camera, as_rigid(info["pose"], f"{path}: pose"), deviation)


def _colours(
    vertices: np.ndarray, frames: Sequence[Path], max_error: float, near: float, problems: list[str]
) -> np.ndarray:
    """Return the mean colour that the photos of results have at points, (N, 3) uint8, grey where none sees them.

    A frame sees a point that is at most ``near`` metres from its depth. ``problems`` gets a line for a photo that
    cannot be read.
    """
    total, weight = np.zeros(vertices.shape), np.zeros(len(vertices))
    for folder in frames:
        try:
            photo = _photo(folder)
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
            continue
        if photo is None:
            continue
        depth, camera, pose, _ = _load(folder, max_error)
        x, y, z = ((vertices - pose[:3, 3]) @ pose[:3, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
        places = np.flatnonzero(inside)
        rows, columns = (np.rint(each[places]).astype(np.intp) for each in (v, u))
        seen = np.abs(depth[rows, columns] - z[places]) <= near
        places, rows, columns = places[seen], rows[seen], columns[seen]
        own = photo[rows * photo.shape[0] // camera.height, columns * photo.shape[1] // camera.width]
        total[places] += own / z[places, None] ** 2
        weight[places] += 1 / z[places] ** 2
    known = weight > 0
    total[known] /= weight[known, None]
    return np.where(known[:, None], np.rint(total), _GREY).astype(np.uint8)


def _photo(folder: Path) -> np.ndarray | None:
    """Return the photo of a result, (H, W, 3) uint8, perhaps smaller than its depth; None if there is none."""
    if (folder / INPUT).is_file():
        return read_input(folder / INPUT)[0]
    path = folder / "rgbd" / RGBD[0]
    return read_pixels(path, cv2.IMREAD_COLOR)[..., ::-1] if path.is_file() else None
