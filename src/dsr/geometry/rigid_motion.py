"""Rigid transforms between camera frames: 4 x 4 matrices that map points, in metres.

A pose is the transform from a camera's frame (x right, y down, z forward) to the world's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

# largest deviation of the product of a rotation with its transpose from the identity: matrices of few decimals
_TOLERANCE = 5e-3


def as_rigid(values: Sequence[Sequence[float]] | np.ndarray, name: str) -> Matrix:
    """Return a 3 x 4 or 4 x 4 transform as a 4 x 4 matrix whose rotation is orthonormal to rounding.

    Errors begin with ``name``, such as the file that the numbers are from.
    """
    expected = f"{name}: expected a matrix of 3 x 4 or 4 x 4 numbers, got"
    try:
        if not isinstance(values, np.ndarray) and any(isinstance(each, bool | str) for row in values for each in row):
            raise TypeError
        matrix = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{expected} something else") from None
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{expected} {' x '.join(map(str, matrix.shape))}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: expected finite numbers, got {matrix[~np.isfinite(matrix)][0]}")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        columns = np.allclose(matrix[:, 3], (0, 0, 0, 1), atol=1e-6)
        hint = "; are rows and columns exchanged?" if columns else ""
        row = " ".join(f"{value:.4g}" for value in matrix[3])
        raise ValueError(f"{name}: expected 0 0 0 1 as the last row, got {row}{hint}")
    turn = matrix[:3, :3]
    if not orthonormal_error(turn) <= _TOLERANCE:  # NaN is none either
        lengths = " ".join(f"{math.hypot(*row):.4g}" for row in turn)
        raise ValueError(f"{name}: expected a rigid transform, got rows of length {lengths} that do not form one")
    if np.linalg.det(turn) < 0:
        raise ValueError(f"{name}: expected a rigid transform, got one that mirrors")
    left, _, right = np.linalg.svd(turn)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, matrix[:3, 3]
    return rigid


def orthonormal_error(turn: np.ndarray) -> float:
    """Return how far the rows of a matrix R, (3, 3), are from orthonormal: the largest magnitude in R R' - 1.

    It is infinite or NaN where the numbers are too large for that.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(turn @ turn.T - np.eye(3)).max())


def is_rotation(turn: np.ndarray, tolerance: float) -> bool:
    """Return whether a matrix, (3, 3), is a rotation to within a tolerance of :func:`orthonormal_error`."""
    return orthonormal_error(turn) <= tolerance and float(np.linalg.det(turn)) > 0


def from_quaternion(translation: Sequence[float], quaternion: Sequence[float], name: str) -> Matrix:
    """Return the transform of a translation in metres and a unit quaternion (x, y, z, w)."""
    length = math.hypot(*quaternion)
    if not abs(length - 1) <= 0.01:
        raise ValueError(f"{name}: expected a quaternion of length 1, got {length:g}")
    return as_rigid(np.column_stack((rotation_of_quaternion(quaternion), translation)), name)


def rotation_of_quaternion(quaternion: Sequence[float]) -> Matrix:
    """Return the 3 x 3 rotation of a quaternion (x, y, z, w) of any length but 0."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a third of a second that frames without poses save

    turn: Matrix = Rotation.from_quat(quaternion).as_matrix()
    return turn


def quaternion_of(rotation: Matrix) -> np.ndarray:
    """Return the unit quaternion (x, y, z, w) with w >= 0 of a 3 x 3 rotation."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def invert(transform: Matrix) -> Matrix:
    """Return the inverse of a rigid transform."""
    turn, shift = transform[:3, :3], transform[:3, 3]
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = turn.T, -turn.T @ shift
    return inverse


def relative(pose: Matrix, to: Matrix) -> Matrix:
    """Return the transform from the frame of the camera at ``pose`` to that of the camera at ``to``."""
    return invert(to) @ pose
