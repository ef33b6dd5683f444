"""Surfaces as compact data for web pages: inverse depth in 24 bits, connectivity of pixels, and expected errors.

Inverse depth is linear in the pixel on every plane, so the upper left, upper and left neighbours predict a pixel of a
plane exactly. Only the deviation from this prediction is stored, compressed in zlib's format (RFC 1950), which browsers
can read. 24 bits are the precision of the 32-bit floats that graphics cards compute with. 16 bits would not be enough:
for a range of 0.3 to 10 m they mean steps of 5 mm at the far end, which are visible as terraces.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import LARGEST_STEP, find_connections

Joints = tuple[np.ndarray, np.ndarray]
"""Which pixels of an (h, w) map are joined: with their right neighbours, (h, w - 1), and those below, (h - 1, w)."""

LEVELS = 2**24 - 1
"""Highest level of inverse depth; 1 is the lowest, 0 is a hole."""
ERROR_LEVELS = 255
"""Highest level of an error; 1 is the lowest, 0 is unknown."""
RIGHT, BELOW, RIGHT_WITH_DOUBTFUL, BELOW_WITH_DOUBTFUL, DOUBTFUL, FILLED = 1, 2, 4, 8, 16, 32
"""Flags of a pixel: joined to its right neighbour and to the one below, without and with doubtful pixels; doubtful;
not measured."""
_STRIP = 1 << 20
"""Pixels whose joints are looked for at a time."""


@dataclass(frozen=True)
class Grid:
    """A surface as a map, perhaps with fewer pixels than the one that it shows."""

    depth: np.ndarray  # (h, w) orthogonal depth in metres, NaN in holes
    camera: Camera  # of these pixels
    factor: int  # pixels of the whole map side by side in one of these
    joints: Joints  # of these pixels
    doubtful: np.ndarray  # (h, w) bool, pixels that the mesh leaves out
    certain: Joints  # joints without doubtful pixels
    errors: Mapping[str, np.ndarray]  # levels of the expected errors by name, (h, w) uint8 each
    filled: np.ndarray | None = None  # (h, w) bool, pixels whose depth was not measured; None where that is not known


def factor_for(height: int, width: int, most: int) -> int:
    """Return the smallest whole factor by which a map has to be reduced to have at most ``most`` pixels."""
    factor = 1
    while factor < min(height, width) // 2 and (height // factor) * (width // factor) > most:
        factor += 1
    return factor


def reduce_depth(depth: np.ndarray, factor: int) -> np.ndarray:
    """Reduce a map, (H, W) in metres, by a whole factor without mixing surfaces; rows and columns that remain are cut.

    The inverse depth of a block is the mean of those pixels that lie within :data:`dsr.geometry.mesh.LARGEST_STEP` of
    the block's median. A block of which less than half is known is a hole.
    """
    if factor == 1:
        return depth.astype(np.float64)
    with np.errstate(divide="ignore"):
        blocks = _blocks(1 / depth.astype(np.float64), factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=-1)
    ordered = np.sort(blocks, axis=-1)  # NaN comes last
    at = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, at[..., None], axis=-1)
    near = known & (np.abs(blocks - median) <= LARGEST_STEP * np.abs(median))
    total = np.where(near, blocks, 0).sum(axis=-1)
    hole = 2 * count < factor * factor
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(hole, np.nan, near.sum(axis=-1) / total)


def reduce_errors(errors: np.ndarray, factor: int) -> np.ndarray:
    """Reduce errors, (H, W), by the mean of the known ones in each block; NaN where there is none."""
    if factor == 1:
        return errors.astype(np.float64)
    blocks = _blocks(errors.astype(np.float64), factor)
    known = np.isfinite(blocks)
    with np.errstate(invalid="ignore"):
        return np.where(known, blocks, 0).sum(axis=-1) / known.sum(axis=-1)


def reduce_mask(mask: np.ndarray, factor: int) -> np.ndarray:
    """Reduce a mask, (H, W) bool: true where at least half of a block is."""
    return mask if factor == 1 else 2 * _blocks(mask, factor).sum(axis=-1) >= factor * factor


def find_joints(depth: np.ndarray, factor: int) -> Joints:
    """Return which blocks of a map, (H, W) in metres, a mesh of the whole map joins.

    Two neighbouring blocks are joined if at least half of the rows (or columns) have no cut between the middles of the
    two. Cuts found in the reduced map would be too many: the larger the pixels, the more a surface bends between them.
    """
    return _joined_along(depth, factor), _joined_along(depth.T, factor).T


def error_levels(errors: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return errors, (h, w), on a logarithmic scale as uint8: 1 is ``low`` or less, 255 ``high`` or more, 0 unknown."""
    known = np.isfinite(errors)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(np.maximum(errors, low) / low) / np.log(high / low)
    levels = 1 + np.rint((ERROR_LEVELS - 1) * np.clip(np.where(known, share, 0), 0, 1))
    return np.where(known, levels, 0).astype(np.uint8)


def pack_grid(grid: Grid) -> tuple[dict[str, Any], str]:
    """Return the header of a surface for the page, and its data as base64.

    The data are bytes compressed by zlib, in planes of h x w bytes: the high, middle and low byte of the deviation of
    inverse depth from its prediction modulo 2**24, the flags, and the levels of each error in order.
    """
    camera, valid = grid.camera, np.isfinite(grid.depth)
    inverse = 1 / grid.depth
    low, high = (float(inverse[valid].min()), float(inverse[valid].max())) if valid.any() else (1.0, 1.0)
    span = max(high - low, 1e-6 * high)
    steps = np.where(valid, np.nan_to_num((inverse - low) / span), 0)
    levels = np.where(valid, 1 + np.rint(steps * (LEVELS - 1)), 0).astype(np.int64)
    padded = np.pad(levels, ((1, 0), (1, 0)))  # beyond the border, neighbours are 0
    rest = (levels - padded[1:, :-1] - padded[:-1, 1:] + padded[:-1, :-1]) & LEVELS
    planes = [(rest >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]
    planes += [_flags(grid), *grid.errors.values()]
    data = zlib.compress(b"".join(plane.tobytes() for plane in planes), 9)
    about = {
        "width": camera.width,
        "height": camera.height,
        "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
        "range": [low, low + span],
        "levels": LEVELS,
        "errors": list(grid.errors),
        "factor": grid.factor,
    }
    return about, base64.b64encode(data).decode()


def _blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """Return the blocks of a map, (H, W), as (H // factor, W // factor, factor**2)."""
    height, width = values.shape[0] // factor, values.shape[1] // factor
    cut = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return cut.transpose(0, 2, 1, 3).reshape(height, width, factor * factor)


def _flags(grid: Grid) -> np.ndarray:
    """Return the flags of the pixels, (h, w) uint8."""
    flags = np.where(grid.doubtful, DOUBTFUL, 0).astype(np.uint8)
    if grid.filled is not None:
        flags |= np.where(grid.filled, FILLED, 0).astype(np.uint8)
    valid = np.isfinite(grid.depth)
    for (across, down), there, right, below in (
        (grid.certain, valid & ~grid.doubtful, RIGHT, BELOW),
        (grid.joints, valid, RIGHT_WITH_DOUBTFUL, BELOW_WITH_DOUBTFUL),
    ):
        flags[:, :-1] |= np.where(across & there[:, 1:] & there[:, :-1], right, 0).astype(np.uint8)
        flags[:-1] |= np.where(down & there[1:] & there[:-1], below, 0).astype(np.uint8)
    return flags


def _joined_along(depth: np.ndarray, factor: int) -> np.ndarray:
    """Return which blocks of a map, (H, W), are joined with their right neighbours."""
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    joined = np.empty((height, width - 1), bool)
    rows = max(1, _STRIP // (depth.shape[1] * factor))
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        across, _ = find_connections(1 / depth[start * factor : stop * factor].astype(np.float64))
        broken = np.pad(np.cumsum(~across, axis=1), ((0, 0), (1, 0)))  # number of cuts left of each pixel
        middles = factor // 2 + factor * np.arange(width)
        whole = broken[:, middles[1:]] == broken[:, middles[:-1]]
        joined[start:stop] = 2 * whole.reshape(stop - start, factor, width - 1).sum(axis=1) >= factor
    return joined
