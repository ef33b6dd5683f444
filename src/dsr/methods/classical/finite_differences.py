"""Finite differences and their adjoints, block means and the initial map: operators that variational methods share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.networks.normalisation import upsample_bicubic

LUMA = (0.299, 0.587, 0.114)  # weights of red, green and blue in the luma (ITU-R BT.601)
_REACH = 2  # half width of Keys' kernel in low-resolution pixels


def gradient(x: Tensor) -> Tensor:
    """Return forward differences along u and v, (B, C, H, W) -> (B, 2, C, H, W); 0 in the last column and row."""
    along_u, along_v = functional.pad(x.diff(dim=-1), (0, 1)), functional.pad(x.diff(dim=-2), (0, 0, 0, 1))
    return torch.stack((along_u, along_v), dim=1)


def divergence(p: Tensor) -> Tensor:
    """Return minus the adjoint of :func:`gradient`, (B, 2, C, H, W) -> (B, C, H, W).

    <gradient(x), p> = -<x, divergence(p)> for all x and p. The last column of p along u and its last row along v are
    ignored.
    """
    total = torch.zeros_like(p[:, 0])
    along_u, along_v = p[:, 0, ..., :-1], p[:, 1, ..., :-1, :]
    total[..., :-1] += along_u
    total[..., 1:] -= along_u
    total[..., :-1, :] += along_v
    total[..., 1:, :] -= along_v
    return total


def sum_adjacent(p: Tensor) -> Tensor:
    """Return the sum of the values at the differences that use each pixel, (B, 2, C, H, W) -> (B, C, H, W).

    This is the adjoint of :func:`gradient` with absolute values of its coefficients.
    """
    total = torch.zeros_like(p[:, 0])
    along_u, along_v = p[:, 0, ..., :-1], p[:, 1, ..., :-1, :]
    total[..., :-1] += along_u
    total[..., 1:] += along_u
    total[..., :-1, :] += along_v
    total[..., 1:, :] += along_v
    return total


def box_mean(x: Tensor, scale: int) -> Tensor:
    """Return the mean of each scale x scale block, (B, C, H, W) -> (B, C, H / scale, W / scale)."""
    return functional.avg_pool2d(x, scale)


def repeat_blocks(x: Tensor, scale: int) -> Tensor:
    """Repeat each pixel as a scale x scale block, (B, C, h, w) -> (B, C, scale h, scale w)."""
    batch, channels, height, width = x.shape
    blocks = x[:, :, :, None, :, None].expand(batch, channels, height, scale, width, scale)
    return blocks.reshape(batch, channels, height * scale, width * scale)


def grey(rgb: Tensor, weights: Sequence[float] = LUMA) -> Tensor:
    """Return the weighted sum of the channels of (B, 3, H, W) images, by default the luma, (B, 1, H, W)."""
    return (rgb * rgb.new_tensor(weights)[:, None, None]).sum(dim=1, keepdim=True)


def extend_linearly(x: Tensor, border: int) -> Tensor:
    """Extrapolate (B, C, h, w) linearly by ``border`` pixels on each side; planes are continued exactly."""
    for dim in (-1, -2):
        count = x.shape[dim]
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, count - 1, 1)
        before = first - x.narrow(dim, min(1, count - 1), 1)  # 0 where there is a single pixel
        after = last - x.narrow(dim, max(count - 2, 0), 1)
        steps = torch.arange(1, border + 1, dtype=x.dtype, device=x.device).view(-1, *[1] * (-1 - dim))
        x = torch.cat((first + steps.flip(0) * before, x, last + steps * after), dim=dim)
    return x


def upsample_linear_border(lr: Tensor, scale: int) -> Tensor:
    """Upsample (B, 1, h, w) bicubically to (B, 1, scale h, scale w); planes are exact up to the border."""
    if scale == 1:
        return lr.clone()
    edge = _REACH * scale
    return upsample_bicubic(extend_linearly(lr, _REACH), scale)[..., edge:-edge, edge:-edge].contiguous()
