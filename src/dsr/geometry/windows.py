"""Largest values of the windows around pixels."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional


def window_maxima(values: Tensor, reach: int) -> Tensor:
    """Return the largest values within ``reach`` rows and columns of each pixel, (1, h, w), without NaN."""
    result = functional.pad(values, (reach,) * 4, value=-math.inf)
    for dim in (-2, -1):
        size = 1
        while size < 2 * reach + 1:  # of windows twice as large, until they are large enough
            shift = min(size, 2 * reach + 1 - size)
            rest = result.shape[dim] - shift
            result = torch.maximum(result.narrow(dim, 0, rest), result.narrow(dim, shift, rest))
            size += shift
    return result
