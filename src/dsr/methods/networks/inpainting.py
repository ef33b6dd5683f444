"""Inpainting of holes in low-resolution maps, for methods that need a value everywhere."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.networks.exportable import exporting, fill_in_graph


def inpaint(x: Tensor) -> Tensor:
    """Replace the non-finite values of (B, 1, h, w) by the mean of the valid ones in 3 x 3 pixels, from outside in.

    An image without a valid value stays unchanged.
    """
    valid = x.isfinite()
    if not exporting() and bool(valid.all()):
        return x
    values, weight = torch.where(valid, x, 0), valid.to(x.dtype)
    if exporting():
        values, weight = fill_in_graph(values, weight)
        return torch.where(weight > 0, values, torch.nan)
    for _ in range(max(x.shape[-2:])):
        total, fraction = (functional.avg_pool2d(each, 3, stride=1, padding=1) for each in (values, weight))
        new = (weight == 0) & (fraction > 0)
        if not bool(new.any()):
            break
        values = torch.where(new, total / torch.where(fraction > 0, fraction, 1), values)
        weight = torch.where(new, 1, weight)
    return torch.where(weight > 0, values, torch.nan)
