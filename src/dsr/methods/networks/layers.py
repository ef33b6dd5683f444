"""The layers that MSG-Net is made of, fast on the CPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


class ConvLayer(nn.Module):
    """A convolution that keeps the size, or a transposed one that doubles it, and its PReLU."""

    def __init__(self, conv: nn.Conv2d | nn.ConvTranspose2d, slopes: int) -> None:
        """Put ``slopes`` (1, one per channel, or 0 for none) PReLU parameters behind ``conv``."""
        super().__init__()
        self.conv = conv
        self.activation = nn.PReLU(slopes) if slopes else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C_in, H, W) to (B, C_out, H', W')."""
        x = self.conv(x)
        if isinstance(self.activation, nn.PReLU) and self.activation.num_parameters == 1:
            # In place, without a second map of this size, but only where no gradient can ever be asked for.
            if torch.is_inference(x):
                return functional.leaky_relu_(x, float(self.activation.weight))
            if x.device.type == "cpu":
                return _SharedPReLU.apply(x, self.activation.weight)
        return self.activation(x)


class _SharedPReLU(torch.autograd.Function):
    """A PReLU with one slope; its gradient on the CPU takes a fraction of the library's time."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, slope: Tensor) -> Tensor:
        """Return x where it is positive, else slope * x."""
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
        """Take the three layers."""
        super().__init__()
        self.up, self.fuse, self.refine = up, fuse, refine

    def forward(self, depth: Tensor, guide: Tensor) -> Tensor:
        """Map depth features (B, C, h, w) and guidance features (B, 32, H, W) to (B, 32, H, W), H about 2 h."""
        return self.refine(self.fuse(torch.cat((guide, self.up(depth)), dim=1)))
