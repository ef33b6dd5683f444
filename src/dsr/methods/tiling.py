"""Answering an image window by window, so that memory is bounded whatever the image's size.

An image is cut into tiles of low-resolution pixels. A tile's answer is computed from a window which holds the tile,
half of the overlap with its neighbours, and as much around that as the answer depends on, so tiles answer alike where
they overlap; there they are blended with linear ramps, whose weights add up to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsr.utils.progress import Steps


@dataclass(frozen=True)
class Span:
    """A tile along one axis, in low-resolution pixels.

    Args:
        read: what its window holds.
        kept: what its answer counts for.
        ramps: how many of these pixels share their weight with the tile before and with the one after, 0 at a border.

    """

    read: slice
    kept: slice
    ramps: tuple[int, int]

    def weights(self, scale: int) -> Tensor:
        """Return how much each kept HR pixel counts, (scale * kept,) float32: 1, and linear ramps at the ends."""
        size = scale * (self.kept.stop - self.kept.start)
        weights = torch.ones(size)
        first, last = (scale * ramp for ramp in self.ramps)
        weights[:first] = _ramp(first)
        weights[size - last :] = 1 - _ramp(last)
        return weights


def spans(size: int, tile: int, reach: int, overlap: int) -> list[Span]:
    """Return the tiles along an axis, as equal in size as whole pixels allow.

    Args:
        size: of the image in low-resolution pixels.
        tile: the most of them that a tile has, without the overlap.
        reach: how far beyond a pixel its answer looks.
        overlap: the width that neighbouring tiles share, an even number of low-resolution pixels; tiles are at least as
            wide.

    Raises:
        ValueError: a number is out of range.

    """
    if min(size, tile) < 1 or reach < 0 or overlap < 0 or overlap % 2:
        raise ValueError(
            f"tiles: expected a positive size and tile, a reach and an even overlap, "
            f"got {size}, {tile}, {reach}, {overlap}"
        )
    count = max(1, min(math.ceil(size / tile), size // max(overlap, 1)))
    edges = [round(i * size / count) for i in range(count + 1)]
    half = overlap // 2
    found = []
    for i in range(count):
        before, after = (half if i else 0), (half if i + 1 < count else 0)
        first, last = edges[i] - before, edges[i + 1] + after
        read = slice(max(first - reach, 0), min(last + reach, size))
        found.append(Span(read, slice(first, last), (2 * before, 2 * after)))
    return found


def blended(
    answer: Callable[[slice, slice], Tensor],
    rows: list[Span],
    columns: list[Span],
    scale: int,
    progress: Steps | None = None,
) -> Tensor:
    """Return the image that the tiles' answers make up.

    Args:
        answer: from rows and columns of low-resolution pixels to their high-resolution pixels, (B, C, scale * rows,
            scale * columns); it may leave out a high-resolution row and column at the end, and so will the image.
        rows: the tiles along the rows, of :func:`spans`.
        columns: the same along the columns.
        scale: high-resolution pixels per low-resolution one.
        progress: is told after each tile.

    Returns:
        (B, C, scale * h, scale * w), less what the answers leave out.

    """
    total: Tensor | None = None
    done = 0
    for row in rows:
        for column in columns:
            fine = answer(row.read, column.read)
            lost = [
                scale * (s.read.stop - s.read.start) - n for s, n in ((row, fine.shape[-2]), (column, fine.shape[-1]))
            ]
            if total is None:
                size = [scale * spans[-1].kept.stop - n for spans, n in zip((rows, columns), lost, strict=True)]
                total = fine.new_zeros((*fine.shape[:-2], *size))
            (to_y, from_y), (to_x, from_x) = (
                _places(span, scale, n) for span, n in zip((row, column), total.shape[-2:], strict=True)
            )
            weight_y, weight_x = (span.weights(scale).to(total) for span in (row, column))
            part = fine[..., from_y, from_x] * weight_y[: to_y.stop - to_y.start, None]
            total[..., to_y, to_x] += part.mul_(weight_x[: to_x.stop - to_x.start])
            done += 1
            if progress is not None:
                progress(done, len(rows) * len(columns))
    if total is None:
        raise ValueError("tiles: expected at least one, got none")
    return total


def _places(span: Span, scale: int, size: int) -> tuple[slice, slice]:
    """Return which high-resolution pixels of the image a tile's kept ones are, and where they lie in its answer."""
    first, last = scale * span.kept.start, min(scale * span.kept.stop, size)
    offset = scale * span.read.start
    return slice(first, last), slice(first - offset, last - offset)


def _ramp(width: int) -> Tensor:
    """Return weights from 0 to 1 at the centres of ``width`` pixels."""
    return (torch.arange(width) + 0.5) / max(width, 1)
