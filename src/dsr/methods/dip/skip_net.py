"""The untrained network of deep image priors: an hourglass with narrow skip connections.

Ulyanov, Vedaldi, Lempitsky, *Deep Image Prior*, CVPR 2018, supplementary material. In the encoder, each level halves
the resolution by a strided 3 x 3 convolution, followed by another one. In the decoder, each level doubles it
bilinearly, concatenates the skip connection and applies a 3 x 3 and a 1 x 1 convolution. Batch normalisation over the
image and a leaky ReLU follow every convolution.

Differences from the original: convolutions are padded with zeros, the last one always computes in float32,
and the widths may differ between levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


class SkipNet(nn.Module):
    """An hourglass with skip connections.

    Args:
        inputs: number of input channels.
        outputs: number of output channels.
        widths: channels of each level, full resolution first.
        skips: channels of each level's skip connection.

    """

    def __init__(self, inputs: int, outputs: int, widths: Sequence[int], skips: Sequence[int]) -> None:
        super().__init__()
        above = [inputs, *widths[:-1]]
        below = [*widths[1:], widths[-1]]
        self.skip = nn.ModuleList(_block(i, s, 1) for i, s in zip(above, skips, strict=True))
        self.down = nn.ModuleList(
            nn.Sequential(_block(i, w, 3, 2), _block(w, w, 3)) for i, w in zip(above, widths, strict=True)
        )
        self.norm = nn.ModuleList(_Norm(s + b) for s, b in zip(skips, below, strict=True))
        self.up = nn.ModuleList(
            nn.Sequential(_block(s + b, w, 3), _block(w, w, 1)) for s, b, w in zip(skips, below, widths, strict=True)
        )
        self.last = nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H, W), at least in float32."""
        sides: list[Tensor] = []
        for skip, down in zip(self.skip, self.down, strict=True):
            sides.append(skip(x))
            x = down(x)
        for side, norm, up in zip(reversed(sides), reversed(self.norm), reversed(self.up), strict=True):
            x = upsample_2x(x)
            if x.shape[-2:] != side.shape[-2:]:  # the side is odd
                x = x[..., : side.shape[-2], : side.shape[-1]]
            x = up(norm(torch.cat((side, x), dim=1)))
        with torch.autocast(x.device.type, enabled=False):  # bfloat16 would round depth to 256 steps
            return self.last(x.to(self.last.weight.dtype))


def levels_for(height: int, width: int, most: int) -> int:
    """Return the number of levels of a SkipNet for an image size, between 1 and ``most``."""
    levels, side = 0, min(height, width)
    while levels < most and (side := -(-side // 2)) >= 2:  # for batch normalisation
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
        """Mix the two nearest pixels with weights 1/4 and 3/4 along each axis."""
        channels_last = x.is_contiguous(memory_format=torch.channels_last)
        layout = torch.channels_last if channels_last else torch.contiguous_format
        with torch.autocast(x.device.type, enabled=False):  # which pads in float32
            x = functional.pad(x, (1, 1, 1, 1), mode="replicate")
        for axis in (2, 3):
            size, shape = x.shape[axis] - 2, list(x.shape)
            shape[axis] = 2 * size
            out = torch.empty(shape, dtype=x.dtype, device=x.device, memory_format=layout)
            even, odd = out.unflatten(axis, (size, 2)).unbind(axis + 1)
            here = x.narrow(axis, 1, size)
            torch.lerp(here, x.narrow(axis, 0, size), 0.25, out=even)
            torch.lerp(here, x.narrow(axis, 2, size), 0.25, out=odd)
            x = out
        return x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Apply the transpose."""
        for axis in (3, 2):
            size = gradient.shape[axis] // 2
            even, odd = gradient.unflatten(axis, (size, 2)).unbind(axis + 1)
            out = (even + odd).mul_(0.75)
            out.narrow(axis, 0, size - 1).add_(even.narrow(axis, 1, size - 1), alpha=0.25)
            out.narrow(axis, 1, size - 1).add_(odd.narrow(axis, 0, size - 1), alpha=0.25)
            ends = gradient.transpose(0, axis)[:: 2 * size - 1].transpose(0, axis)  # the first and the last
            if size == 1:
                ends = ends.sum(axis, keepdim=True)
            out.transpose(0, axis)[:: max(size - 1, 1)].transpose(0, axis).add_(ends, alpha=0.25)
            gradient = out
        return gradient


class _Norm(nn.BatchNorm2d):
    """A batch normalisation that always uses the statistics of the current image."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, track_running_stats=False)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (B, C, H, W); nn.BatchNorm2d's own call allocates a buffer that this one does not need."""
        return torch.native_batch_norm(x, self.weight, self.bias, None, None, True, 0.1, self.eps)[0]


def _block(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Return a convolution, normalisation and activation."""
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)
    return nn.Sequential(convolution, _Norm(outputs), nn.LeakyReLU(0.2, inplace=True))
