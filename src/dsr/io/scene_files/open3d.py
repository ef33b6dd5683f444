"""Colour and depth of one size with intrinsics, and poses, as Open3D reads them.

Depth is 16-bit PNG in millimetres, 0 in holes, which ``open3d.geometry.RGBDImage.create_from_color_and_depth`` takes
with its default ``depth_scale=1000``; its ``depth_trunc`` leaves out what is beyond 3 m unless it is told otherwise.
Intrinsics are those of ``open3d.io.read_pinhole_camera_intrinsic``: ``intrinsic_matrix`` column by column, with pixel
centres at integers. ``trajectory.log`` has a line of three numbers and a camera-to-world matrix for each frame, of a
camera with x right, y down, z forward, as in dsr (https://www.open3d.org/docs/release, file formats and the
reconstruction system).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.io.encoding import Assumption
from dsr.io.scene_files.frame import Frame, one_camera, to_millimetres, write_colour, write_sixteen_bits
from dsr.utils.files import replacing, write_text

RGBD = ("color.png", "depth.png", "intrinsic.json")


def write_rgbd(folder: Path, rgb: Tensor, depth: Tensor, camera: Camera) -> list[Assumption]:
    """Write colour, depth and intrinsics of one frame: ``color.png``, ``depth.png`` and ``intrinsic.json``.

    Args:
        folder: is created if it is missing.
        rgb: (3, H, W) in [0, 1].
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.

    Returns:
        A note on pixels that are too far for 16-bit millimetres, if there are any.

    """
    millimetres, lost = to_millimetres(depth[0].cpu().numpy())
    write_colour(folder / RGBD[0], (rgb * 255).round().clamp(0, 255).byte().permute(1, 2, 0).cpu().numpy())
    write_sixteen_bits(folder / RGBD[1], millimetres)
    _write_intrinsics(folder / RGBD[2], camera)
    if not lost:
        return []
    return [Assumption(f"{folder.name}/{RGBD[1]}: what is beyond 65.5 m is written as a hole", f"{lost} pixels")]


def write_open3d(folder: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write a folder as Open3D's reconstruction system expects it.

    ``color/`` and ``depth/`` have a PNG for each frame, ``intrinsic.json`` is the camera, or ``intrinsics/`` that of
    each frame if they differ. ``trajectory.log`` has the poses, if all frames have one.

    Args:
        folder: is created if it is missing.
        frames: one at least.

    Returns:
        The files.

    """
    files = []
    for frame in frames:
        files += [folder / "color" / f"{frame.stem}.png", folder / "depth" / f"{frame.stem}.png"]
        with replacing(files[-2]) as temporary:
            shutil.copyfile(frame.colour, temporary)
        write_sixteen_bits(files[-1], to_millimetres(frame.read_depth())[0])
    camera = one_camera(frames)
    named = {frame.stem: frame.camera for frame in frames} if camera is None else {}
    intrinsics = {folder / "intrinsics" / f"{stem}.json": each for stem, each in named.items()}
    if camera is not None:
        intrinsics = {folder / RGBD[2]: camera}
    for path, each in intrinsics.items():
        _write_intrinsics(path, each)
    files += intrinsics
    if all(frame.pose is not None for frame in frames):
        files.append(folder / "trajectory.log")
        write_text(files[-1], "".join(_log_entry(number, frame) for number, frame in enumerate(frames)))
    return files


def _log_entry(number: int, frame: Frame) -> str:
    """Return a frame's lines of ``trajectory.log``."""
    rows = [] if frame.pose is None else frame.pose.tolist()
    lines = [f"{number} {number} {number + 1}", *(" ".join(f"{value:.12g}" for value in row) for row in rows)]
    return "\n".join(lines) + "\n"


def _write_intrinsics(path: Path, camera: Camera) -> None:
    """Write Open3D's JSON of a camera."""
    matrix = [camera.fx, 0.0, 0.0, 0.0, camera.fy, 0.0, camera.cx, camera.cy, 1.0]
    entries = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix}
    write_text(path, json.dumps(entries, indent=2) + "\n")
