"""``transforms.json`` with depth, as nerfstudio and the programs around instant-ngp read it.

Axes of a camera are those of OpenGL, x right, y up, z backwards, so that the second and third column of dsr's
camera-to-world transform change their signs; the world stays as it is. The principal point is counted from the corner
of the image, half a pixel more than dsr's. ``depth_file_path`` is a 16-bit PNG in millimetres, 0 in holes, which is
nerfstudio's default unit (https://docs.nerf.studio/quickstart/data_conventions.html).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from dsr.geometry.camera import Camera
from dsr.io.scene_files.frame import Frame, one_camera
from dsr.io.scene_files.open3d import RGBD
from dsr.utils.files import write_text


def write_transforms(path: Path, frames: Sequence[Frame]) -> list[Path]:
    """Write ``transforms.json`` for frames whose ``color.png`` and ``depth.png`` lie in one folder each.

    Args:
        path: the file; the frames' files are named relative to its folder.
        frames: one at least; a single one without a pose stands at the origin.

    Returns:
        The file.

    Raises:
        ValueError: one of several frames has no pose.

    """
    missing = [frame.name for frame in frames if frame.pose is None]
    if missing and len(frames) > 1:
        raise ValueError(
            f"nerfstudio: expected a pose of each frame, got none for {len(missing)} of {len(frames)}, such as "
            f"{missing[0]}; the capture has to record them"
        )
    camera = one_camera(frames)
    entries: dict[str, Any] = {"camera_model": "OPENCV", **({} if camera is None else _intrinsics(camera))}
    entries["frames"] = [
        {
            "file_path": _relative(frame.colour, path),
            "depth_file_path": _relative(frame.colour.with_name(RGBD[1]), path),
            **({} if camera is not None else _intrinsics(frame.camera)),
            "transform_matrix": _to_opengl(frame),
        }
        for frame in frames
    ]
    write_text(path, json.dumps(entries, indent=2) + "\n")
    return [path]


def _to_opengl(frame: Frame) -> list[list[float]]:
    """Return the transform from OpenGL's camera frame to the world."""
    pose = torch.eye(4, dtype=torch.float64) if frame.pose is None else frame.pose
    matrix: list[list[float]] = (pose * pose.new_tensor([1, -1, -1, 1])).tolist()
    return matrix


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return the camera's entries."""
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }


def _relative(file: Path, path: Path) -> str:
    """Return a file's path relative to the folder of another, with slashes."""
    return Path(os.path.relpath(file, path.parent)).as_posix()
