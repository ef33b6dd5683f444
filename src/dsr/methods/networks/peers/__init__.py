"""Networks that others published for guided depth super-resolution: their base, and how their weights are read."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from dsr.methods.base import Cost
from dsr.methods.images import LUMA, resize_bicubic
from dsr.methods.networks.weight_files import load_parameters
from dsr.utils import arrays

SWAPPED_LUMA = LUMA[::-1]  # weights of red, green and blue, as some authors' code applies the luma's to RGB
_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")


def load_peer(path: Path, network: type[PeerNetwork], scale: float) -> PeerNetwork:
    """Load a network, whose weights were trained for a factor, of its authors' file, in float32 on the CPU."""
    tensors = network.convert(read_tensors(path))
    with torch.device("meta"):  # without memory and random numbers
        net = network(scale)
    load_parameters(net, tensors, path, network.title)
    return net


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of an authors' file by name, without the prefix of networks trained on several GPUs."""
    return {name.removeprefix("module."): value for name, value in arrays.read_tensors(path).items()}


def fold_batch_norm(tensors: dict[str, Tensor], conv: str, norm: str, eps: float = 1e-5) -> None:
    """Merge a batch normalisation into the convolution with a bias before it, in place, if all tensors fit."""
    names = [f"{conv}.weight", f"{conv}.bias", *(f"{norm}.{part}" for part in _NORM_PARTS)]
    if any(name not in tensors for name in names):
        return
    weight, bias, *parts = (tensors[name] for name in names)
    if weight.dim() != 4 or any(part.shape != weight.shape[:1] for part in (bias, *parts)):
        return
    gain, shift, mean, variance = (part.double() for part in parts)
    factor = gain / (variance + eps).sqrt()
    tensors[f"{conv}.weight"] = (weight * factor[:, None, None, None]).float()
    tensors[f"{conv}.bias"] = ((bias - mean) * factor + shift).float()
    for part in (*_NORM_PARTS, "num_batches_tracked"):
        tensors.pop(f"{norm}.{part}", None)


class PeerNetwork(nn.Module, abc.ABC):
    """A published network that refines an enlarged depth map, guided by a photo; ``scale`` is that of its weights."""

    title: ClassVar[str]  # in messages
    checksums: ClassVar[Mapping[str, float]]  # factors of its authors' files by the first 16 digits of their SHA-256
    multiple: ClassVar[int] = 1  # divides the sizes of its images
    receptive_field_radius: ClassVar[int | None] = None  # in pixels of the photo; None if it needs the whole image
    depth_range: tuple[float, float] | None = None  # in metres, that became 0..1 in the training; None: each map's own
    cost: ClassVar[Cost]

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map without holes, (B, 1, h, w), to (B, 1, *size) as the authors do: by Pillow's bicubic filter."""
        return resize_bicubic(values_lr, size)

    @abc.abstractmethod
    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map, (B, 1, H, W), of which 0..1 is the range, with a photo (B, 3, H, W) in 0..1."""

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the parameters by their names here; unknown names are kept, to recognise another network's file."""
        return tensors


def conv3x3(before: int, after: int, bias: bool = True) -> nn.Conv2d:
    """Make a 3 x 3 convolution that keeps the size."""
    return nn.Conv2d(before, after, 3, padding=1, bias=bias)


class ChannelAttention(nn.Module):
    """A residual block whose features are weighted by factors of the whole image (Zhang et al., *RCAN*, ECCV 2018)."""

    def __init__(self, width: int, inner: int, slope: float) -> None:
        super().__init__()
        factors = nn.Sequential(nn.Conv2d(width, inner, 1), nn.ReLU(), nn.Conv2d(inner, width, 1), nn.Sigmoid())
        self.body = nn.Sequential(
            conv3x3(width, width),
            nn.LeakyReLU(slope, inplace=True),
            conv3x3(width, width),
            nn.ModuleDict({"conv_du": factors}),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        y = self.body[:3](x)
        factors = self.body.get_submodule("3.conv_du")(y.mean(dim=(-2, -1), keepdim=True))
        return torch.addcmul(x, y, factors)


class ResidualGroup(nn.Module):
    """Two blocks with channel attention, a convolution, and a connection around all."""

    def __init__(self, width: int, inner: int, slope: float, bias: bool = True) -> None:
        super().__init__()
        blocks = [ChannelAttention(width, inner, slope) for _ in range(2)]
        self.body = nn.Sequential(*blocks, conv3x3(width, width, bias))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return self.body(x).add_(x)
