"""Planes at low-resolution pixels: built from differences, averaged with their neighbours', mixed at high resolution.

A plane is its value at the centre of a low-resolution pixel and its two slopes per low-resolution pixel, in the last
axis but two: (B, facets, 3, h, w). Everything here reproduces planes exactly.
"""

import itertools
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from dsr.methods.images import exporting, extend_linearly
from dsr.utils.compute_device import made_once

NEIGHBOURS = 9  # low-resolution pixels whose planes are mixed or averaged: 3 x 3
_CHUNK = 2**17  # values that a processor's cache holds several of


class Stencil(NamedTuple):
    """Differences of a low-resolution map to its neighbours, per low-resolution pixel."""

    value: Tensor  # (B, 1, h, w)
    slopes: Tensor  # (B, 2, 3, h, w): backward, central and forward difference along u and v
    bend: Tensor  # (B, 1, h, w): the largest absolute second difference within 3 x 3 pixels
    turns: Tensor  # (B, 2, h, w): the second differences along u and v
    mean: Tensor  # (B, 1, h, w), of 3 x 3 pixels


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

    ``weight`` (B, 1, h, w) is 1 where the map is known and 0 where it was filled in, which counts a tenth.
    """
    weight = 0.1 + 0.9 * weight
    found = []
    for level in range(levels):
        step = 2**level
        weight = functional.pad(weight, (step,) * 4, mode="replicate")
        both = torch.stack((extend_linearly(values, step) * weight, weight))
        for dim in (-2, -1):  # weights 1, 2, 1 along both axes
            size = both.shape[dim] - 2 * step
            before, here, after = (both.narrow(dim, i * step, size) for i in range(3))
            both = torch.add(before + after, here, alpha=2)
        total, weight = both
        values = total / weight
        found.append(values)
    return found


def average_planes(planes: Tensor, weights: Tensor, reach: int) -> Tensor:
    """Return means of planes (B, facets, 3, h, w) ``reach`` pixels apart, by weights (B, facets, 9, h, w)."""
    if exporting():
        near = _extend_to_centre(_repeat_border(planes, reach), planes.shape, reach)
        return (weights.unflatten(2, (3, 3))[:, :, None] * near).sum(dim=(3, 4))
    average: Tensor = _AveragePlanes.apply(_repeat_border(planes, reach), weights, reach)
    return average


class _AveragePlanes(torch.autograd.Function):
    """:func:`average_planes` of planes with a border, summed up neighbour by neighbour."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, weights: Tensor, reach: int) -> Tensor:
        near = _extend_to_centre(padded, weights.shape, reach)
        ctx.save_for_backward(near, weights)
        ctx.reach = reach
        if near.device.type != "cpu":  # fewer operations there, fewer passes over memory here
            return (weights.unflatten(2, (3, 3))[:, :, None] * near).sum(dim=(3, 4))
        planes, factors = near.flatten(3, 4).unbind(dim=3), weights[:, :, None].unbind(dim=3)
        total = factors[0] * planes[0]
        for factor, plane in zip(factors[1:], planes[1:], strict=True):
            total.addcmul_(factor, plane)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        near, weights = ctx.saved_tensors
        gradient = gradient[:, :, :, None, None]  # (B, facets, 3, 1, 1, h, w)
        of_weights = (near * gradient).sum(dim=2).flatten(2, 3)
        found = weights.unflatten(2, (3, 3))[:, :, None] * gradient
        down, across = _distances(found, ctx.reach)
        found[:, :, 1:2].addcmul_(across, found[:, :, :1])
        found[:, :, 2:].addcmul_(down, found[:, :, :1])
        for axis, dim in ((4, -1), (3, -2)):  # windows back to their places
            windows = found.unbind(dim=axis)
            size = list(windows[0].shape)
            size[dim] += 2 * ctx.reach
            found = gradient.new_zeros(size)
            for step, window in enumerate(windows):
                found.narrow(dim, step * ctx.reach, window.shape[dim]).add_(window)
        return found, of_weights, None


def _repeat_border(planes: Tensor, reach: int) -> Tensor:
    """Return planes, (B, facets, 3, h, w), with those of the border in place of those beyond it."""
    if not torch.compiler.is_compiling():
        padded = functional.pad(planes.flatten(1, 2), (reach,) * 4, mode="replicate")
        return padded.unflatten(1, planes.shape[1:3])
    for dim in (-2, -1):  # torch 2.13 compiles the gradient of that with another layout than it has
        first, last = planes.narrow(dim, 0, 1), planes.narrow(dim, planes.shape[dim] - 1, 1)
        planes = torch.cat((*[first] * reach, planes, *[last] * reach), dim=dim)
    return planes


def _extend_to_centre(padded: Tensor, size: torch.Size, reach: int) -> Tensor:
    """Return the planes of the 3 x 3 pixels around each of (..., h, w), extended to it, (B, facets, 3, 3, 3, h, w)."""
    height, width = size[-2:]
    if exporting():  # a window may not be of a size that is not known
        rows = torch.stack([padded[..., i * reach : i * reach + height, :] for i in range(3)], dim=-3)
        near = torch.stack([rows[..., j * reach : j * reach + width] for j in range(3)], dim=-3)
    else:
        near = padded.unfold(-2, height, reach).unfold(-2, width, reach)
    down, across = _distances(near, reach)
    value, along_u, along_v = near.split(1, dim=2)
    return torch.cat((value + across * along_u + down * along_v, along_u, along_v), dim=2)


def _distances(near: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return how far each pixel is from the rows, (3, 1, h, 1), and columns, (3, 1, w), before, at and after it."""
    height, width = near.shape[-2:]
    along = _make_distances if exporting() else _distances_along  # sizes of a graph are no constants
    down, across = along(height, reach, near.dtype, near.device), along(width, reach, near.dtype, near.device)
    return down[:, None, :, None], across[:, None]


def _make_distances(size: int, reach: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    places = torch.arange(size, dtype=dtype, device=device)
    return torch.stack((places, torch.zeros_like(places), -places.flip(0))).clamp(-reach, reach)


_distances_along = made_once(_make_distances)


def mix_planes(planes: Tensor, found: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Return the mixture of the planes around each high-resolution pixel, (B, 1, H, W), and the other channels.

    ``planes`` are (B, facets, 3, h, w), ``found`` (B, 9 * facets + n, H, W): logits, to which those of a quadratic
    B-spline are added, and n more channels. What is mixed, in at least float32, are the differences to the first plane
    of the pixel's own low-resolution pixel, which is added in the type of ``planes``.
    """
    batch, facets, _, height, width = planes.shape
    count = NEIGHBOURS * facets
    dtype = torch.promote_types(found.dtype, torch.float32)
    basis, prior = _mixing_constants(scale, facets, planes.dtype, planes.device)
    with torch.autocast(planes.device.type, enabled=False):
        first = planes[:, 0]
        base = functional.pixel_shuffle((basis @ first.flatten(2)).unflatten(2, (height, width)), scale)
        near = _extend_to_centre(_repeat_border(planes, 1), planes.shape, 1).permute(0, 3, 4, 1, 2, 5, 6)
        near = (near - first[:, None, None, None]).reshape(batch, count, 3, height, width).to(dtype)
        basis, prior = basis.to(dtype), prior.to(dtype)
        if not exporting():
            mixed, others = _MixPlanes.apply(near, found, prior, basis)
            return base + mixed, others
        logits = functional.pixel_unshuffle(found[:, :count].to(dtype), scale).view(batch, count, -1, height * width)
        mixed = ((logits + prior).softmax(dim=1) * (basis @ near.flatten(3))).sum(dim=1)
        return base + functional.pixel_shuffle(mixed.unflatten(2, (height, width)), scale), found[:, count:].to(dtype)


@made_once
def _mixing_constants(scale: int, facets: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return factors of value and slopes at high-resolution pixels, (s s, 3), and B-spline logits, (9 f, s s, 1)."""
    # from the centre of the low-resolution pixel, in low-resolution pixels
    offsets = (torch.arange(scale, dtype=dtype, device=device) + 0.5) / scale - 0.5
    ones = torch.ones(scale, scale, dtype=dtype, device=device)
    basis = torch.stack((ones, ones * offsets, ones * offsets[:, None]), dim=-1).view(scale * scale, 3)
    spline = torch.stack((0.5 * (0.5 - offsets) ** 2, 0.75 - offsets**2, 0.5 * (0.5 + offsets) ** 2))  # (3, s)
    weights = spline[:, None, :, None] * spline[None, :, None, :]  # (3, 3, s, s)
    logits = (weights + 1e-4).log().view(NEIGHBOURS, scale * scale, 1)
    return basis, logits.repeat_interleave(facets, dim=0)


class _MixPlanes(torch.autograd.Function):
    """A softmax over proposals times their planes at each pixel, some pixels at a time: no array of all of them."""

    @staticmethod
    def forward(ctx: Any, near: Tensor, found: Tensor, prior: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
        count, scale = near.shape[1], math.isqrt(len(basis))
        mixed = near.new_empty(found.shape[0], 1, *found.shape[-2:])
        logits, target, kept = _blocks(found[:, :count], scale), _blocks(mixed, scale), []
        for part in _parts(logits):
            weights = logits[part].to(near.dtype, memory_format=torch.contiguous_format, copy=True)
            weights = weights.flatten(4).flatten(2, 3).add_(prior).softmax(dim=1)
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
        count, scale = near.shape[1], math.isqrt(len(basis))
        of_near, of_found = torch.empty_like(near), torch.empty_like(found)
        of_found[:, count:] = of_others
        target, gradients, values = _blocks(of_found[:, :count], scale), _blocks(gradient, scale), _blocks(mixed, scale)
        for part, weights in zip(_parts(target), kept, strict=True):
            weighted = weights * gradients[part].flatten(4).flatten(2, 3)
            of_near[part] = (basis.T @ weighted).view_as(near[part])
            above = (basis @ near[part].flatten(3)).sub_(values[part].flatten(4).flatten(2, 3))
            target[part] = above.mul_(weighted).view_as(target[part])
        return of_near, of_found, None, None


def _blocks(values: Tensor, scale: int) -> Tensor:
    """Return a view of (B, C, s h, s w) maps as (B, C, s, s, h, w)."""
    return values.unflatten(3, (-1, scale)).unflatten(2, (-1, scale)).permute(0, 1, 3, 5, 2, 4)


def _parts(blocks: Tensor) -> list[tuple[Any, ...]]:
    """Return indices of parts of (..., h, w), each with about as many values as a processor's cache holds."""
    if blocks.device.type != "cpu":
        return [(...,)]
    height, width = blocks.shape[-2:]
    values = blocks.numel() // (height * width)
    columns = min(width, max(1, _CHUNK // values))
    rows = max(1, _CHUNK // (values * columns))
    corners = itertools.product(range(0, height, rows), range(0, width, columns))
    return [(..., slice(top, top + rows), slice(left, left + columns)) for top, left in corners]
