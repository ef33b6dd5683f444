"""Tiled processing, which bounds memory for images of any size.

An image is split into tiles of low-resolution pixels. The output of a tile is computed from a window that contains the
tile, half of the overlap with its neighbours, and a margin of the receptive-field radius. Neighbouring outputs
therefore agree where they overlap. They are blended there with linear ramps whose weights add up to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsr.utils.progress import Steps

TILE = 1024
"""Side of a tile in high-resolution pixels."""
UNTILED = 2**21
"""Number of high-resolution pixels up to which an image is processed without tiles."""


@dataclass(frozen=True)
class AxisTile:
    """A tile along one axis, in low-resolution pixels.

    Args:
        read: pixels of the window that the output is computed from.
        kept: pixels of the output that are used.
        ramps: number of used pixels that are blended with the previous and with the next tile, 0 at a border.

    """

    read: slice
    kept: slice
    ramps: tuple[int, int]

    def weights(self, scale: int) -> Tensor:
        """Return the weight of each used high-resolution pixel, (scale * kept,) float32: 1, with ramps at the ends."""
        size = scale * (self.kept.stop - self.kept.start)
        weights = torch.ones(size)
        first, last = (scale * ramp for ramp in self.ramps)
        weights[:first] = _ramp(first)
        weights[size - last :] = 1 - _ramp(last)
        return weights


def split_axis(size: int, tile: int, radius: int, overlap: int) -> list[AxisTile]:
    """Split an axis into tiles whose sizes differ by one pixel at most.

    Args:
        size: size of the image in low-resolution pixels.
        tile: maximum size of a tile without its overlaps, in low-resolution pixels.
        radius: receptive-field radius in low-resolution pixels.
        overlap: overlap of neighbouring tiles, an even number of low-resolution pixels; no tile is smaller.

    Raises:
        ValueError: a number is out of range.

    """
    if min(size, tile) < 1 or radius < 0 or overlap < 0 or overlap % 2:
        raise ValueError(
            f"tiles: expected a positive size and tile, a radius and an even overlap, "
            f"got {size}, {tile}, {radius}, {overlap}"
        )
    count = max(1, min(math.ceil(size / tile), size // max(overlap, 1)))
    edges = [round(i * size / count) for i in range(count + 1)]
    half = overlap // 2
    found = []
    for i in range(count):
        before, after = (half if i else 0), (half if i + 1 < count else 0)
        first, last = edges[i] - before, edges[i + 1] + after
        read = slice(max(first - radius, 0), min(last + radius, size))
        found.append(AxisTile(read, slice(first, last), (2 * before, 2 * after)))
    return found


def blend_tiles(
    compute: Callable[[slice, slice], Tensor],
    rows: list[AxisTile],
    columns: list[AxisTile],
    scale: int,
    progress: Steps | None = None,
) -> Tensor:
    """Compute an image tile by tile and blend the tiles.

    Args:
        compute: function from rows and columns of low-resolution pixels to their high-resolution pixels, (B, C,
            scale * rows, scale * columns). It may leave out the last high-resolution row and column.
        rows: tiles along the rows, from :func:`split_axis`.
        columns: tiles along the columns.

    Returns:
        (B, C, scale * h, scale * w), less the row and column that ``compute`` leaves out.

    Raises:
        ValueError: there is no tile.

    """
    total: Tensor | None = None
    done = 0
    for row in rows:
        for column in columns:
            output = compute(row.read, column.read)
            lost = [
                scale * (tile.read.stop - tile.read.start) - n
                for tile, n in zip((row, column), output.shape[-2:], strict=True)
            ]
            if total is None:
                size = [scale * tiles[-1].kept.stop - n for tiles, n in zip((rows, columns), lost, strict=True)]
                total = output.new_zeros((*output.shape[:-2], *size))
            (to_y, from_y), (to_x, from_x) = (
                _place(tile, scale, n) for tile, n in zip((row, column), total.shape[-2:], strict=True)
            )
            weight_y, weight_x = (tile.weights(scale).to(total) for tile in (row, column))
            part = output[..., from_y, from_x] * weight_y[: to_y.stop - to_y.start, None]
            total[..., to_y, to_x] += part.mul_(weight_x[: to_x.stop - to_x.start])
            done += 1
            if progress is not None:
                progress(done, len(rows) * len(columns))
    if total is None:
        raise ValueError("tiles: expected at least one, got none")
    return total


def _place(tile: AxisTile, scale: int, size: int) -> tuple[slice, slice]:
    """Return the positions of a tile's used high-resolution pixels, in the image and in the tile's output."""
    first, last = scale * tile.kept.start, min(scale * tile.kept.stop, size)
    offset = scale * tile.read.start
    return slice(first, last), slice(first - offset, last - offset)


def _ramp(width: int) -> Tensor:
    """Return weights that rise from 0 to 1, at the centres of ``width`` pixels."""
    return (torch.arange(width) + 0.5) / max(width, 1)
