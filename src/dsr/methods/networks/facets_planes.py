"""Planes at low-resolution pixels: built from differences, averaged with their neighbours', mixed at high resolution.

A plane is its value at the centre of a low-resolution pixel and its two slopes per low-resolution pixel, in the last
axis but two: (B, facets, 3, h, w). Everything here reproduces planes exactly.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dsr.methods.exportable import exporting
from dsr.methods.images import extend_linearly

NEIGHBOURS = 9  # low-resolution pixels whose planes are mixed or averaged: 3 x 3
_CHUNK = 2**17  # values that a processor's cache holds several of


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


def smooth(values: Tensor, weight: Tensor, levels: int) -> list[Tensor]:
    """Return copies of a map, (B, 1, h, w), smoothed more and more: binomial kernels 1, 2, 4, ... pixels apart.

    Planes stay planes where nothing was filled in: ``weight`` (B, 1, h, w) is 1 where the map is known and 0 where it
    was filled in, which counts a tenth.
    """
    weight = 0.1 + 0.9 * weight
    found = []
    for level in range(levels):
        step = 2**level
        padded_weight = functional.pad(weight, (step,) * 4, mode="replicate")
        both = torch.stack((extend_linearly(values, step) * padded_weight, padded_weight))
        for dim in (-2, -1):  # weights 1, 2, 1 along both axes
            size = both.shape[dim] - 2 * step
            before, here, after = (both.narrow(dim, i * step, size) for i in range(3))
            both = (before + after) / 4 + here / 2
        values, weight = both[0] / both[1], both[1]
        found.append(values)
    return found


def average_planes(planes: Tensor, weights: Tensor, reach: int) -> Tensor:
    """Return averages of planes, extended to each pixel, ``reach`` pixels apart or less at the border.

    ``planes`` are (B, facets, 3, h, w), ``weights`` (B, facets, 9, h, w), row by row.
    """
    if exporting():
        return (weights.unflatten(2, (3, 3))[:, :, None] * _extend_to_centre(planes, reach)).sum(dim=(3, 4))
    average: Tensor = _AveragePlanes.apply(planes, weights, reach)
    return average


class _AveragePlanes(torch.autograd.Function):
    """:func:`average_planes` without a copy of all planes for each of the nine neighbours."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, weights: Tensor, reach: int) -> Tensor:
        padded = functional.pad(planes.flatten(1, 2), (reach,) * 4, mode="replicate").unflatten(1, planes.shape[1:3])
        near = _windows(padded, planes.shape, reach)
        down, across = _offsets(planes, reach)
        total = torch.zeros_like(planes, memory_format=torch.contiguous_format)
        for i in range(3):
            value = near[:, :, 0, i] - across * near[:, :, 1, i] - down[i] * near[:, :, 2, i]  # (B, facets, 3, h, w)
            for j in range(3):
                total[:, :, 0].addcmul_(weights[:, :, 3 * i + j], value[:, :, j])
                total[:, :, 1:].addcmul_(weights[:, :, 3 * i + j, None], near[:, :, 1:, i, j])
        ctx.save_for_backward(padded, weights)
        ctx.reach = reach
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        padded, weights = ctx.saved_tensors
        near, (down, across) = _windows(padded, gradient.shape, ctx.reach), _offsets(gradient, ctx.reach)
        of_value = gradient[:, :, :1, None, None]  # (B, facets, 1, 1, 1, h, w)
        of_u = gradient[:, :, 1:2, None, None] - across * of_value
        of_v = gradient[:, :, 2:, None, None] - down * of_value
        of_weights = of_value * near[:, :, :1]  # (B, facets, 1, 3, 3, h, w)
        of_weights.addcmul_(of_u, near[:, :, 1:2]).addcmul_(of_v, near[:, :, 2:])
        parts = torch.cat([each.expand_as(of_weights) for each in (of_value, of_u, of_v)], dim=2)
        of_padded = torch.zeros_like(padded)
        sums = _windows(of_padded, gradient.shape, ctx.reach)
        for k in range(NEIGHBOURS):
            i, j = divmod(k, 3)
            sums[:, :, :, i, j].addcmul_(weights[:, :, k, None], parts[:, :, :, i, j])
        for dim in (-2, -1):  # what lies beyond the border is the border's
            size = of_padded.shape[dim] - 2 * ctx.reach
            before, inner, after = of_padded.split((ctx.reach, size, ctx.reach), dim)
            inner.narrow(dim, 0, 1).add_(before.sum(dim, keepdim=True))
            inner.narrow(dim, size - 1, 1).add_(after.sum(dim, keepdim=True))
            of_padded = inner
        return of_padded, of_weights.flatten(2, 4), None


def _windows(padded: Tensor, size: torch.Size, reach: int) -> Tensor:
    """Return the 3 x 3 neighbours of pixels, (..., h + 2 reach, w + 2 reach) to (..., 3, 3, h, w): a view."""
    height, width = size[-2:]
    if exporting():
        rows = torch.stack([padded[..., i * reach : i * reach + height, :] for i in range(3)], dim=-3)
        return torch.stack([rows[..., j * reach : j * reach + width] for j in range(3)], dim=-3)
    return padded.unfold(-2, height, reach).unfold(-2, width, reach)


@functools.lru_cache(64)
def _offsets_along(size: int, reach: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(mode=False):  # a cached tensor may later be used with gradients
        places = torch.arange(size, dtype=dtype, device=device)
        return torch.stack([(places + step).clamp(0, size - 1) - places for step in (-reach, 0, reach)])


def _offsets(planes: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return how far the rows, (3, 1, h, 1), and columns, (3, 1, w), before, at and after each are, if inside."""
    height, width = planes.shape[-2:]
    along = _offsets_along.__wrapped__ if exporting() else _offsets_along  # sizes of a graph are no constants
    down, across = along(height, reach, planes.dtype, planes.device), along(width, reach, planes.dtype, planes.device)
    return down[:, None, :, None], across[:, None]


def _extend_to_centre(planes: Tensor, reach: int) -> Tensor:
    """Return the planes of the 3 x 3 pixels around each, extended to its centre, (B, facets, 3, 3, 3, h, w).

    Planes are (B, facets, 3, h, w). In place of those beyond the border are the border's.
    """
    padded = functional.pad(planes.flatten(1, 2), (reach,) * 4, mode="replicate").unflatten(1, planes.shape[1:3])
    near, (down, across) = _windows(padded, planes.shape, reach), _offsets(planes, reach)
    value = near[:, :, :1] - across * near[:, :, 1:2] - down * near[:, :, 2:]
    return torch.cat((value, near[:, :, 1:]), dim=2)


def mix_planes(planes: Tensor, found: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Return the mixture of the planes around each high-resolution pixel, (B, 1, H, W), and the other channels.

    What is mixed are the differences to the first plane of the pixel's own low-resolution pixel, in the type of
    ``found``, at least float32; that plane is added in the type of ``planes``, in which it is reproduced exactly.
    ``planes`` are (B, facets, 3, h, w), ``found`` (B, 9 * facets + n, H, W): logits, to which those of a quadratic
    B-spline are added, and n more channels, which are returned in at least float32.
    """
    batch, facets, _, height, width = planes.shape
    s, count = scale, NEIGHBOURS * facets

    def side_by_side(values: Tensor) -> Tensor:
        """Return values of the pixels of each low-resolution pixel, (B, s s, h w), as (B, 1, s h, s w)."""
        blocks = values.view(batch, s, s, height, width).permute(0, 3, 1, 4, 2)
        return blocks.reshape(batch, 1, height * s, width * s)

    dtype = torch.promote_types(found.dtype, torch.float32)
    basis, prior = _mixing_constants(s, facets, planes.dtype, planes.device)
    with torch.autocast(planes.device.type, enabled=False):
        first = planes[:, 0]
        near = _extend_to_centre(planes, 1).permute(0, 3, 4, 1, 2, 5, 6) - first[:, None, None, None]
        near = near.reshape(batch, count, 3, height, width).to(dtype)
        base = side_by_side(basis @ first.flatten(2))
        basis, prior = basis.to(dtype), prior.to(dtype)
        if not exporting():
            mixed, others = _MixPlanes.apply(near, found, prior, basis)
            return base + mixed, others
        # the pixels of a low-resolution pixel become an axis of their own
        logits = found[:, :count].reshape(batch, count, height, s, width, s).permute(0, 1, 3, 5, 2, 4)
        logits = logits.reshape(batch, count, s * s, height * width)
        weights = (logits.to(dtype) + prior).softmax(dim=1)
        mixed = (weights * (basis @ near.flatten(3))).sum(dim=1)
        return base + side_by_side(mixed), found[:, count:].to(dtype)


@functools.lru_cache(64)
def _mixing_constants(scale: int, facets: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return value and slopes' factors of high-resolution pixels, (s s, 3), and logits of a B-spline, (9 f, s s, 1)."""
    with torch.inference_mode(mode=False):  # cached tensors may later be used with gradients
        # from the centre of the low-resolution pixel, in low-resolution pixels
        offsets = (torch.arange(scale, dtype=dtype, device=device) + 0.5) / scale - 0.5
        ones = torch.ones(scale, scale, dtype=dtype, device=device)
        basis = torch.stack((ones, ones * offsets, ones * offsets[:, None]), dim=-1).view(scale * scale, 3)
        logits = spline_logits(offsets).repeat_interleave(facets, dim=0)
        return basis, logits.view(NEIGHBOURS * facets, scale * scale, 1)


class _MixPlanes(torch.autograd.Function):
    """A softmax over proposals times their planes at each pixel, some pixels at a time: no array of all of them."""

    @staticmethod
    def forward(ctx: Any, near: Tensor, found: Tensor, prior: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
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
