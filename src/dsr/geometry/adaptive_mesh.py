"""Adaptive triangulation of a depth map: large triangles where the surface is flat; vertices are pixels of the map.

A hierarchy of right triangles (Evans, Kirkpatrick and Townsend, *Right-Triangulated Irregular Networks*, Algorithmica
2001): a triangle is halved from its right angle to the middle of its longest side, as long as leaving out the pixel in
that middle changes the inverse depth there by too much. The pixels of a smaller triangle count for the larger ones that
hold it, so that neighbours always share whole sides. In inverse depth a plane is linear at any viewing angle, and needs
no pixel but its corners. Squares at holes and steps in depth are not joined.
"""

from __future__ import annotations

import numpy as np

_LEVELS = 6  # the largest triangles have two sides of 2 to this power pixels


def join(inverse: np.ndarray, whole: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join the pixels of a surface by triangles of up to 64 x 64 pixels.

    Args:
        inverse: (H, W) inverse depth in 1/m, NaN in holes.
        whole: (H - 1, W - 1) bool, which squares of four pixels are one surface; the others keep all their pixels.
        tolerance: (H, W) by how much leaving out a pixel may change the inverse depth there, in 1/m; NaN for not at
            all. It holds for each halving: up to 2 % of the pixels differ by more, about twice as much at most.

    Returns which squares are left at full density, for two triangles each, and all other triangles, (M, 3) indices into
    the flattened map, counterclockwise as the camera sees them.
    """
    height, width = whole.shape
    side = 1 << _LEVELS
    rows, columns = (-(-size // side) for size in whole.shape)  # of the largest squares
    values, allowed = np.full((2, rows * side + 1, columns * side + 1), np.nan, np.float32)
    values[: height + 1, : width + 1], allowed[: height + 1, : width + 1] = inverse, tolerance
    split = ~np.pad(whole, ((0, rows * side - height), (0, columns * side - width)))
    triangles, small = _leaves(_needed(values, allowed, split), rows, columns)
    pitch = values.shape[1]
    squares = np.minimum.reduce(small // pitch, axis=1) * pitch + np.minimum.reduce(small % pitch, axis=1)
    found = np.bincount(squares, minlength=values.size)
    dense = (found == 2).reshape(values.shape)[:height, :width]
    triangles = np.concatenate((triangles, small[found[squares] == 1]))
    place = triangles // pitch * (width + 1) + triangles % pitch
    return dense, place.astype(np.int32)


def _needed(values: np.ndarray, allowed: np.ndarray, split: np.ndarray) -> np.ndarray:
    """Return the largest change by leaving out a pixel, or one that only exists where it does, over what is allowed."""
    needed = np.zeros(values.shape, np.float32)
    for corner in (needed[:-1, :-1], needed[1:, :-1], needed[:-1, 1:], needed[1:, 1:]):
        corner[split] = np.inf
    for level in range(_LEVELS):
        half = 1 << level
        side = 2 * half
        _sides(values, allowed, needed, half)
        _sides(values.T, allowed.T, needed.T, half)
        lattice = values[::side, ::side]
        falling = np.add.outer(np.arange(len(lattice) - 1), np.arange(lattice.shape[1] - 1)) % 2 == 0
        ends = np.where(falling, lattice[:-1, :-1] + lattice[1:, 1:], lattice[:-1, 1:] + lattice[1:, :-1])
        at = np.s_[half::side, half::side]
        beside = (needed[:-1:side, half::side], needed[side::side, half::side],
                  needed[half::side, :-1:side], needed[half::side, side::side])  # fmt: skip
        needed[at] = np.maximum.reduce((needed[at], _change(values[at], ends, allowed[at]), *beside))
    return needed


def _sides(values: np.ndarray, allowed: np.ndarray, needed: np.ndarray, half: int) -> None:
    """Note what the pixels in the middles of the horizontal sides of squares are needed for."""
    side = 2 * half
    at = np.s_[::side, half::side]
    middles = needed[at]
    ends = values[::side, :-1:side] + values[::side, side::side]
    middles[:] = np.maximum(middles, _change(values[at], ends, allowed[at]))
    if half > 1:
        smaller = needed[half // 2 :: half, half // 2 :: half]  # of the squares around
        smaller = np.maximum(smaller[:, ::2], smaller[:, 1::2])
        middles[:-1] = np.maximum(middles[:-1], smaller[::2])
        middles[1:] = np.maximum(middles[1:], smaller[1::2])


def _change(values: np.ndarray, ends: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return how far values are from the mean of two, given by its sum, over what is allowed; infinite if unknown."""
    return np.nan_to_num(np.abs(values - ends / 2) / allowed, nan=np.inf)


def _leaves(needed: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles, (M, 3), and those of half a square of four pixels, as indices with the right angle last."""
    pitch, side = needed.shape[1], 1 << _LEVELS
    row, column = np.divmod(np.arange(rows * columns), columns)
    first = (row * pitch + column) * side
    second, third, fourth = first + side, first + side * pitch, first + side * pitch + side
    falling = (row + column) % 2 == 0
    upper = np.where(falling, (first, fourth, second), (third, second, first))
    lower = np.where(falling, (fourth, first, third), (second, third, fourth))
    corners, done = np.concatenate((upper, lower), axis=1), []
    for _ in range(2 * _LEVELS):
        a, b, c = corners
        split = needed.ravel()[(a + b) // 2] > 1
        done.append(corners[:, ~split])
        a, b, c = corners[:, split]
        middle = (a + b) // 2
        corners = np.concatenate(((c, a, middle), (b, c, middle)), axis=1)
    return np.concatenate(done, axis=1).T, corners.T
