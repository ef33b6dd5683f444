"""Modulated deformable convolution.

Zhu, Hu, Lin, Dai, *Deformable ConvNets v2: More Deformable, Better Results*, CVPR 2019. Each tap of a 3 x 3 kernel
reads the features at its own position plus an offset, which differs from pixel to pixel, and the value is multiplied by
a mask.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

_CHUNK = 2**20
"""Number of values that are read at once, so that they stay in the processor's cache."""


def deformable_conv3x3(x: Tensor, offsets: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """Convolve features with 3 x 3 kernels whose taps are displaced; features outside the image are 0.

    Args:
        x: (B, C, H, W) features.
        offsets: (B, 18, H, W) displacements in pixels, (dy, dx) for each tap, row by row.
        mask: (B, 9, H, W) factors of the taps.
        weight: (B, D, C, 3, 3) kernels of each image.

    Returns:
        (B, D, H, W).

    """
    batch, channels, height, width = x.shape
    kernels = weight.flatten(2)  # (B, D, C * 9)
    features = x.contiguous()
    count = max(1, _CHUNK // (batch * channels * 9 * width))
    results = []
    for top in range(0, height, count):
        rows = slice(top, min(top + count, height))
        grid = _sampling_grid(offsets[:, :, rows], top, height)  # (B, 9 * rows, W, 2)
        values = functional.grid_sample(features, grid, align_corners=False).view(batch, channels, 9, -1, width)
        values = values * mask[:, None, :, rows]
        result = (kernels @ values.flatten(3).flatten(1, 2)).unflatten(2, (-1, width))  # (B, D, rows, W)
        results.append(result.contiguous(memory_format=torch.channels_last))
    return torch.cat(results, dim=2)


def _sampling_grid(offsets: Tensor, top: int, height: int) -> Tensor:
    """Return the positions that the taps of some rows read, as ``grid_sample`` expects them."""
    rows, width = offsets.shape[-2:]
    taps = torch.arange(-1, 2, device=offsets.device)
    y = torch.arange(top, top + rows, device=offsets.device)[:, None] + taps.repeat_interleave(3)[:, None, None]
    x = torch.arange(width, device=offsets.device) + taps.repeat(3)[:, None, None]
    y = (offsets[:, ::2] + y) * (2 / height) + (1 / height - 1)  # (B, 9, rows, W)
    x = (offsets[:, 1::2] + x) * (2 / width) + (1 / width - 1)
    return torch.stack((x, y), dim=-1).flatten(1, 2)
