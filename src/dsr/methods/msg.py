"""Depth super-resolution with a trained MSG-Net: ``msg`` (Hui et al. 2016) and ``msg_v`` (Voynov et al. 2019)."""

from __future__ import annotations

import copy
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import RangeType, from_range, to_range
from dsr.methods.msg_net import MSGNet, VariantName, upsample_disparity
from dsr.methods.weights import load_msg_weights
from dsr.sample import DepthSample

Precision = Literal["float32", "bfloat16"]
DTYPES = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})


class MSG:
    """An :class:`~dsr.methods.base.Upsampler` around a trained network.

    Args:
        net: the network; a copy is taken.
        precision: of the convolutions; everything around them stays in the depth's dtype.
        device: where to compute.

    """

    range_type: RangeType = "disparity"

    def __init__(self, net: MSGNet, precision: Precision = "float32", device: torch.device | str = "cpu") -> None:
        if precision not in DTYPES:
            raise ValueError(f"precision: expected one of {', '.join(DTYPES)}, got {precision!r}")
        self.device = torch.device(device)
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device, DTYPES[precision])
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it

    @torch.inference_mode()
    def __call__(self, sample: DepthSample) -> Tensor:
        """Return the fine orthogonal depth, (1, H, W) in metres on the sample's device.

        NaN where the network's disparity lies at or beyond infinity; for the ``hui`` variant also in the last row and
        column, which it does not cover.
        """
        if sample.scale != self.net.scale:
            raise ValueError(f"{sample.scene}: expected scale {self.net.scale}, the network's, got {sample.scale}")
        coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity") * sample.scale  # in pixels of sample.camera
        rgb, coarse = sample.rgb.to(self.device)[None], coarse.to(self.device)[None]
        fine = upsample_disparity(self.net, rgb, coarse)[0]
        missing = (sample.camera.width - fine.shape[-1], sample.camera.height - fine.shape[-2])
        fine = functional.pad(fine, (0, missing[0], 0, missing[1]), value=torch.nan)
        return from_range(fine, sample.camera, "disparity").to(sample.depth_lr.device)


def build_msg(
    weights: Path,
    scale: int,
    variant: VariantName,
    precision: Precision = "float32",
    device: torch.device | str = "cpu",
    trained_as: str | None = None,
) -> MSG:
    """Return the method with the weights of a file; see :func:`~dsr.methods.weights.load_msg_weights`."""
    return MSG(load_msg_weights(weights, scale, variant, trained_as), precision, device)
