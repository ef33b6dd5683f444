"""Planes at low-resolution pixels: built from differences, averaged with their neighbours', mixed at high resolution.

A plane is its value at the centre of a low-resolution pixel and its two slopes per low-resolution pixel, in the last
axis but two: (B, facets, 3, h, w). Everything here reproduces planes exactly.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dsr.methods.classical.finite_differences import extend_linearly
from dsr.methods.exportable import exporting

NEIGHBOURS = 9
"""Low-resolution pixels whose planes are mixed or averaged: 3 x 3."""
_CHUNK = 2**17
"""Values that a processor's cache holds several of."""


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
    if exporting():
        return _average_planes(planes, weights, reach)
    average: Tensor = _AveragePlanes.apply(planes, weights, reach)
    return average


def _average_planes(planes: Tensor, weights: Tensor, reach: int) -> Tensor:
    """Return what :func:`average_planes` does, in operations that a graph may have."""
    height, width = planes.shape[-2:]
    padded = _pad(planes, reach)
    down, across = _offsets(height, reach, planes), _offsets(width, reach, planes)
    total = torch.zeros_like(planes)
    for k in range(NEIGHBOURS):
        i, j = divmod(k, 3)
        near = padded[..., i * reach : i * reach + height, j * reach : j * reach + width]
        value = near[:, :, 0] - across[j] * near[:, :, 1] - down[i][:, None] * near[:, :, 2]
        extended = torch.cat((value[:, :, None], near[:, :, 1:]), dim=2)
        total = total + weights[:, :, k : k + 1] * extended
    return total


class _AveragePlanes(torch.autograd.Function):
    """:func:`average_planes` without a copy of all planes for each of the nine neighbours."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, weights: Tensor, reach: int) -> Tensor:
        """Return (B, facets, 3, h, w)."""
        height, width = planes.shape[-2:]
        padded = _pad(planes, reach)
        down, across = _offsets(height, reach, planes), _offsets(width, reach, planes)
        total = torch.zeros_like(planes, memory_format=torch.contiguous_format)
        for k in range(NEIGHBOURS):
            i, j = divmod(k, 3)
            near = padded[..., i * reach : i * reach + height, j * reach : j * reach + width]
            value = near[:, :, 0] - across[j] * near[:, :, 1] - down[i][:, None] * near[:, :, 2]
            total[:, :, 0].addcmul_(weights[:, :, k], value)
            total[:, :, 1:].addcmul_(weights[:, :, k, None], near[:, :, 1:])
        ctx.save_for_backward(padded, weights, *down, *across)
        ctx.reach = reach
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients of the planes and of the weights."""
        padded, weights, *offsets = ctx.saved_tensors
        down, across = offsets[:3], offsets[3:]
        reach, (height, width) = ctx.reach, gradient.shape[-2:]
        of_padded, of_weights = torch.zeros_like(padded), torch.empty_like(weights)
        of_value, of_u, of_v = gradient.unbind(dim=2)
        for k in range(NEIGHBOURS):
            i, j = divmod(k, 3)
            window = (..., slice(i * reach, i * reach + height), slice(j * reach, j * reach + width))
            near, sums = padded[window], of_padded[window]
            parts = (of_value, of_u - across[j] * of_value, of_v - down[i][:, None] * of_value)
            torch.mul(parts[0], near[:, :, 0], out=of_weights[:, :, k])
            for channel, part in enumerate(parts):
                sums[:, :, channel].addcmul_(weights[:, :, k], part)
                if channel:
                    of_weights[:, :, k].addcmul_(part, near[:, :, channel])
        for dim in (-2, -1):  # what lies beyond the border is the border's
            size = of_padded.shape[dim] - 2 * reach
            before, inner, after = of_padded.split((reach, size, reach), dim)
            inner.narrow(dim, 0, 1).add_(before.sum(dim, keepdim=True))
            inner.narrow(dim, size - 1, 1).add_(after.sum(dim, keepdim=True))
            of_padded = inner
        return of_padded, of_weights, None


def _pad(planes: Tensor, reach: int) -> Tensor:
    """Return planes, (B, facets, 3, h, w), with the border's repeated ``reach`` times."""
    return functional.pad(planes.flatten(1, 2), (reach,) * 4, mode="replicate").unflatten(1, planes.shape[1:3])


def _offsets(size: int, reach: int, like: Tensor) -> list[Tensor]:
    """Return how far the pixels ``reach`` before, at and after each pixel are, (size,) each, if they are inside."""
    places = torch.arange(size, dtype=like.dtype, device=like.device)
    return [(places + step).clamp(0, size - 1) - places for step in (-reach, 0, reach)]


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
    return mix_planes_apart(planes, choice, scale)[0]


def mix_planes_apart(planes: Tensor, found: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Return the mixture of the planes around each high-resolution pixel, (B, 1, H, W), and the other channels.

    What is mixed are the differences to the first plane of the pixel's own low-resolution pixel, in the type of
    ``found``, at least float32; that plane is added in the type of ``planes``, in which it is reproduced exactly.

    Args:
        planes: (B, facets, 3, h, w).
        found: (B, 9 * facets + n, H, W): logits as for :func:`mix_planes`, and n more channels, which are returned in
            at least float32.
        scale: H / h.

    """
    batch, facets, _, height, width = planes.shape
    s, count = scale, NEIGHBOURS * facets

    def side_by_side(values: Tensor) -> Tensor:
        """Return values of the pixels of each low-resolution pixel, (B, s s, h w), as (B, 1, s h, s w)."""
        blocks = values.view(batch, s, s, height, width).permute(0, 3, 1, 4, 2)
        return blocks.reshape(batch, 1, height * s, width * s)

    # of the high-resolution pixels from the centre of their low-resolution pixel, in low-resolution pixels
    offsets = (torch.arange(s, dtype=planes.dtype, device=planes.device) + 0.5) / s - 0.5
    ones = torch.ones(s, s, dtype=offsets.dtype, device=offsets.device)
    basis = torch.stack((ones, ones * offsets, ones * offsets[:, None]), dim=-1).view(s * s, 3)
    dtype = torch.promote_types(found.dtype, torch.float32)
    with torch.autocast(planes.device.type, enabled=False):
        first = planes[:, 0]
        prior = spline_logits(offsets).repeat_interleave(facets, dim=0).view(count, s * s, 1).to(dtype)
        near = (gather_neighbours(planes) - first[:, None, None]).reshape(batch, count, 3, height, width).to(dtype)
        base = side_by_side(basis @ first.flatten(2))
        basis = basis.to(dtype)
        if not exporting():
            mixed, others = _MixPlanes.apply(near, found, prior, basis)
            return base + mixed, others
        # the pixels of a low-resolution pixel become an axis of their own
        logits = found[:, :count].reshape(batch, count, height, s, width, s).permute(0, 1, 3, 5, 2, 4)
        logits = logits.reshape(batch, count, s * s, height * width)
        weights = (logits.to(dtype) + prior).softmax(dim=1)
        mixed = (weights * (basis @ near.flatten(3))).sum(dim=1)
        return base + side_by_side(mixed), found[:, count:].to(dtype)


class _MixPlanes(torch.autograd.Function):
    """A softmax over proposals times their planes at each pixel, some pixels at a time: no array of all of them."""

    @staticmethod
    def forward(ctx: Any, near: Tensor, found: Tensor, prior: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
        """Return what :func:`mix_planes_apart` does."""
        count, (height, width), s = near.shape[1], near.shape[-2:], math.isqrt(len(basis))
        mixed = near.new_empty(found.shape[0], 1, *found.shape[-2:])
        logits, target, kept = _blocks(found[:, :count], s), _blocks(mixed, s), []
        for part in _chunks(near.shape[0] * count * s * s, height, width):
            weights = (
                logits[part].to(near.dtype, memory_format=torch.contiguous_format, copy=True).flatten(4).flatten(2, 3)
            )
            weights = weights.add_(prior).softmax(dim=1)
            if any(ctx.needs_input_grad):
                kept.append(weights)
            offered = basis @ near[part].flatten(3)
            target[part] = offered.mul_(weights).sum(dim=1).view_as(target[part])
        ctx.save_for_backward(near, found, mixed, basis, *kept)
        return mixed, found[:, count:].to(near.dtype, memory_format=torch.contiguous_format, copy=True)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor, of_others: Tensor) -> tuple[Tensor, Tensor, None, None]:
        """Return the gradients of the planes and of the logits with the other channels."""
        near, found, mixed, basis, *kept = ctx.saved_tensors
        count, (height, width), s = near.shape[1], near.shape[-2:], math.isqrt(len(basis))
        of_near, of_found = torch.empty_like(near), torch.empty_like(found)
        of_found[:, count:] = of_others
        target, gradients, values = _blocks(of_found[:, :count], s), _blocks(gradient, s), _blocks(mixed, s)
        parts = _chunks(near.shape[0] * count * s * s, height, width)
        for part, weights in zip(parts, kept, strict=True):
            weighted = weights * gradients[part].flatten(4).flatten(2, 3)
            of_near[part] = (basis.T @ weighted).view_as(near[part])
            above = (basis @ near[part].flatten(3)).sub_(values[part].flatten(4).flatten(2, 3))
            target[part] = above.mul_(weighted).view_as(target[part])
        return of_near, of_found, None, None


def _blocks(values: Tensor, scale: int) -> Tensor:
    """Return a view of (B, C, s h, s w) maps as (B, C, s, s, h, w)."""
    return values.unflatten(3, (-1, scale)).unflatten(2, (-1, scale)).permute(0, 1, 3, 5, 2, 4)


def _chunks(values: int, height: int, width: int) -> list[tuple[Any, ...]]:
    """Return indices of parts of the last two axes of (..., h, w) that a cache holds, each pixel with some values."""
    columns = min(width, max(1, _CHUNK // values))
    rows = max(1, _CHUNK // (values * columns))
    return [
        (..., slice(top, top + rows), slice(left, left + columns))
        for top in range(0, height, rows)
        for left in range(0, width, columns)
    ]


def spline_logits(offsets: Tensor) -> Tensor:
    """Return the logarithm of the quadratic B-spline's weights of the 3 x 3 neighbours, (9, scale, scale).

    A small constant is added to each weight, so that no neighbour is excluded.
    """
    one = torch.stack((0.5 * (0.5 - offsets) ** 2, 0.75 - offsets**2, 0.5 * (0.5 + offsets) ** 2))  # (3, scale)
    both = one[:, None, :, None] * one[None, :, None, :]
    return (both + 1e-4).log().flatten(0, 1)
