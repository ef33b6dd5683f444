"""MSG-Net, the multi-scale guided depth super-resolution network: its variants, inputs, layers and output.

Hui, Loy, Tang, *Depth Map Super-Resolution by Deep Multi-Scale Guidance*, ECCV 2016 (variant ``hui``), and the version
that Voynov et al., *Perceptual Deep Depth Super-Resolution*, ICCV 2019, trained for renderings (variant ``voynov``);
``dsr`` is the latter as this project trains it.

The network refines the difference of the normalised low-resolution disparity to its 3 x 3 mean, guided by a normalised
intensity image. The mean itself is upsampled bicubically and added back. All functions are batched, differentiable, and
work on any device and for any image size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.images import LUMA, compute_min_max, inpaint, mean3x3, normalise, upsample_bicubic
from dsr.methods.networks.network import DisparityNetwork

VariantName = Literal["hui", "voynov", "dsr"]

FEATURES = 32


class ConvLayer(nn.Module):
    """A convolution that keeps the size, or a transposed one that doubles it, followed by a PReLU."""

    def __init__(self, conv: nn.Conv2d | nn.ConvTranspose2d, slopes: int) -> None:
        super().__init__()  # a PReLU with one slope, one per channel, or none
        self.conv = conv
        self.activation = nn.PReLU(slopes) if slopes else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C_in, H, W) to (B, C_out, H', W')."""
        x = self.conv(x)
        if isinstance(self.activation, nn.PReLU) and self.activation.num_parameters == 1:
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


@dataclass(frozen=True)
class MSGVariant:
    """The differences between the published networks and dsr's, and between their inputs.

    Args:
        name: name of the variant.
        shared_slopes: whether each PReLU has a single slope, else one per channel.
        activate_output: whether a PReLU follows the reconstruction.
        same_size: whether the output has scale * h rows, else scale * h - 1 (Caffe's transposed convolutions have no
            output padding), and likewise columns; the guidance has the output's size.
        rgb_weights, rgb_offset: intensity = weights . (R, G, B in 0..255) + offset, clipped to 0..255.
        plain_guidance: whether the guidance is the intensity, -1..1, which does not depend on the rest of the image;
            else see :func:`guidance_map`.
        depth_gain, residual_gain: factors of the input depth and of the output residual. A small residual gain reduces
            the effect of an optimiser step on smooth surfaces.
        fill_holes: whether holes of the low-resolution map are inpainted; else they are set to the minimum disparity.
        drift_compensation: whether the output's mean over a flat probe is subtracted from the output, see
            :func:`dsr.methods.networks.msg_net.output_drift`.

    """

    name: VariantName
    shared_slopes: bool
    activate_output: bool
    same_size: bool
    rgb_weights: tuple[float, float, float]
    rgb_offset: float
    drift_compensation: bool
    plain_guidance: bool = False
    depth_gain: float = 1.0
    residual_gain: float = 1.0
    fill_holes: bool = False


VARIANTS = MappingProxyType(
    {
        # BT.601 luma with its 16..235 range.
        "hui": MSGVariant("hui", False, False, False, (65.481 / 255, 128.553 / 255, 24.966 / 255), 16.0, False),
        # The released code uses the inverse YCbCr transform as the forward one; the weights were trained with it.
        "voynov": MSGVariant("voynov", True, True, True, (1.0, -0.34414, -0.71414), 128 * (0.34414 + 0.71414), True),
        # The variant that dsr trains: the graph of voynov, guided by luma, without drift compensation.
        "dsr": MSGVariant("dsr", True, True, True, LUMA, 0.0, False, True, 10.0, 0.05, True),
    }
)


def guidance_map(
    rgb: Tensor, variant: MSGVariant, intensity_range: Tensor | None = None, detail_range: Tensor | None = None
) -> Tensor:
    """Return the guidance map (B, 1, H, W) of an image (B, 3, H, W) in 0..1.

    The intensity (see :class:`MSGVariant`) is normalised, its 3 x 3 mean is subtracted, and the result is normalised
    again to 0..1. With plain guidance, the map is the intensity in -1..1. The ranges, (B, 2, 1, 1), are those of the
    whole image if ``rgb`` is a window.
    """
    intensity = intensity_of(rgb, variant)
    if variant.plain_guidance:
        return intensity / 127.5 - 1
    intensity = normalise(intensity, intensity_range).values
    return normalise(intensity - mean3x3(intensity), detail_range).values


def intensity_of(rgb: Tensor, variant: MSGVariant) -> Tensor:
    """Return the intensity of an image, (B, 1, H, W) in 0..255."""
    weights = torch.tensor(variant.rgb_weights, dtype=rgb.dtype, device=rgb.device)[:, None, None]
    return ((255 * rgb * weights).sum(-3, keepdim=True) + variant.rgb_offset).clip(0, 255)


class MSGNet(DisparityNetwork):
    """The network of all variants; modules are registered in the order in which data passes them.

    Args:
        scale: upsampling factor, 2, 4, 8 or 16; log2(scale) levels.
        variant: ``hui``, ``voynov`` or ``dsr``.

    Example:
        >>> import torch
        >>> from dsr.methods.networks.msg_net import MSGNet
        >>> MSGNet(4)(torch.rand(1, 1, 32, 32), torch.rand(1, 1, 8, 8)).shape
        torch.Size([1, 1, 32, 32])

    """

    def __init__(self, scale: int, variant: VariantName = "voynov") -> None:
        super().__init__()
        check_scale(scale)
        if variant not in VARIANTS:
            raise ValueError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
        self.scale = scale
        self.variant = VARIANTS[variant]
        self.covers = self.variant.same_size
        levels = scale.bit_length() - 1
        self.guidance = nn.ModuleList([self._conv(1, 49, kernel=7), self._conv(49, FEATURES)])
        self.guidance.extend(self._conv(FEATURES, FEATURES) for _ in range(levels - 1))
        padding = 1 if self.variant.same_size else 0
        self.pool = nn.MaxPool2d(3, stride=2, padding=padding, ceil_mode=not self.variant.same_size)
        self.stem = self._conv(1, 2 * FEATURES)
        self.levels = nn.ModuleList(
            Level(self._up(first=i == 0), self._conv(2 * FEATURES, FEATURES), self._conv(FEATURES, FEATURES))
            for i in range(levels)
        )
        self.smooth = self._conv(FEATURES, FEATURES)
        self.reconstruct = self._conv(FEATURES, 1, active=self.variant.activate_output)
        self.receptive_field_radius = self.rows_seen(0) + 2  # two are for the uneven padding of ``hui``
        if variant == "dsr":
            self._start_smooth()

    def forward(self, guidance: Tensor, depth: Tensor) -> Tensor:
        """Map normalised inputs to the high-resolution residual, (B, 1, H, W), in units of the disparity's range.

        ``guidance`` (B, 1, H, W) is that of :func:`guidance_map` in the size of :meth:`output_size`, ``depth``
        (B, 1, h, w) normalised disparity minus its mean.
        """
        if guidance.shape[-2:] != self.output_size(depth):
            raise ValueError(
                f"guidance: expected {tuple(self.output_size(depth))} for depth of {tuple(depth.shape[-2:])} at scale "
                f"{self.scale} ({self.variant.name}), got {tuple(guidance.shape[-2:])}"
            )
        pyramid = [self.guidance[1](self.guidance[0](guidance))]  # (B, 32, H, W), (B, 32, H / 2, W / 2), ...
        for layer in self.guidance[2:]:
            pyramid.append(self.pool(layer(pyramid[-1])))
        x = self.stem(depth)
        for level, guide in zip(self.levels, reversed(pyramid), strict=True):
            x = level(x, guide)  # (B, 32, 2 h, 2 w), (B, 32, 4 h, 4 w), ...
        return self.reconstruct(self.smooth(x))

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"scale": self.scale, "variant": self.variant.name}

    def upsample(
        self,
        rgb: Tensor,
        disparity: Tensor,
        min_max: Tensor | None = None,
        intensity_range: Tensor | None = None,
        detail_range: Tensor | None = None,
        drift: Tensor | None = None,
    ) -> Tensor:
        """Return high-resolution disparity; see :meth:`~dsr.methods.networks.network.DisparityNetwork.upsample`.

        It is (B, 1, H - 1, W - 1) for the ``hui`` variant, and can be negative.
        """
        values, minimum, value_range = normalise(disparity, min_max)
        if self.variant.fill_holes:
            values = inpaint(torch.where(disparity.isfinite(), values, torch.nan))
        low_pass = mean3x3(values)
        height, width = self.output_size(values)
        guidance = guidance_map(rgb, self.variant, intensity_range, detail_range)[..., :height, :width]
        output = self.residual(guidance, values - low_pass)
        if self.variant.drift_compensation:
            output = output - (output_drift(self, guidance, values) if drift is None else drift)
        output = output + upsample_bicubic(low_pass, self.scale)[..., :height, :width]
        return output * value_range + minimum

    def context(self, rgb: Tensor, disparity: Tensor) -> tuple[Tensor | None, ...]:
        """Return the ranges of disparity, intensity and detail, and the drift; None for what the variant lacks."""
        intensity = detail = drift = None
        if not self.variant.plain_guidance:
            grey = intensity_of(rgb, self.variant)
            intensity, grey = compute_min_max(grey), normalise(grey).values
            detail = compute_min_max(grey - mean3x3(grey))
        if self.variant.drift_compensation:
            drift = output_drift(self, guidance_map(rgb, self.variant), normalise(disparity).values)
        return compute_min_max(disparity), intensity, detail, drift

    def fill(self, disparity: Tensor) -> Tensor:
        """Return disparity without holes, for a variant that inpaints them."""
        return inpaint(disparity) if self.variant.fill_holes else disparity

    def residual(self, guidance: Tensor, depth: Tensor) -> Tensor:
        """Run the network in the precision of its weights; the output has the dtype of ``depth``, at least float32."""
        dtype = self.stem.conv.weight.dtype
        output = self(guidance.to(dtype), (self.variant.depth_gain * depth).to(dtype))
        return self.variant.residual_gain * output.to(torch.promote_types(depth.dtype, torch.float32))

    def output_size(self, depth: Tensor) -> torch.Size:
        """Return the output's size (H, W) for depth of (..., h, w)."""
        lost = 0 if self.variant.same_size else 1
        return torch.Size(self.scale * n - lost for n in depth.shape[-2:])

    def rows_seen(self, rows: int) -> int:
        """Return how many low-resolution rows (times scale, guidance rows) the outputs 0 .. ``rows`` - 1 depend on.

        The same number holds for columns. It assumes the ``voynov`` variant's padding, and is computed backwards along
        the depth branch: a 5 x 5 convolution needs 2 more rows, and output o of a transposed convolution reads inputs
        up to (o + 2) // 2. The guidance branch needs no more than that at any scale.
        """
        seen = rows + 4  # reconstruction, smoothing
        for _ in self.levels:
            seen = (seen + 4 + 1) // 2 + 1  # refinement and fusion, then the transposed convolution
        return seen + 2

    @torch.no_grad()
    def _start_smooth(self) -> None:
        """Initialise with interpolating kernels, zero biases and a small residual, for a smooth initial output.

        A random transposed convolution treats even and odd pixels differently. This causes a checkerboard on smooth
        surfaces, which training removes only slowly. A bilinear kernel treats them alike.
        """
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

    def _conv(self, before: int, after: int, *, kernel: int = 5, active: bool = True) -> ConvLayer:
        slopes = 1 if self.variant.shared_slopes else after
        return ConvLayer(nn.Conv2d(before, after, kernel, padding=kernel // 2), slopes if active else 0)

    def _up(self, *, first: bool) -> ConvLayer:
        same_size = self.variant.same_size
        padding, extra = 2 if first or same_size else 1, 1 if same_size else 0
        before = 2 * FEATURES if first else FEATURES
        slopes = 1 if self.variant.shared_slopes else FEATURES
        return ConvLayer(nn.ConvTranspose2d(before, FEATURES, 5, 2, padding, extra), slopes)


def output_drift(net: MSGNet, guidance: Tensor, disparity: Tensor, *, crop: bool = True) -> Tensor:
    """Return the constant offset of the output of a ``voynov`` network, (B, 1, 1, 1).

    The first quarter of rows and columns of the normalised disparity, (B, 1, h, w), is set to 0.5. The network's output
    is averaged over rows h // 16 .. h // 4 - h // 16 and the corresponding columns, where the indices count
    high-resolution pixels, as in the released code. The offset is 0 where that region is empty. With ``crop`` the
    network runs only on the inputs that those pixels depend on: the same value in less time.
    """
    height, width = disparity.shape[-2:]
    rows, columns = (slice(n // 16, n // 4 - n // 16) for n in (height, width))
    if rows.stop <= rows.start or columns.stop <= columns.start:
        return disparity.new_zeros((len(disparity), 1, 1, 1))
    probe = disparity.clone()
    probe[..., : height // 4, : width // 4] = 0.5
    probe = probe - mean3x3(probe)
    if crop:
        height, width = (min(n, net.rows_seen(s.stop)) for n, s in ((height, rows), (width, columns)))
    guidance = guidance[..., : net.scale * height, : net.scale * width]
    output = net.residual(guidance, probe[..., :height, :width])
    return output[..., rows, columns].mean((-2, -1), keepdim=True)
