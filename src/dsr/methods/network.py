"""What the project's networks have in common: they map coarse disparity and a photo to fine disparity."""

from __future__ import annotations

import abc
import copy
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.camera import RangeType, from_range, to_range
from dsr.sample import DepthSample

Precision = Literal["float32", "bfloat16"]
ENSEMBLES = (1, 4, 8)
DTYPES = MappingProxyType({"float32": torch.float32, "bfloat16": torch.bfloat16})


class DisparityNetwork(nn.Module, abc.ABC):
    """A network that upsamples disparity under a photo's guidance.

    Attributes:
        scale: the upsampling factor.
        covers: whether the output has all of the photo's pixels; some published networks leave out a row and a column.

    """

    scale: int
    covers: bool = True

    @abc.abstractmethod
    def arguments(self) -> dict[str, Any]:
        """Return what the constructor was given, as plain values; a file of weights keeps it."""

    @abc.abstractmethod
    def upsample(self, rgb: Tensor, disparity: Tensor, bounds: Tensor | None = None) -> Tensor:
        """Return fine disparity.

        Args:
            rgb: (B, 3, H, W) in [0, 1], H = scale * h and W = scale * w.
            disparity: (B, 1, h, w) in pixels of the photo's camera; non-finite values are holes.
            bounds: (B, 2, 1, 1) lowest and highest coarse disparity of the image that this is a window of, which
                normalise it; None for those of ``disparity`` itself.

        Returns:
            (B, 1, H, W) in the dtype of ``disparity``; NaN for an image without a known pixel.

        """


class NetworkUpsampler:
    """An :class:`~dsr.methods.base.Upsampler` around a trained network.

    Args:
        net: the network; a copy is taken.
        precision: of the convolutions; everything around them stays in the depth's dtype.
        device: where to compute.
        ensemble: 1 for the network's answer; 4 for the mean of its answers to the image in four quarter turns, 8 to
            these and their mirror images, each turned back, in as many times the time: the geometric self-ensemble of
            Timofte, Rothe, Van Gool, *Seven Ways to Improve Example-Based Single Image Super Resolution*, CVPR 2016,
            section 3.6. What is right agrees in all of them, and much of what is wrong doesn't.

    Raises:
        ValueError: there is no such precision or ensemble, or the network leaves out pixels and can't be averaged.

    """

    range_type: RangeType = "disparity"

    def __init__(
        self,
        net: DisparityNetwork,
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
        ensemble: int = 1,
    ) -> None:
        if precision not in DTYPES:
            raise ValueError(f"precision: expected one of {', '.join(DTYPES)}, got {precision!r}")
        if ensemble not in ENSEMBLES:
            raise ValueError(f"ensemble: expected one of {', '.join(map(str, ENSEMBLES))}, got {ensemble!r}")
        if ensemble > 1 and not net.covers:
            raise ValueError(f"ensemble: expected 1 for a network that leaves out pixels, got {ensemble}")
        self.ensemble = ensemble
        self.device = torch.device(device)
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device, DTYPES[precision])
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it

    @torch.inference_mode()
    def __call__(self, sample: DepthSample) -> Tensor:
        """Return the fine orthogonal depth, (1, H, W) in metres on the sample's device.

        NaN where the network's disparity lies at or beyond infinity, and in the last row and column where the network
        does not cover them.
        """
        if sample.scale != self.net.scale:
            raise ValueError(f"{sample.scene}: expected scale {self.net.scale}, the network's, got {sample.scale}")
        coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity") * sample.scale  # in pixels of sample.camera
        fine = self.fine_disparity(sample.rgb.to(self.device)[None], coarse.to(self.device)[None])[0]
        missing = (sample.camera.width - fine.shape[-1], sample.camera.height - fine.shape[-2])
        fine = functional.pad(fine, (0, missing[0], 0, missing[1]), value=torch.nan)
        return from_range(fine, sample.camera, "disparity").to(sample.depth_lr.device)

    def fine_disparity(self, rgb: Tensor, coarse: Tensor) -> Tensor:
        """Return the mean of the ensemble's fine disparities, (B, 1, H, W).

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            coarse: (B, 1, h, w) disparity in pixels of the photo's camera; non-finite values are holes.

        """
        total = self.net.upsample(rgb, coarse)
        for pose in range(1, self.ensemble):
            fine = self.net.upsample(posed(rgb, pose), posed(coarse, pose))
            total += unposed(fine, pose)
        return total / self.ensemble


def posed(x: Tensor, pose: int) -> Tensor:
    """Return (B, C, H, W) after ``pose`` % 4 quarter turns, mirrored first if ``pose`` is 4 or more."""
    return torch.rot90(x.flip(-1) if pose >= 4 else x, pose % 4, (-2, -1)).contiguous()


def unposed(x: Tensor, pose: int) -> Tensor:
    """Undo :func:`posed`."""
    x = torch.rot90(x, -(pose % 4), (-2, -1))
    return x.flip(-1) if pose >= 4 else x
