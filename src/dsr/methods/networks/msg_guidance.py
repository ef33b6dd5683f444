"""The variants of MSG-Net, :mod:`dsr.methods.networks.msg_net`, and their guidance maps."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dsr.methods.classical.finite_differences import LUMA
from dsr.methods.networks.maps import mean3x3, normalise

VariantName = Literal["hui", "voynov", "dsr"]


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
