"""Planes at low-resolution pixels: built from differences, averaged with their neighbours', mixed at high resolution.

A plane is its value at the centre of a low-resolution pixel and its two slopes per low-resolution pixel, in the last
axis but two: (B, facets, 3, h, w). Everything here reproduces planes exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.classical.finite_differences import extend_linearly

NEIGHBOURS = 9
"""Low-resolution pixels whose planes are mixed or averaged: 3 x 3."""


class Stencil(NamedTuple):
    """Differences of a low-resolution map to its neighbours, per low-resolution pixel.

    ``value`` (B, 1, h, w); ``slopes`` (B, 2, 3, h, w): backward, central and forward difference along u and v; ``bend``
    (B, 1, h, w): the largest absolute second difference within 3 x 3 pixels; ``turns`` (B, 2, h, w): the second
    differences along u and v; ``mean`` (B, 1, h, w) of 3 x 3.
    """

    value: Tensor
    slopes: Tensor
    bend: Tensor
    turns: Tensor
    mean: Tensor


def stencil(values: Tensor) -> Stencil:
    """Return the differences of (B, 1, h, w) maps, which are extrapolated linearly beyond the border."""
    padded = extend_linearly(values, 1)
    left, here, right = padded[..., 1:-1, :-2], padded[..., 1:-1, 1:-1], padded[..., 1:-1, 2:]
    above, below = padded[..., :-2, 1:-1], padded[..., 2:, 1:-1]
    along_u = torch.cat((here - left, (right - left) / 2, right - here), dim=1)
    along_v = torch.cat((here - above, (below - above) / 2, below - here), dim=1)
    corners = padded[..., 2:, 2:] - padded[..., 2:, :-2] - padded[..., :-2, 2:] + padded[..., :-2, :-2]
    turns = torch.cat((along_u[:, 2:] - along_u[:, :1], along_v[:, 2:] - along_v[:, :1]), dim=1)
    second = torch.cat((turns, corners / 4), dim=1)
    bend = functional.max_pool2d(second.abs().amax(dim=1, keepdim=True), 3, stride=1, padding=1)
    slopes = torch.stack((along_u, along_v), dim=1)
    return Stencil(here, slopes, bend, turns, functional.avg_pool2d(padded, 3, stride=1))


def smooth(values: Tensor, weight: Tensor, levels: int) -> list[Stencil]:
    """Return the stencils of a map that is smoothed more and more: binomial kernels a trous, 1, 2, 4, ... pixels apart.

    Planes stay planes where nothing was filled in. Values that were filled in count a tenth.

    Args:
        values: (B, 1, h, w).
        weight: (B, 1, h, w), 1 where the map is known and 0 where it was filled in.
        levels: number of smoothed maps.

    """
    weight = 0.1 + 0.9 * weight
    found = []
    for level in range(levels):
        step = 2**level
        padded, padded_weight = extend_linearly(values, step), functional.pad(weight, (step,) * 4, mode="replicate")
        total = _binomial(padded_weight, step)
        values = _binomial(padded * padded_weight, step) / total
        weight = total
        found.append(stencil(values))
    return found


def _binomial(values: Tensor, step: int) -> Tensor:
    """Return means of (B, 1, h + 2 step, w + 2 step) with weights 1, 2, 1 along both axes, ``step`` pixels apart."""
    for dim in (-2, -1):
        size = values.shape[dim] - 2 * step
        before, here, after = (values.narrow(dim, i * step, size) for i in range(3))
        values = (before + after) / 4 + here / 2
    return values


def average_planes(planes: Tensor, weights: Tensor, reach: int) -> Tensor:
    """Return averages of planes, extended to each pixel, ``reach`` pixels apart or less at the border.

    Args:
        planes: (B, facets, 3, h, w).
        weights: (B, facets, 9, h, w), row by row.
        reach: low-resolution pixels.

    """
    height, width = planes.shape[-2:]
    padded = functional.pad(planes.flatten(1, 2), (reach,) * 4, mode="replicate").unflatten(1, planes.shape[1:3])
    rows, columns = (torch.arange(n, dtype=planes.dtype, device=planes.device) for n in (height, width))
    total = torch.zeros_like(planes)
    for k in range(NEIGHBOURS):
        down, across = (reach * (n - 1) for n in divmod(k, 3))
        near = padded[..., reach + down : reach + down + height, reach + across : reach + across + width]
        v = (rows + down).clamp(0, height - 1) - rows
        u = (columns + across).clamp(0, width - 1) - columns
        value = near[:, :, 0] - u * near[:, :, 1] - v[:, None] * near[:, :, 2]
        extended = torch.cat((value[:, :, None], near[:, :, 1:]), dim=2)
        total = total + weights[:, :, k : k + 1] * extended
    return total


def gather_neighbours(planes: Tensor) -> Tensor:
    """Return the planes of the 3 x 3 low-resolution pixels around each, extended to its centre.

    Args:
        planes: (B, facets, 3, h, w).

    Returns:
        (B, 9, facets, 3, h, w), row by row; a pixel's own planes in place of those beyond the border.

    """
    value, slope_u, slope_v = planes.unbind(dim=2)  # (B, facets, h, w)
    height, width = value.shape[-2:]
    padded = [functional.pad(each, (1, 1, 1, 1), mode="replicate") for each in (value, slope_u, slope_v)]
    around = []
    for i in range(3):
        for j in range(3):
            v, u_slope, v_slope = (each[..., i : i + height, j : j + width] for each in padded)
            # how far this pixel's centre is from the neighbour's; 0 where the neighbour is the pixel itself, repeated
            rows = _steps(height, i - 1, value)[:, None]
            columns = _steps(width, j - 1, value)
            around.append(torch.stack((v - columns * u_slope - rows * v_slope, u_slope, v_slope), dim=2))
    return torch.stack(around, dim=1)


def _steps(size: int, step: int, like: Tensor) -> Tensor:
    """Return ``step`` for every index whose neighbour lies inside, else 0, (size,)."""
    steps = torch.full((size,), float(step), dtype=like.dtype, device=like.device)
    if step:
        steps[0 if step < 0 else -1] = 0
    return steps


def mix_planes(planes: Tensor, choice: Tensor, scale: int) -> Tensor:
    """Return the mixture of the planes around each high-resolution pixel, (B, 1, H, W).

    Args:
        planes: (B, facets, 3, h, w).
        choice: (B, 9 * facets, H, W) logits, to which those of a quadratic B-spline are added.
        scale: H / h.

    """
    batch, facets, _, height, width = planes.shape
    s, count = scale, NEIGHBOURS * facets
    # of the high-resolution pixels from the centre of their low-resolution pixel, in low-resolution pixels
    offsets = (torch.arange(s, dtype=planes.dtype, device=planes.device) + 0.5) / s - 0.5
    prior = spline_logits(offsets).view(NEIGHBOURS, 1, 1, s, 1, s)
    logits = choice.to(planes.dtype).view(batch, NEIGHBOURS, facets, height, s, width, s) + prior
    weights = logits.reshape(batch, count, height, s, width, s).softmax(dim=1)
    near = gather_neighbours(planes).reshape(batch, count, 3, height, 1, width, 1)
    value, slope_u, slope_v = ((weights * near[:, :, i]).sum(dim=1) for i in range(3))  # (B, h, s, w, s)
    hr = value + slope_u * offsets + slope_v * offsets[:, None, None]
    return hr.reshape(batch, 1, height * s, width * s)


def spline_logits(offsets: Tensor) -> Tensor:
    """Return the logarithm of the quadratic B-spline's weights of the 3 x 3 neighbours, (9, scale, scale).

    A small constant is added to each weight, so that no neighbour is excluded.
    """
    one = torch.stack((0.5 * (0.5 - offsets) ** 2, 0.75 - offsets**2, 0.5 * (0.5 + offsets) ** 2))  # (3, scale)
    both = one[:, None, :, None] * one[None, :, None, :]
    return (both + 1e-4).log().flatten(0, 1)
