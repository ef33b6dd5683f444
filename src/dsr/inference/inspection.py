"""Inspect a depth map: whether it was enlarged before by repeating pixels."""

from __future__ import annotations

import torch
from torch import Tensor

_LARGEST_BLOCK = 16


def enlarged_by(values: Tensor) -> int:
    """Return the factor by which a map, (..., H, W), was enlarged by repeating pixels; 1 for none."""
    filled = values.nan_to_num(nan=-1.0)
    if bool((filled == filled.flatten()[0]).all()):
        return 1
    for block in range(_LARGEST_BLOCK, 1, -1):
        one = filled[..., ::block, ::block]
        if all(
            torch.equal(
                filled[..., i::block, j::block],
                one[..., : _count(filled, -2, i, block), : _count(filled, -1, j, block)],
            )
            for i in range(block)
            for j in range(block)
        ):
            return block
    return 1


def _count(values: Tensor, dim: int, start: int, step: int) -> int:
    """Return the length of ``values[start::step]`` along ``dim``."""
    return len(range(start, values.shape[dim], step))
