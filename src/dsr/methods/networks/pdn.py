"""PDN: the deep primal-dual network for guided depth super-resolution.

Riegler, Ferstl, Rüther and Bischof, *A Deep Primal-Dual Network for Guided Depth Super-Resolution*, BMVC 2016: ten
3 x 3 convolutions look at the upsampled depth and the photo, and say by how much the former is wrong, and how different
each pixel is from half of those in the window around it. The softmax of minus these becomes the weights of a non-local
Huber model, :mod:`dsr.methods.networks.primal_dual`, whose primal-dual iteration makes the answer. The sizes that the
paper leaves open are those of the authors' code (github.com/griegler/primal-dual-networks, gdsr).

What differs from the original:

- It works on disparity, over its range in the low-resolution map. The upsampling is bicubic and exact on planes, the
  original's is bilinear. The convolutions see its differences from local means and its slopes, faint ones enlarged,
  instead of its values, so that bfloat16 is enough for them; and the photo's colours instead of its grey.
- The residual is in multiples of the low-resolution map's *bend* (the largest second difference around, see
  :mod:`dsr.methods.networks.facets_planes`), so that it is 0 on a plane whatever the weights are. Without that, a short
  training left a DSSIM_v of 0.30 instead of 0.22 on procedural scenes.
- The window is 5 x 5, 12 offsets, the original's 7 x 7, 24 offsets, in twice the time; 10 steps, the code has 20.
- Convolutions are padded with zeros, the original's answer is smaller than its input.
- It is trained as one from the start, with the mean squared error of the answer. The original first trains the
  convolutions alone, on the residual and the differences of the true depth, and starts the second stage from there.

On a plane the weights do not count as long as its differences within the window stay below epsilon times the weights,
and it is reproduced; a steeper one is bent where the weights vary.
"""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.classical.finite_differences import extend_linearly, upsample_linear_border
from dsr.methods.networks.base import NormalisedNetwork, expect_rgb_size
from dsr.methods.networks.facets_planes import stencil
from dsr.methods.networks.primal_dual import UnrolledHuber

_FAINT = 1e-3
"""A difference of normalised disparity that becomes about 1 in the network's input."""
_INPUTS = 9
_TINY = 1e-12


class PrimalDualNetwork(NormalisedNetwork):
    """The network.

    Memory: about 900 bytes for each pixel of the photo, or of a window.

    Args:
        scale: upsampling factor, 2, 4, 8 or 16.
        width: number of channels of the convolutions.
        layers: number of 3 x 3 convolutions.
        window: size in pixels of the window that a pixel is compared within, odd.
        iterations: number of unrolled iterations.

    Raises:
        ValueError: a value is out of range.

    """

    def __init__(self, scale: int, width: int = 64, layers: int = 10, window: int = 5, iterations: int = 10) -> None:
        super().__init__()
        check_scale(scale)
        if width < 1 or layers < 2:
            raise ValueError(f"model: expected a width of at least 1 and at least 2 layers, got {width} and {layers}")
        self.scale, self.width, self.layers = scale, width, layers
        self.window, self.iterations = window, iterations
        self.stage = UnrolledHuber(window, iterations)
        channels = [_INPUTS] + [width] * (layers - 1)
        self.trunk = nn.Sequential()
        for before, after in itertools.pairwise(channels):
            self.trunk.extend([nn.Conv2d(before, after, 3, padding=1), nn.ReLU()])
        for layer in self.trunk:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                layer.bias.data.zero_()  # type: ignore[union-attr]
        self.head = nn.Conv2d(width, 1 + len(self.stage.offsets), 3, padding=1)
        self.head.weight.data[:1].zero_()  # no residual at first
        self.head.bias.data.zero_()  # type: ignore[union-attr]
        self.log_strength = nn.Parameter(torch.zeros(()))

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        sizes = {"scale": self.scale, "width": self.width, "layers": self.layers}
        return {**sizes, "window": self.window, "iterations": self.iterations}

    @property
    def receptive_field_radius(self) -> int:
        """Receptive-field radius in low-resolution pixels.

        One high-resolution pixel for each convolution, half a window for each iteration, and four low-resolution pixels
        for the upsampling and the differences of the low-resolution input.
        """
        radius_hr = self.layers + self.stage.receptive_field_radius
        return -(-radius_hr // self.scale) + 4

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Map an image and normalised low-resolution disparity to high-resolution disparity.

        Args:
            rgb: (B, 3, H, W).
            values: (B, 1, h, w).

        Returns:
            (B, 1, H, W).

        """
        expect_rgb_size(rgb, values, self.scale)
        hr = upsample_linear_border(values, self.scale)
        inputs, bend = self._inputs(rgb, values, hr)
        output = self.head(self.trunk(inputs.to(self.head.weight.dtype)))
        with torch.autocast(rgb.device.type, enabled=False):
            output = output.to(torch.float32 if output.dtype == torch.bfloat16 else output.dtype)
            residual = (output[:, :1] * bend).to(hr.dtype)
            strength = self.log_strength.to(output.dtype).exp()
            weights = (-strength * output[:, 1:].abs()).softmax(dim=1) + _TINY
            r = self.window // 2
            first = extend_linearly(hr, 2 * r) + functional.pad(residual, (2 * r,) * 4, mode="replicate")
            moved = self.stage(first[..., r:-r, :], weights)
            return hr + residual + moved.to(hr.dtype)

    def _inputs(self, rgb: Tensor, values: Tensor, hr: Tensor) -> tuple[Tensor, Tensor]:
        """Return the input of the convolutions, (B, 9, H, W), and the bend, the unit of their residual.

        The channels are the 3 colours; the slopes of the low-resolution map along u and v, its difference from the mean
        of 3 x 3 pixels, the difference of the high-resolution map from the same means, and the bend, all compressed so
        that small values count; and the second difference divided by the bend.
        """
        around = stencil(values)
        slopes_lr = torch.cat((around.slopes[:, :, 1], around.value - around.mean), dim=1)
        size = tuple(hr.shape[-2:])
        bend = functional.interpolate(around.bend.float(), size=size, mode="bilinear")
        slopes = functional.interpolate(slopes_lr.float(), size=size, mode="bilinear")
        detail = (hr - upsample_linear_border(around.mean, self.scale)).float()
        relative = detail / bend.clamp(min=torch.finfo(torch.float32).tiny)
        depth = torch.asinh(torch.cat((slopes, detail, bend), dim=1) / _FAINT) / 3
        return torch.cat((rgb.float() - 0.5, depth, relative.clamp(-2, 2)), dim=1), bend
