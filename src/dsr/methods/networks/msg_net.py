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
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import check_scale
from dsr.methods.classical.finite_differences import LUMA
from dsr.methods.exportable import exporting
from dsr.methods.inpainting import inpaint
from dsr.methods.networks.network import GlobalContext, WindowedNetwork
from dsr.methods.networks.normalisation import compute_min_max, mean3x3, normalise, upsample_bicubic

VariantName = Literal["hui", "voynov", "dsr"]

FEATURES = 32


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


class Traits(NamedTuple):
    """The global values of an image that MSG-Net uses, besides the range of the disparity.

    ``intensity`` and ``detail`` (B, 2, 1, 1): minimum and maximum of the intensity and of its difference to its 3 x 3
    mean, None for plain guidance; ``drift`` (B, 1, 1, 1): see :func:`dsr.methods.networks.msg_net.output_drift`, None
    without drift compensation.
    """

    intensity: Tensor | None
    detail: Tensor | None
    drift: Tensor | None


def guidance_map(rgb: Tensor, variant: MSGVariant, traits: Traits | None = None) -> Tensor:
    """Return the guidance map (B, 1, H, W) of an image (B, 3, H, W) in 0..1.

    The intensity (see :class:`MSGVariant`) is normalised, its 3 x 3 mean is subtracted, and the result is normalised
    again to 0..1. With plain guidance, the map is the intensity in -1..1. ``traits`` are those of the whole image if
    ``rgb`` is a window.
    """
    intensity = intensity_of(rgb, variant)
    if variant.plain_guidance:
        return intensity / 127.5 - 1
    intensity = normalise(intensity, traits and traits.intensity).values
    return normalise(intensity - mean3x3(intensity), traits and traits.detail).values


def intensity_of(rgb: Tensor, variant: MSGVariant) -> Tensor:
    """Return the intensity of an image, (B, 1, H, W) in 0..255."""
    weights = torch.tensor(variant.rgb_weights, dtype=rgb.dtype, device=rgb.device)[:, None, None]
    return ((255 * rgb * weights).sum(-3, keepdim=True) + variant.rgb_offset).clip(0, 255)


class MSGNet(WindowedNetwork):
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
        if variant == "dsr":
            self._start_smooth()

    def forward(self, guidance: Tensor, depth: Tensor) -> Tensor:
        """Map normalised inputs to the high-resolution residual.

        Args:
            guidance: (B, 1, H, W) from :func:`guidance_map`, of the size given by :meth:`output_size`.
            depth: (B, 1, h, w) normalised disparity minus its mean, see :func:`normalise`.

        Returns:
            (B, 1, H, W) residual, in units of the disparity's range.

        """
        if guidance.shape[-2:] != self.output_size(depth):
            raise ValueError(
                f"guidance: expected {tuple(self.output_size(depth))} for depth of {tuple(depth.shape[-2:])} at scale "
                f"{self.scale} ({self.variant.name}), got {tuple(guidance.shape[-2:])}"
            )
        x = self.stem(depth)
        for level, guide in zip(self.levels, reversed(self._pyramid(guidance)), strict=True):
            x = level(x, guide)  # (B, 32, 2 h, 2 w), (B, 32, 4 h, 4 w), ...
        return self.reconstruct(self.smooth(x))

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"scale": self.scale, "variant": self.variant.name}

    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        """Return high-resolution disparity; see :func:`upsample_disparity`."""
        return upsample_disparity(self, rgb, disparity, min_max)

    @property
    def receptive_field_radius(self) -> int:
        """Receptive-field radius in low-resolution pixels; two of them are for the uneven padding of ``hui``."""
        return self.rows_seen(0) + 2

    def global_context(self, rgb: Tensor, disparity: Tensor) -> GlobalContext:
        """Return a context with the ranges, the drift and the inpainted disparity of the whole image."""
        min_max = compute_min_max(disparity)
        traits = compute_traits(self, rgb, disparity)
        disparity = inpaint(disparity) if self.variant.fill_holes else disparity
        return GlobalContext(disparity, lambda rgb, window: upsample_disparity(self, rgb, window, min_max, traits))

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

    def _pyramid(self, guidance: Tensor) -> list[Tensor]:
        """Return the guidance features, full resolution first: (B, 32, H, W), (B, 32, H / 2, W / 2), ..."""
        pyramid = [self.guidance[1](self.guidance[0](guidance))]
        for layer in self.guidance[2:]:
            pyramid.append(self.pool(layer(pyramid[-1])))
        return pyramid

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

    def _slopes(self, channels: int) -> int:
        return 1 if self.variant.shared_slopes else channels

    def _conv(self, before: int, after: int, *, kernel: int = 5, active: bool = True) -> ConvLayer:
        conv = nn.Conv2d(before, after, kernel, padding=kernel // 2)
        return ConvLayer(conv, self._slopes(after) if active else 0)

    def _up(self, *, first: bool) -> ConvLayer:
        padding = 2 if first or self.variant.same_size else 1
        extra = 1 if self.variant.same_size else 0
        before = 2 * FEATURES if first else FEATURES
        conv = nn.ConvTranspose2d(before, FEATURES, 5, stride=2, padding=padding, output_padding=extra)
        return ConvLayer(conv, self._slopes(FEATURES))


def compute_traits(net: MSGNet, rgb: Tensor, disparity: Tensor) -> Traits:
    """Compute the traits of an image; see :func:`upsample_disparity`."""
    variant = net.variant
    intensity = detail = drift = None
    if not variant.plain_guidance:
        grey = intensity_of(rgb, variant)
        intensity, grey = compute_min_max(grey), normalise(grey).values
        detail = compute_min_max(grey - mean3x3(grey))
    if variant.drift_compensation:
        drift = output_drift(net, guidance_map(rgb, variant), normalise(disparity).values)
    return Traits(intensity, detail, drift)


def output_drift(net: MSGNet, guidance: Tensor, disparity: Tensor, *, crop: bool = True) -> Tensor:
    """Return the constant offset of the network's output, (B, 1, 1, 1).

    The first quarter of rows and columns of the normalised disparity is set to 0.5. The network's output is averaged
    over rows h // 16 .. h // 4 - h // 16 and the corresponding columns, where h, w is the low-resolution size and the
    indices count high-resolution pixels, as in the released code. The offset is 0 where that region is empty.

    Args:
        net: the network, of the ``voynov`` variant.
        guidance: (B, 1, H, W) from :func:`guidance_map`.
        disparity: (B, 1, h, w) from :func:`normalise`.
        crop: whether to run the network only on the inputs that those pixels depend on: the same value in less time.

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
    output = residual(net, guidance, probe[..., :height, :width])
    return output[..., rows, columns].mean((-2, -1), keepdim=True)


def residual(net: MSGNet, guidance: Tensor, depth: Tensor) -> Tensor:
    """Run the network in the precision of its weights; the output has the dtype of ``depth``, at least float32."""
    dtype = net.stem.conv.weight.dtype
    output = net(guidance.to(dtype), (net.variant.depth_gain * depth).to(dtype))
    return net.variant.residual_gain * output.to(torch.promote_types(depth.dtype, torch.float32))


def upsample_disparity(
    net: MSGNet,
    rgb: Tensor,
    disparity: Tensor,
    min_max: Tensor | None = None,
    traits: Traits | None = None,
    *,
    crop_drift: bool = True,
) -> Tensor:
    """Upsample disparity with a photo's guidance.

    Args:
        rgb: (B, 3, H, W) in 0..1, with H = scale * h and W = scale * w.
        disparity: (B, 1, h, w); non-finite values are holes.
        min_max: see :meth:`dsr.methods.networks.network.DisparityNetwork.upsample`.
        traits: traits of the image that this is a window of; None for those of ``rgb`` and ``disparity``.
        crop_drift: see :func:`output_drift`.

    Returns:
        (B, 1, H, W) in the unit of the input, (B, 1, H - 1, W - 1) for the ``hui`` variant. It can be negative, and
        is NaN for a sample without a finite value.

    """
    values, minimum, value_range = normalise(disparity, min_max)
    if net.variant.fill_holes:
        values = inpaint(torch.where(disparity.isfinite(), values, torch.nan))
    low_pass = mean3x3(values)
    height, width = net.output_size(values)
    guidance = guidance_map(rgb, net.variant, traits)[..., :height, :width]
    output = residual(net, guidance, values - low_pass)
    if traits is not None and traits.drift is not None:
        output = output - traits.drift
    elif net.variant.drift_compensation:
        output = output - output_drift(net, guidance, values, crop=crop_drift)
    output = output + upsample_bicubic(low_pass, net.scale)[..., :height, :width]
    return output * value_range + minimum
