"""Operations that networks replace by equivalent ones during the export to ONNX.

A graph has no loop that ends when nothing is missing, unless it is written as one, and no tensor in it has a size that
depends on values, such as that of the known pixels of a map. While a network is exported, the functions here replace
those that need one of them.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional


def exporting() -> bool:
    """Return whether a network is being exported, without importing the exporter, which takes a while."""
    return "torch.onnx" in sys.modules and bool(torch.onnx.is_in_onnx_export())


def neighbours_of(x: Tensor) -> Tensor:
    """Return the eight neighbours of each pixel, row by row, (B, C, h, w) to (B, 8, C, h, w); 0 beyond the border."""
    height, width = x.shape[-2], x.shape[-1]
    padded = functional.pad(x, [1, 1, 1, 1])
    around = []
    for down in range(3):
        for across in range(3):
            if down != 1 or across != 1:
                around.append(padded[:, :, down : down + height, across : across + width])
    return torch.stack(around, dim=1)


@torch.jit.script_if_tracing  # so that a graph keeps its loop
def fill_by_colour_in_graph(x: Tensor, affinity: Tensor, alike: float) -> Tensor:
    """Fill the holes of a map as :func:`dsr.methods.images.inpaint` does with a photo.

    ``x`` (1, 1, h, w) is NaN in holes, ``affinity`` (1, 8, h, w) that of each pixel and its neighbours; pixels of an
    affinity of ``alike`` are filled before others. An image without a known value stays NaN.
    """
    known = torch.isfinite(x).to(affinity.dtype)
    values = torch.where(known > 0, x, torch.zeros_like(x))
    before = torch.zeros_like(known.sum()) - 1
    while bool(known.sum() != before):
        before = known.sum()
        weights = affinity * neighbours_of(known)[:, :, 0]
        nearest = weights.amax(dim=1, keepdim=True)
        front = (known == 0) & (nearest > 0)
        likely = front & (nearest >= alike)
        first = likely | (front & ~likely.any())
        total = weights.sum(dim=1, keepdim=True)
        mean = (weights * neighbours_of(values)[:, :, 0]).sum(dim=1, keepdim=True)
        values = torch.where(first, mean / torch.where(total > 0, total, torch.ones_like(total)), values)
        known = torch.where(first, torch.ones_like(known), known)
    return torch.where(known > 0, values, torch.full_like(values, float("nan")))


def apply(function: type[torch.autograd.Function], *arguments: Any) -> Any:
    """Apply a function that has a derivative of its own; a graph gets its operations, without the derivative."""
    if not exporting():
        return function.apply(*arguments)
    return function.forward(SimpleNamespace(save_for_backward=lambda *_: None), *arguments)


def median_in_graph(x: Tensor, known: Tensor) -> Tensor:
    """Return the lower median of the known values of each row, (B, N) to (B, 1); infinity for a row without one."""
    ordered = torch.where(known, x, torch.inf).sort(dim=1).values
    middle = (known.sum(dim=1, keepdim=True) - 1).clamp(min=0) // 2
    return ordered.gather(1, middle)


def quantiles_in_graph(x: Tensor, known: Tensor, fractions: Tensor) -> Tensor:
    """Return quantiles of the known values of each row, interpolated linearly; NaN for a row without one.

    ``x`` and ``known`` are (B, N), ``fractions`` (Q,) in 0..1, the result (B, Q).
    """
    count = known.sum(dim=1, keepdim=True)
    ordered = torch.where(known, x, torch.inf).sort(dim=1).values
    place = fractions * (count - 1).clamp(min=0).to(x.dtype)  # (B, Q)
    below, above = place.floor().long(), place.ceil().long()
    low, high = ordered.gather(1, below), ordered.gather(1, above)
    return torch.where(count > 0, torch.lerp(low, high, place - below.to(x.dtype)), torch.nan)


def every(step: Tensor, like: Tensor) -> Tensor:
    """Return whether both indices of a pixel are multiples of ``step``, (1, 1, h, w) bool; ``like`` is (B, C, h, w)."""
    rows, columns = (torch.arange(n, device=like.device, dtype=torch.float32) for n in like.shape[-2:])
    first = (torch.fmod(rows, step) == 0)[:, None] & (torch.fmod(columns, step) == 0)
    return first[None, None]


def pad_to_multiple(x: Tensor, factor: int) -> Tensor:
    """Repeat the last row and column of (B, C, h, w) so that both sizes become multiples of ``factor``."""
    height, width = x.shape[-2:]
    if not exporting():
        return functional.pad(x, (0, -width % factor, 0, -height % factor), mode="replicate")
    more = functional.pad(x, (0, factor - 1, 0, factor - 1), mode="replicate")
    rows, columns = (factor * ((n + factor - 1) // factor) for n in (height, width))
    return more[..., :rows, :columns]
