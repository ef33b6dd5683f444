"""Inpainting of the holes of a data set's depth, for evaluation without holes.

Inside a hole inverse depth solves Laplace's equation with the values at the hole's rim as boundary. Where the rim has a
depth step, as at occlusions in stereo, only its farther part is used, because the background is what the second camera
does not see.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage, sparse
from scipy.sparse import linalg
from torch import Tensor

_STEP = 0.05
"""Smallest relative gap between the sorted inverse depths of a rim that is a depth step."""
_SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))


def inpaint_depth(depth: Tensor) -> Tensor:
    """Return a depth map with its holes inpainted.

    Args:
        depth: (1, H, W) orthogonal depth in metres, NaN where missing; at least one pixel is valid.

    Returns:
        (1, H, W) float64; valid pixels are unchanged.

    """
    inverse = 1 / depth[0].double().numpy()
    holes = np.isnan(inverse)
    if not holes.any():
        return depth.double()
    labels, count = ndimage.label(holes)
    for label, place in zip(range(1, count + 1), ndimage.find_objects(labels), strict=True):
        window = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in place)
        hole = labels[window] == label
        rim = ndimage.binary_dilation(hole) & ~holes[window]
        used = rim & (inverse[window] <= _farther_part(inverse[window][rim]))
        inverse[window][hole] = _solve_laplace(np.where(used, inverse[window], 0), hole, used)
    return torch.from_numpy(1 / inverse)[None]


def _farther_part(rim: np.ndarray) -> float:
    """Return the largest inverse depth of the rim's part beyond a depth step, or of the whole rim if it has none."""
    values = np.sort(rim)
    gaps = np.diff(values)
    if not gaps.size or gaps.max() <= _STEP * values[0]:
        return float(values[-1])
    return float(values[gaps.argmax()])


def _solve_laplace(values: np.ndarray, hole: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return the harmonic values of the pixels of a hole, given those of its rim."""
    number = np.full(hole.shape, -1)
    number[hole] = np.arange(hole.sum())
    rows, columns, count = [], [], np.zeros(hole.sum())
    right = np.zeros(hole.sum())
    for step in _SIDES:
        there = np.roll(number, step, (0, 1))
        known, beside = np.roll(rim, step, (0, 1)), np.roll(values, step, (0, 1))
        _clear_wrapped(step, there, known)
        inner = hole & (there >= 0)
        rows.append(number[inner])
        columns.append(there[inner])
        count += ((there >= 0) | known)[hole]
        right += np.where(known, beside, 0)[hole]
    coupling = sparse.csr_matrix(
        (-np.ones(sum(map(len, rows))), (np.concatenate(rows), np.concatenate(columns))), (count.size, count.size)
    )
    solution: np.ndarray = linalg.spsolve((sparse.diags(count) + coupling).tocsc(), right)
    return solution


def _clear_wrapped(step: tuple[int, int], number: np.ndarray, known: np.ndarray) -> None:
    """Clear the row or column that a roll moved in from the opposite side."""
    edge = (slice(None), 0 if step[1] > 0 else -1) if step[1] else (0 if step[0] > 0 else -1, slice(None))
    number[edge], known[edge] = -1, False
