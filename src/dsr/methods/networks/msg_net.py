"""MSG-Net, the multi-scale guided depth super-resolution network.

Hui, Loy, Tang, *Depth Map Super-Resolution by Deep Multi-Scale Guidance*, ECCV 2016 (variant ``hui``), and the version
that Voynov et al., *Perceptual Deep Depth Super-Resolution*, ICCV 2019, trained for renderings (variant ``voynov``);
``dsr`` is the latter as this project trains it.

The network refines the difference of the normalised low-resolution disparity to its 3 x 3 mean, which is upsampled
bicubically and added back, guided by an intensity image. ``hui`` is a Caffe network: the last row and column are
missing, and its PReLUs have a slope for each channel. ``voynov`` subtracts its mean over a flat probe, the *drift*.
``dsr`` has no drift, its guidance is the luma alone, and holes are inpainted instead of set to the minimum.
"""

import math
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.images import LUMA, compute_min_max, grey, inpaint, mean3x3, normalise, upsample_bicubic
from dsr.methods.networks.network import DisparityNetwork, expect_rgb_size
from dsr.utils.guards import expect_one_of

VariantName = Literal["hui", "voynov", "dsr"]

FEATURES = 32
_INTENSITY = {  # weights of red, green and blue in 0..255, and an offset
    "hui": ((65.481 / 255, 128.553 / 255, 24.966 / 255), 16.0),  # BT.601 luma with its 16..235 range
    # The released code uses the inverse YCbCr transform as the forward one; the weights were trained with it.
    "voynov": ((1.0, -0.34414, -0.71414), 128 * (0.34414 + 0.71414)),
    "dsr": (LUMA, 0.0),
}
# of variant dsr: a small gain of the residual reduces the effect of an optimiser step on smooth surfaces
_DEPTH_GAIN, _RESIDUAL_GAIN = 10.0, 0.05


class ConvLayer(nn.Module):
    """A convolution, transposed if it doubles the size, and a PReLU of one slope, one for each channel, or none."""

    def __init__(self, conv: nn.Conv2d | nn.ConvTranspose2d, slopes: int) -> None:
        super().__init__()
        self.conv = conv
        self.activation = nn.PReLU(slopes) if slopes else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C_in, H, W) to (B, C_out, H', W')."""
        x = self.conv(x)
        shared = isinstance(self.activation, nn.PReLU) and self.activation.num_parameters == 1
        if not shared or x.device.type != "cpu" or torch.compiler.is_compiling():
            return self.activation(x)
        slope = self.activation.get_parameter("weight")
        if torch.is_inference(x):  # in place, to save memory, but only here, where no gradient can be requested
            return functional.leaky_relu_(x, float(slope))
        return _SharedPReLU.apply(x, slope)


class _SharedPReLU(torch.autograd.Function):
    """A PReLU with one slope, whose gradient on the CPU is several times as fast as the library's."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        ctx.slope = float(slope)
        return functional.leaky_relu(x, ctx.slope)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        (x,) = ctx.saved_tensors
        sum_type = torch.promote_types(x.dtype, torch.float32)
        of_slope = (gradient * x.clamp(max=0)).sum(dtype=sum_type).reshape(1)
        return torch.where(x > 0, gradient, ctx.slope * gradient), of_slope


class Level(nn.Module):
    """One doubling of the resolution: transposed convolution, fusion with the guidance, refinement."""

    def __init__(self, up: ConvLayer, fuse: ConvLayer, refine: ConvLayer) -> None:
        super().__init__()
        self.up, self.fuse, self.refine = up, fuse, refine

    def forward(self, depth: Tensor, guide: Tensor) -> Tensor:
        """Map depth features (B, C, h, w) and guidance features (B, 32, H, W) to (B, 32, H, W), H about 2 h."""
        return self.refine(self.fuse(torch.cat((guide, self.up(depth)), dim=1)))


def guidance_map(
    rgb: Tensor, variant: VariantName, intensity_range: Tensor | None = None, detail_range: Tensor | None = None
) -> Tensor:
    """Return the guidance map (B, 1, H, W) of an image (B, 3, H, W) in 0..1.

    The intensity is normalised, its 3 x 3 mean is subtracted, and the result is normalised again to 0..1; the map of
    ``dsr`` is the intensity in -1..1. The ranges, (B, 2, 1, 1), are those of the whole image if ``rgb`` is a window.
    """
    intensity = intensity_of(rgb, variant)
    if variant == "dsr":
        return intensity / 127.5 - 1
    intensity = normalise(intensity, intensity_range).values
    return normalise(intensity - mean3x3(intensity), detail_range).values


def intensity_of(rgb: Tensor, variant: VariantName) -> Tensor:
    """Return the intensity of an image, (B, 1, H, W) in 0..255."""
    weights, offset = _INTENSITY[variant]
    return (grey(255 * rgb, weights) + offset).clip(0, 255)


class MSGNet(DisparityNetwork):
    """The network of all variants; modules are registered in the order in which data passes them.

    Example:
        >>> import torch
        >>> from dsr.methods.networks.msg_net import MSGNet
        >>> MSGNet(4)(torch.rand(1, 1, 32, 32), torch.rand(1, 1, 8, 8)).shape
        torch.Size([1, 1, 32, 32])

    """

    def __init__(self, scale: int, variant: VariantName = "voynov") -> None:
        super().__init__()
        check_scale(scale)
        expect_one_of("variant", variant, get_args(VariantName))
        self.scale, self.variant = scale, variant
        self.covers = variant != "hui"
        levels = scale.bit_length() - 1
        self.guidance = nn.ModuleList([self._conv(1, 49, kernel=7), self._conv(49, FEATURES)])
        self.guidance.extend(self._conv(FEATURES, FEATURES) for _ in range(levels - 1))
        self.pool = nn.MaxPool2d(3, stride=2, padding=1 if self.covers else 0, ceil_mode=not self.covers)
        self.stem = self._conv(1, 2 * FEATURES)
        self.levels = nn.ModuleList()
        for i in range(levels):
            before = FEATURES if i else 2 * FEATURES
            padding, extra = (2, 1) if self.covers else (1 if i else 2, 0)
            up = ConvLayer(nn.ConvTranspose2d(before, FEATURES, 5, 2, padding, extra), 1 if self.covers else FEATURES)
            self.levels.append(Level(up, self._conv(2 * FEATURES, FEATURES), self._conv(FEATURES, FEATURES)))
        self.smooth = self._conv(FEATURES, FEATURES)
        self.reconstruct = ConvLayer(nn.Conv2d(FEATURES, 1, 5, padding=2), 1 if self.covers else 0)
        self.receptive_field_radius = self.rows_seen(0) + 2  # two are for the uneven padding of ``hui``
        if variant == "dsr":
            self._start_smooth()

    def _conv(self, before: int, after: int, kernel: int = 5) -> ConvLayer:
        return ConvLayer(nn.Conv2d(before, after, kernel, padding=kernel // 2), 1 if self.covers else after)

    def forward(self, guidance: Tensor, depth: Tensor) -> Tensor:
        """Map guidance (B, 1, H, W) and normalised disparity less its mean (B, 1, h, w) to the residual."""
        pyramid = [self.guidance[1](self.guidance[0](guidance))]  # (B, 32, H, W), (B, 32, H / 2, W / 2), ...
        for layer in self.guidance[2:]:
            pyramid.append(self.pool(layer(pyramid[-1])))
        x = self.stem(depth)
        for level, guide in zip(self.levels, reversed(pyramid), strict=True):
            x = level(x, guide)  # (B, 32, 2 h, 2 w), (B, 32, 4 h, 4 w), ...
        return self.reconstruct(self.smooth(x))

    def upsample(
        self,
        rgb: Tensor,
        disparity: Tensor,
        min_max: Tensor | None = None,
        intensity_range: Tensor | None = None,
        detail_range: Tensor | None = None,
        drift: Tensor | None = None,
    ) -> Tensor:
        """Return high-resolution disparity, see the base class; (B, 1, H - 1, W - 1) for the ``hui`` variant."""
        expect_rgb_size(rgb, disparity, self.scale)
        values, minimum, value_range = normalise(disparity, min_max)
        if self.variant == "dsr":
            values = inpaint(torch.where(disparity.isfinite(), values, torch.nan))
        low_pass = mean3x3(values)
        height, width = (self.scale * n - (0 if self.covers else 1) for n in values.shape[-2:])
        guidance = guidance_map(rgb, self.variant, intensity_range, detail_range)[..., :height, :width]
        output = self.residual(guidance, values - low_pass)
        if self.variant == "voynov":
            output = output - (self.drift(guidance, values) if drift is None else drift)
        output = output + upsample_bicubic(low_pass, self.scale)[..., :height, :width]
        return output * value_range + minimum

    def context(self, rgb: Tensor, disparity: Tensor) -> tuple[Tensor | None, ...]:
        """Return the ranges of disparity, intensity and detail, and the drift; None for what the variant lacks."""
        if self.variant == "dsr":
            return compute_min_max(disparity), None, None, None
        intensity = intensity_of(rgb, self.variant)
        values = normalise(intensity).values
        drift = None
        if self.variant == "voynov":
            drift = self.drift(guidance_map(rgb, self.variant), normalise(disparity).values)
        return compute_min_max(disparity), compute_min_max(intensity), compute_min_max(values - mean3x3(values)), drift

    def fill(self, disparity: Tensor) -> Tensor:
        """Return disparity without holes, for a variant that inpaints them."""
        return inpaint(disparity) if self.variant == "dsr" else disparity

    def residual(self, guidance: Tensor, depth: Tensor) -> Tensor:
        """Run the network in the precision of its weights; the output has the dtype of ``depth``, at least float32."""
        dtype = self.stem.conv.weight.dtype
        depth_gain, residual_gain = (_DEPTH_GAIN, _RESIDUAL_GAIN) if self.variant == "dsr" else (1.0, 1.0)
        output = self(guidance.to(dtype), (depth_gain * depth).to(dtype))
        return residual_gain * output.to(torch.promote_types(depth.dtype, torch.float32))

    def drift(self, guidance: Tensor, values: Tensor) -> Tensor:
        """Return the constant offset of the output of a ``voynov`` network, (B, 1, 1, 1).

        As in the released code: the first quarter of rows and columns of the normalised disparity, (B, 1, h, w), is set
        to 0.5, and the output is averaged over rows h // 16 .. h // 4 - h // 16 of high-resolution pixels, and columns.
        The network runs only on the inputs that these depend on. Without any, the offset is 0.
        """
        height, width = values.shape[-2:]
        rows, columns = (slice(n // 16, n // 4 - n // 16) for n in (height, width))
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return values.new_zeros((len(values), 1, 1, 1))
        probe = values.clone()
        probe[..., : height // 4, : width // 4] = 0.5
        probe = probe - mean3x3(probe)
        height, width = min(height, self.rows_seen(rows.stop)), min(width, self.rows_seen(columns.stop))
        output = self.residual(guidance[..., : self.scale * height, : self.scale * width], probe[..., :height, :width])
        return output[..., rows, columns].mean((-2, -1), keepdim=True)

    def rows_seen(self, rows: int) -> int:
        """Return how many low-resolution rows (times scale, guidance rows) the outputs 0 .. ``rows`` - 1 depend on."""
        seen = rows + 4  # reconstruction, smoothing
        for _ in self.levels:
            seen = (seen + 4 + 1) // 2 + 1  # refinement and fusion, then the transposed convolution
        return seen + 2

    @torch.no_grad()
    def _start_smooth(self) -> None:
        """Initialise with interpolating kernels and a small residual: random ones leave a checkerboard."""
        line = torch.tensor([0.0, 0.5, 1.0, 0.5, 0.0])
        slope = 0.25  # of a new PReLU
        for layer in self.modules():
            if isinstance(layer, nn.ConvTranspose2d):
                inputs, outputs = layer.weight.shape[:2]
                gains = torch.randn(inputs, outputs) * math.sqrt(2 / ((1 + slope**2) * inputs))
                layer.weight.copy_(gains[:, :, None, None] * torch.outer(line, line))
            elif isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, a=slope)
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d) and layer.bias is not None:
                nn.init.zeros_(layer.bias)
        self.reconstruct.conv.weight.mul_(0.05)
