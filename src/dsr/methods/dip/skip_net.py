"""The untrained network of deep image priors: an hourglass with narrow skip connections.

Ulyanov, Vedaldi, Lempitsky, *Deep Image Prior*, CVPR 2018, supplementary material. In the encoder, each level halves
the resolution by a strided 3 x 3 convolution, followed by another one. In the decoder, each level doubles it
bilinearly, concatenates the skip connection and applies a 3 x 3 and a 1 x 1 convolution. Batch normalisation over the
image and a leaky ReLU follow every convolution.

Differences from the original: convolutions are padded with zeros by default, the last one always computes in float32,
and the widths may differ between levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

Padding = Literal["zeros", "reflect"]
_SLOPE = 0.2
_LEAST = 2
"""Minimum shorter side of the deepest level in pixels, for batch normalisation."""


class SkipNet(nn.Module):
    """An hourglass with skip connections.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        widths: channels of each level, full resolution first.
        skips: channels of each level's skip connection.
        padding: padding of the 3 x 3 convolutions, ``zeros``, or ``reflect`` as in the original, which is slow.

    Raises:
        ValueError: there is no level, or the numbers of widths and skips differ.

    """

    def __init__(
        self, inputs: int, outputs: int, widths: Sequence[int], skips: Sequence[int], padding: Padding = "zeros"
    ) -> None:
        super().__init__()
        if not widths or len(widths) != len(skips):
            raise ValueError(f"expected as many skips as widths, and one at least, got {len(skips)} and {len(widths)}")
        above = [inputs, *widths[:-1]]
        below = [*widths[1:], widths[-1]]
        self.skip = nn.ModuleList(_block(i, s, 1) for i, s in zip(above, skips, strict=True))
        self.down = nn.ModuleList(
            nn.Sequential(_block(i, w, 3, 2, padding), _block(w, w, 3, 1, padding))
            for i, w in zip(above, widths, strict=True)
        )
        self.norm = nn.ModuleList(_norm(s + b) for s, b in zip(skips, below, strict=True))
        self.up = nn.ModuleList(
            nn.Sequential(_block(s + b, w, 3, 1, padding), _block(w, w, 1))
            for s, b, w in zip(skips, below, widths, strict=True)
        )
        self.last = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H, W), at least in float32."""
        sides: list[Tensor] = []
        for skip, down in zip(self.skip, self.down, strict=True):
            sides.append(skip(x))
            x = down(x)
        for side, norm, up in zip(reversed(sides), reversed(self.norm), reversed(self.up), strict=True):
            height, width = side.shape[-2:]
            x = up(norm(torch.cat((side, upsample_2x(x)[..., :height, :width]), dim=1)))
        with torch.autocast(x.device.type, enabled=False):  # bfloat16 would round depth to 256 steps
            return self.last(x.to(self.last.weight.dtype))


def levels_for(height: int, width: int, most: int) -> int:
    """Return the number of levels of a SkipNet for an image size, between 1 and ``most``."""
    levels, side = 0, min(height, width)
    while levels < most and (side := -(-side // 2)) >= _LEAST:
        levels += 1
    return max(levels, 1)


def upsample_2x(x: Tensor) -> Tensor:
    """Upsample (B, C, h, w) bilinearly to (B, C, 2 h, 2 w), with pixels as areas and border pixels repeated."""
    result: Tensor = _Upsample2x.apply(x)
    return result


class _Upsample2x(torch.autograd.Function):
    """Bilinear upsampling by slices, whose backward pass is several times as fast as the library's on a CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Upsample along both axes."""
        return _double(_double(x, 2), 3)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Apply the transpose."""
        return _halve(_halve(gradient, 3), 2)


def _double(x: Tensor, axis: int) -> Tensor:
    """Upsample x by 2 along an axis, with weights 1/4 and 3/4 of the two nearest entries."""
    size = x.shape[axis]
    shape = list(x.shape)
    shape[axis] = 2 * size
    out = torch.empty(shape, dtype=x.dtype, device=x.device, memory_format=_memory_format(x))
    even, odd = out.unflatten(axis, (size, 2)).unbind(axis + 1)
    before, after = x.narrow(axis, 0, size - 1), x.narrow(axis, 1, size - 1)
    torch.lerp(after, before, 0.25, out=even.narrow(axis, 1, size - 1))
    torch.lerp(before, after, 0.25, out=odd.narrow(axis, 0, size - 1))
    even.narrow(axis, 0, 1).copy_(x.narrow(axis, 0, 1))
    odd.narrow(axis, size - 1, 1).copy_(x.narrow(axis, size - 1, 1))
    return out


def _halve(gradient: Tensor, axis: int) -> Tensor:
    """Apply the transpose of :func:`_double`."""
    size = gradient.shape[axis] // 2
    even, odd = gradient.unflatten(axis, (size, 2)).unbind(axis + 1)
    out = (even + odd).mul_(0.75)
    out.narrow(axis, 0, size - 1).add_(even.narrow(axis, 1, size - 1), alpha=0.25)
    out.narrow(axis, 1, size - 1).add_(odd.narrow(axis, 0, size - 1), alpha=0.25)
    out.narrow(axis, 0, 1).add_(even.narrow(axis, 0, 1), alpha=0.25)
    out.narrow(axis, size - 1, 1).add_(odd.narrow(axis, size - 1, 1), alpha=0.25)
    return out


def _memory_format(x: Tensor) -> torch.memory_format:
    return torch.channels_last if x.is_contiguous(memory_format=torch.channels_last) else torch.contiguous_format


def _block(inputs: int, outputs: int, kernel: int, stride: int = 1, padding: Padding = "zeros") -> nn.Sequential:
    """Return a convolution, normalisation and activation."""
    mode: Padding = padding if kernel > 1 else "zeros"
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, padding_mode=mode)
    return nn.Sequential(convolution, _norm(outputs), nn.LeakyReLU(_SLOPE, inplace=True))


def _norm(channels: int) -> nn.BatchNorm2d:
    """Return a batch normalisation that always uses the statistics of the current image."""
    return nn.BatchNorm2d(channels, track_running_stats=False)
