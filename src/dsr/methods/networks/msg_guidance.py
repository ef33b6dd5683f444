"""The variants of MSG-Net, :mod:`dsr.methods.networks.msg_net`, and the guidance that each makes of a photo."""

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
    """What tells the published networks and ours, and their inputs, apart.

    Args:
        name: the variant's name.
        shared_slopes: each PReLU has a single slope, else one per channel.
        activate_output: a PReLU follows the reconstruction too.
        same_size: the output has scale * h rows, else scale * h - 1 (Caffe's transposed convolutions, which know no
            output padding), and likewise columns; the guidance has the output's size.
        rgb_weights, rgb_offset: intensity = weights . (R, G, B in 0..255) + offset, clipped to 0..255.
        plain_guidance: the guidance is the intensity, -1..1, whatever the rest of the photo holds, so that a patch and
            the whole photo look alike to the network; else see :func:`guidance_map`.
        depth_gain, residual_gain: factors of the depth that goes in and of the residual that comes out. Small residuals
            of large activations: a step of the optimiser moves smooth surfaces less.
        fill_holes: holes of the low-resolution map are filled from around; else they are the least disparity.
        drift_compensation: the output's mean over a flat probe is taken off the output, see
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
        # The released code takes YCbCr's inverse for its forward transform; the weights were trained on this image.
        "voynov": MSGVariant("voynov", True, True, True, (1.0, -0.34414, -0.71414), 128 * (0.34414 + 0.71414), True),
        # What dsr trains: the graph of voynov, guided by real luma, without a constant to take off afterwards.
        "dsr": MSGVariant("dsr", True, True, True, LUMA, 0.0, False, True, 10.0, 0.05, True),
    }
)


class Traits(NamedTuple):
    """What MSG-Net's answer takes from the whole image, beside the range of its disparity.

    ``intensity`` and ``detail`` (B, 2, 1, 1): bounds of the photo's intensity and of its difference to its 3 x 3 mean,
    None for plain guidance; ``drift`` (B, 1, 1, 1): see :func:`dsr.methods.networks.msg_net.output_drift`, None without
    its compensation.
    """

    intensity: Tensor | None
    detail: Tensor | None
    drift: Tensor | None


def guidance_map(rgb: Tensor, variant: MSGVariant, traits: Traits | None = None) -> Tensor:
    """Return the guidance (B, 1, H, W) of a photo (B, 3, H, W) in 0..1.

    An intensity (see :class:`MSGVariant`), normalised, less its 3 x 3 mean, normalised again, 0..1; or the intensity
    itself, -1..1, where the variant has plain guidance. With traits, the photo is a window of the one that has them.
    """
    intensity = intensity_of(rgb, variant)
    if variant.plain_guidance:
        return intensity / 127.5 - 1
    intensity = normalise(intensity, traits and traits.intensity).values
    return normalise(intensity - mean3x3(intensity), traits and traits.detail).values


def intensity_of(rgb: Tensor, variant: MSGVariant) -> Tensor:
    """Return the photo's intensity, (B, 1, H, W) in 0..255."""
    weights = torch.tensor(variant.rgb_weights, dtype=rgb.dtype, device=rgb.device)[:, None, None]
    return ((255 * rgb * weights).sum(-3, keepdim=True) + variant.rgb_offset).clip(0, 255)
