"""Layers of MSG-Net, optimised for the CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.exportable import exporting


class ConvLayer(nn.Module):
    """A convolution that keeps the size, or a transposed one that doubles it, followed by a PReLU."""

    def __init__(self, conv: nn.Conv2d | nn.ConvTranspose2d, slopes: int) -> None:
        """Append a PReLU with ``slopes`` parameters (1, one per channel, or 0 for no PReLU) to ``conv``."""
        super().__init__()
        self.conv = conv
        self.activation = nn.PReLU(slopes) if slopes else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C_in, H, W) to (B, C_out, H', W')."""
        x = self.conv(x)
        if isinstance(self.activation, nn.PReLU) and self.activation.num_parameters == 1 and not exporting():
            # In place, to save memory, but only in inference mode, where no gradient can be requested.
            if torch.is_inference(x):
                return functional.leaky_relu_(x, float(self.activation.weight))
            if x.device.type == "cpu":
                return _SharedPReLU.apply(x, self.activation.weight)
        return self.activation(x)


class _SharedPReLU(torch.autograd.Function):
    """A PReLU with one slope, whose gradient on the CPU is several times as fast as the library's."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, slope: Tensor) -> Tensor:
        """Return x if positive, else slope * x."""
        ctx.save_for_backward(x)
        ctx.slope = float(slope)
        return functional.leaky_relu(x, ctx.slope)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of x and of the slope, (1,)."""
        (x,) = ctx.saved_tensors
        sum_type = torch.promote_types(x.dtype, torch.float32)
        of_slope = (gradient * x.clamp(max=0)).sum(dtype=sum_type).reshape(1)
        return torch.where(x > 0, gradient, ctx.slope * gradient), of_slope


class Level(nn.Module):
    """One doubling of the resolution: transposed convolution, fusion with the guidance, refinement."""

    def __init__(self, up: ConvLayer, fuse: ConvLayer, refine: ConvLayer) -> None:
        """Store the three layers."""
        super().__init__()
        self.up, self.fuse, self.refine = up, fuse, refine

    def forward(self, depth: Tensor, guide: Tensor) -> Tensor:
        """Map depth features (B, C, h, w) and guidance features (B, 32, H, W) to (B, 32, H, W), H about 2 h."""
        return self.refine(self.fuse(torch.cat((guide, self.up(depth)), dim=1)))
