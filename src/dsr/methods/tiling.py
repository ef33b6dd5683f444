"""Tiled processing, which bounds memory for images of any size.

An image is split into tiles of low-resolution pixels. The output of a tile is computed from a window that contains the
tile, half of the overlap with its neighbours, and a margin of the receptive-field radius. Neighbouring outputs
therefore agree where they overlap. They are blended there with linear ramps whose weights add up to 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsr.utils.progress import Steps

TILE = 1024  # side of a tile in high-resolution pixels
UNTILED = 2**21  # number of high-resolution pixels up to which an image is processed without tiles


@dataclass(frozen=True)
class AxisTile:
    """A tile along one axis, in low-resolution pixels.

    ``read`` are the pixels of the window that the output is computed from, ``kept`` those of the output that are used,
    ``ramps`` the numbers of used pixels that are blended with the previous and with the next tile, 0 at a border.
    """

    read: slice
    kept: slice
    ramps: tuple[int, int]

    def weights(self, scale: int) -> Tensor:
        """Return the weight of each used high-resolution pixel, (scale * kept,) float32: 1, with ramps at the ends."""
        weights = torch.ones(scale * (self.kept.stop - self.kept.start))
        rising, falling = ((torch.arange(scale * ramp) + 0.5) / max(scale * ramp, 1) for ramp in self.ramps)
        weights[: len(rising)] = rising
        weights[len(weights) - len(falling) :] = 1 - falling
        return weights


def split_axis(size: int, tile: int, radius: int, overlap: int) -> list[AxisTile]:
    """Split an axis of low-resolution pixels into tiles whose sizes differ by one pixel at most.

    ``tile`` is the maximum size of a tile without its overlaps, ``radius`` that of the receptive field,
    ``overlap`` that of neighbouring tiles, even; no tile is smaller.
    """
    count = max(1, min(math.ceil(size / tile), size // max(overlap, 1)))
    edges, half, found = [round(i * size / count) for i in range(count + 1)], overlap // 2, []
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
    """Compute an image, (B, C, scale * h, scale * w), tile by tile and blend the tiles.

    ``compute`` maps rows and columns of low-resolution pixels to their high-resolution pixels. It may leave out the
    last high-resolution row and column, which the result then lacks.
    """
    total: Tensor | None = None
    for done, (row, column) in enumerate(itertools.product(rows, columns), 1):
        output = compute(row.read, column.read)
        if total is None:
            lost_y = scale * (row.read.stop - row.read.start) - output.shape[-2]
            lost_x = scale * (column.read.stop - column.read.start) - output.shape[-1]
            size = (scale * rows[-1].kept.stop - lost_y, scale * columns[-1].kept.stop - lost_x)
            total = output.new_zeros((*output.shape[:-2], *size))
        top, left = scale * row.kept.start, scale * column.kept.start
        target = total[..., top : scale * row.kept.stop, left : scale * column.kept.stop]
        height, width = target.shape[-2:]
        y, x = top - scale * row.read.start, left - scale * column.read.start
        part = output[..., y : y + height, x : x + width] * row.weights(scale)[:height, None].to(total)
        target += part.mul_(column.weights(scale)[:width].to(total))
        if progress is not None:
            progress(done, len(rows) * len(columns))
    assert total is not None  # noqa: S101 - for the type checker: there is a tile
    return total
