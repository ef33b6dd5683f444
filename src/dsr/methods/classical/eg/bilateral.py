"""The modified joint bilateral filter of edge-guided upsampling: means that do not cross edges.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016. For the differences from the
original see :mod:`dsr.methods.classical.eg.upsampler`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.classical.finite_differences import box_mean, repeat_blocks, upsample_linear_border
from dsr.methods.classical.photo_guided import estimate_slopes
from dsr.methods.inpainting import inpaint

_CHUNK = 4096
"""Low-resolution pixels that are flooded at once."""
_BESIDE = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns from a pixel to its neighbours, the nearest first."""


class _Planes(NamedTuple):
    """Planes of low-resolution pixels, each (h, w): value, slope per row and per column, and weight."""

    values: Tensor
    down: Tensor
    across: Tensor
    trust: Tensor


def bilateral_filter(
    lr: Tensor,
    barrier: Tensor,
    scale: int,
    radius: int,
    sigma_space: float,
    mixed: float,
    *,
    doubtful: Tensor | None = None,
    sharp: bool = True,
) -> Tensor:
    """Upsample a map, (h, w), by the modified joint bilateral filter to (H, W); holes stay holes.

    Args:
        lr: (h, w) map with at least one valid pixel, NaN in holes.
        barrier: (H, W) bool, the edge map.
        scale: high-resolution pixels per low-resolution one.
        radius: radius of the neighbourhood in low-resolution pixels.
        sigma_space: standard deviation of the distance's Gaussian, in low-resolution pixels.
        mixed: weight of a low-resolution pixel with an edge through it, relative to others.
        doubtful: (h, w) bool, further low-resolution pixels that mix two sides; None for none.
        sharp: whether pixels on edges take a side; otherwise they keep the value that preserves the block means.

    """
    valid = lr.isfinite()
    doubtful = torch.zeros_like(valid) if doubtful is None else doubtful
    lr_inpainted = inpaint(lr[None, None])
    cut = functional.max_pool2d(barrier[None, None].float(), scale)[0, 0] > 0
    lr_certain = lr.masked_fill(doubtful, torch.nan)
    trust = torch.where(cut | doubtful, mixed, 1.0).to(lr) * valid
    planes = _Planes(lr_inpainted[0, 0], estimate_slopes(lr_certain, 0), estimate_slopes(lr_certain, 1), trust)
    smooth = upsample_linear_border(lr_inpainted, scale)[0, 0]
    reachable = find_reachable(barrier, scale, radius)
    hr = _fill_edges(_filter(planes, reachable, scale, sigma_space, smooth), barrier, lr_inpainted, smooth, scale)
    if sharp:
        _take_sides(reachable, barrier, hr, scale)
        hr = torch.where(barrier, _filter(planes, reachable, scale, sigma_space, smooth), hr)
    return hr.masked_fill(~repeat_blocks(valid[None, None], scale)[0, 0], torch.nan)


def find_reachable(barrier: Tensor, scale: int, radius: int) -> Tensor:
    """Return which low-resolution pixels each high-resolution pixel reaches by a path that crosses no edge.

    A path starts in the middle of the low-resolution pixel, runs over 4-connected high-resolution pixels off the edges,
    and stays within the low-resolution pixels at most ``radius`` rows and columns away.

    Args:
        barrier: (H, W) bool, the edge map.
        scale: high-resolution pixels per low-resolution one.
        radius: radius of the neighbourhood in low-resolution pixels.

    Returns:
        (2 radius + 1, 2 radius + 1, H, W) bool: [radius + a, radius + b] is for the low-resolution pixel a rows below
        and b columns right of the one that contains the high-resolution pixel.

    """
    height, width = barrier.shape[0] // scale, barrier.shape[1] // scale
    side, edge = 2 * radius + 1, radius * scale
    padded = functional.pad(barrier, (edge, edge, edge, edge), value=True)
    windows = padded.unfold(0, side * scale, scale).unfold(1, side * scale, scale).flatten(0, 1)
    ways = torch.ones_like(windows)
    for chunk in windows.flatten(1).any(dim=1).nonzero()[:, 0].split(_CHUNK):
        ways[chunk] = _flood(~windows[chunk])
    ways = ways.view(height, width, side, scale, side, scale)
    result = barrier.new_zeros(side, side, height, scale, width, scale)
    for a in range(-radius, radius + 1):
        rows, from_rows = _shift(a, height)
        for b in range(-radius, radius + 1):
            columns, from_columns = _shift(b, width)
            there = ways[from_rows, from_columns, radius - a, :, radius - b]
            result[radius + a, radius + b, rows, :, columns] = there.transpose(1, 2)
    return result.view(side, side, *barrier.shape)


def _filter(planes: _Planes, reachable: Tensor, scale: int, sigma_space: float, smooth: Tensor) -> Tensor:
    """Return the weighted means of the planes, (H, W), and the smooth map where all weights are 0."""
    height, width = planes.values.shape
    rows, columns = (torch.arange(n, device=smooth.device) for n in smooth.shape)
    y, x = ((n.to(smooth) + 0.5) / scale - 0.5 for n in (rows, columns))
    total, weights = torch.zeros_like(smooth), torch.zeros_like(smooth)
    radius = reachable.shape[0] // 2
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            i, j = rows // scale + a, columns // scale + b
            at = i.clamp(0, height - 1)[:, None], j.clamp(0, width - 1)  # nothing beyond the border is reachable
            down, across = (y - i)[:, None], x - j
            weight = torch.exp((down.square() + across.square()) / (-2 * sigma_space**2))
            weight = weight * planes.trust[at] * reachable[radius + a, radius + b]
            total += weight * (planes.values[at] + planes.down[at] * down + planes.across[at] * across)
            weights += weight
    return torch.where(weights > 0, total / torch.where(weights > 0, weights, 1), smooth)


def _fill_edges(hr: Tensor, barrier: Tensor, lr: Tensor, smooth: Tensor, scale: int) -> Tensor:
    """Return the high-resolution map with new values on edges: the smooth map, shifted to preserve block means.

    The values stay between the minimum and the maximum of the neighbours off the edge.
    """
    start = torch.where(barrier, smooth, hr)[None, None]
    fraction = box_mean(barrier[None, None].to(hr), scale)
    missing = repeat_blocks((lr - box_mean(start, scale)) / torch.where(fraction > 0, fraction, 1), scale)
    beside = torch.cat((start, -start)).masked_fill(barrier, -torch.inf)
    most, least = functional.max_pool2d(beside, 3, stride=1, padding=1).unbind(0)
    value = (start + missing)[0].clamp(-least, most)
    return torch.where(barrier & most.isfinite(), value, start[0])[0]


def _take_sides(reachable: Tensor, barrier: Tensor, hr: Tensor, scale: int) -> None:
    """Copy to each edge pixel, in place, the reachable pixels of its most similar neighbour off the edge.

    An edge pixel without a neighbour off the edge reaches nothing.
    """
    places = barrier.nonzero()
    beside = places[:, None] + places.new_tensor(_BESIDE)  # (N, 8, 2)
    inside = ((beside >= 0) & (beside < places.new_tensor(barrier.shape))).all(dim=2)
    beside = torch.where(inside[:, :, None], beside, places[:, None])
    off = ~barrier[beside[..., 0], beside[..., 1]]
    apart = (hr[beside[..., 0], beside[..., 1]] - hr[places[:, 0], places[:, 1]][:, None]).abs()
    best = apart.masked_fill(~off, torch.inf).argmin(dim=1)
    chosen = beside[torch.arange(len(places), device=places.device), best]  # an edge where there is no neighbour
    side = len(reachable)
    there = places // scale - chosen // scale + torch.arange(side, device=places.device)[:, None, None]  # (side, N, 2)
    within = (there >= 0) & (there < side)
    rows, columns = there.clamp(0, side - 1).unbind(2)
    seen = reachable[rows[:, None], columns[None], chosen[:, 0], chosen[:, 1]]  # (side, side, N)
    reachable[:, :, places[:, 0], places[:, 1]] = seen & within[:, None, :, 0] & within[None, :, :, 1]


def _flood(free: Tensor) -> Tensor:
    """Return the pixels of windows, (N, K, K), that are 4-connected with the middle over free pixels."""
    size = free.shape[-1]
    middle = slice((size - 1) // 2, size // 2 + 1)
    reached = torch.zeros_like(free)
    reached[:, middle, middle] = free[:, middle, middle]
    while True:
        new = reached.clone()
        new[:, 1:] |= reached[:, :-1]
        new[:, :-1] |= reached[:, 1:]
        new[:, :, 1:] |= reached[:, :, :-1]
        new[:, :, :-1] |= reached[:, :, 1:]
        new &= free
        if bool((new == reached).all()):
            return reached
        reached = new


def _shift(by: int, size: int) -> tuple[slice, slice]:
    """Return the slice of a line whose pixels have a neighbour ``by`` pixels further on, and that of the neighbours."""
    return slice(max(-by, 0), size - max(by, 0)), slice(max(by, 0), size - max(-by, 0))
