"""Poses of captures as matrices from camera to world, and the intrinsics beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsr.geometry.camera import Camera
from dsr.geometry.poses import from_quaternion, is_rotation
from dsr.io.encoding import Assumption
from dsr.io.pairs import Pair
from dsr.utils.limits import read_limited

_TOLERANCE = 1e-3
"""Largest deviation of a rotation's entries, and of a quaternion's length, from those of a rigid motion."""
_ARKIT_TO_DSR = np.diag([1.0, -1.0, -1.0, 1.0])
"""ARKit's and OpenGL's camera looks along -z with y up; dsr's along z with y down."""


def pose_from_quaternion(
    source: str, quaternion: Sequence[float], position: Sequence[float], *, opengl: bool = False
) -> np.ndarray:
    """Return the pose (4, 4) from camera to world, with the camera's axes x right, y down, z forward.

    Args:
        source: name of the file and the place in it, for the message.
        quaternion: x, y, z, w of the rotation from camera to world.
        position: of the camera, in metres.
        opengl: whether the camera's axes are x right, y up, z backward, as ARKit and OpenGL have them.

    Raises:
        ValueError: a number is not finite, or the quaternion is not of length 1.

    """
    length = math.hypot(*quaternion)
    if not math.isfinite(length) or abs(length - 1) > _TOLERANCE or not np.isfinite(position).all():
        came = " ".join(f"{value:g}" for value in (*quaternion, *position))
        raise ValueError(f"{source}: expected a rigid pose (a quaternion of length 1 and a position), got {came}")
    pose = from_quaternion(position, quaternion, source)
    return pose @ _ARKIT_TO_DSR if opengl else pose


def check_pose(source: str, matrix: np.ndarray, *, opengl: bool = False) -> np.ndarray:
    """Return a matrix (4, 4) from camera to world with the camera's axes x right, y down, z forward.

    Args:
        source: name of the file and the place in it, for the message.
        matrix: (4, 4), in metres.
        opengl: see :func:`pose_from_quaternion`.

    Raises:
        ValueError: it is no rigid motion.

    """
    rigid = (
        bool(np.isfinite(matrix).all())
        and is_rotation(matrix[:3, :3], _TOLERANCE)
        and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)
    )
    if not rigid:
        came = " ".join(f"{value:.4g}" for value in matrix.ravel())
        raise ValueError(f"{source}: expected a rigid pose (a rotation and a position), got {came}")
    return matrix @ _ARKIT_TO_DSR if opengl else matrix


def intrinsics_camera(source: str, size: tuple[int, int], numbers: Sequence[float]) -> Camera:
    """Return the camera of fx, fy, cx, cy in pixels of an image of (height, width).

    Raises:
        ValueError: they are those of no camera; the message begins with ``source``.

    """
    fx, fy, cx, cy = numbers
    try:
        if fy <= 0:
            raise ValueError(f"camera fy: expected a positive number of pixels, got {fy!r}")
        return Camera(size[1], size[0], fx, fy, cx, cy)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def describe_capture(app: str, unit: str, pairs: Sequence[Pair], *, poses: bool) -> Assumption:
    """Return what a capture says itself, as a line for the user.

    Args:
        app: what it is a capture of.
        unit: of its depth maps.
        pairs: its frames.
        poses: whether it has poses.

    """
    parts = ["intrinsics", *(["poses"] if poses else [])]
    parts += ["confidence"] if any(pair.confidence is not None for pair in pairs) else []
    return Assumption(f"{app}: depth in {unit}; from the capture: {', '.join(parts)}")


def read_text(path: Path, limit: int = 1 << 26) -> str:
    """Return the text of a file of a capture.

    Raises:
        ValueError: it is missing or larger than ``limit`` bytes.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a file of the capture, there is none")
    return read_limited(path, limit).decode("utf-8-sig", errors="replace")
