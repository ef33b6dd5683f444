"""Rigid transforms between camera frames: 4 x 4 matrices that map points, in metres.

A pose is the transform from a camera's frame (x right, y down, z forward) to the world's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

_TOLERANCE = 5e-3
"""Largest deviation of the product of a rotation with its transpose from the identity: matrices of few decimals."""


def as_rigid(values: Sequence[Sequence[float]] | np.ndarray, name: str) -> Matrix:
    """Return a rigid transform as a 4 x 4 matrix whose rotation is orthonormal to rounding.

    Args:
        values: 3 x 4 or 4 x 4 numbers, the translation in the last column.
        name: what the message begins with, such as the file that the numbers are from.

    Raises:
        ValueError: the numbers have another shape, are not finite, or are no rotation and translation.

    """
    try:
        matrix = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected a matrix of 3 x 4 or 4 x 4 numbers, got something else") from None
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(
            f"{name}: expected a matrix of 3 x 4 or 4 x 4 numbers, got {' x '.join(map(str, matrix.shape))}"
        )
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: expected finite numbers, got {matrix[~np.isfinite(matrix)][0]}")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise ValueError(f"{name}: expected 0 0 0 1 as the last row, got {_text(matrix[3])}")
    return _with_rotation(matrix, name)


def _with_rotation(matrix: Matrix, name: str) -> Matrix:
    """Return the transform with the nearest rotation, after checking that it has one."""
    turn = matrix[:3, :3]
    error = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if error > _TOLERANCE:
        lengths = np.linalg.norm(turn, axis=1)
        raise ValueError(
            f"{name}: expected a rigid transform, got rows of length {_text(lengths)} that do not form one"
        )
    if np.linalg.det(turn) < 0:
        raise ValueError(f"{name}: expected a rigid transform, got one that mirrors")
    left, _, right = np.linalg.svd(turn)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, matrix[:3, 3]
    return rigid


def from_quaternion(translation: Sequence[float], quaternion: Sequence[float], name: str) -> Matrix:
    """Return the transform of a translation in metres and a unit quaternion (x, y, z, w).

    Raises:
        ValueError: a number is not finite, or the quaternion's length is not 1 to within 1 %.

    """
    x, y, z, w = np.asarray(quaternion, dtype=np.float64)
    length = float(np.sqrt(x * x + y * y + z * z + w * w))
    if not abs(length - 1) <= 0.01:
        raise ValueError(f"{name}: expected a quaternion of length 1, got {length:g}")
    x, y, z, w = (value / length for value in (x, y, z, w))
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return as_rigid(np.column_stack((turn, np.asarray(translation, dtype=np.float64))), name)


def invert(transform: Matrix) -> Matrix:
    """Return the inverse of a rigid transform."""
    turn, shift = transform[:3, :3], transform[:3, 3]
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = turn.T, -turn.T @ shift
    return inverse


def relative(pose: Matrix, to: Matrix) -> Matrix:
    """Return the transform from the frame of the camera at ``pose`` to that of the camera at ``to``."""
    return invert(to) @ pose


def _text(values: np.ndarray) -> str:
    """Return numbers for a message."""
    return " ".join(f"{value:.4g}" for value in values)
