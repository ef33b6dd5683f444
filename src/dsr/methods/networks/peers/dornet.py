"""DORNet, its tiny variant: an unknown degradation is described by features, which steer how the photo is used.

Wang, Yan, Pan, Gao, Zhang, Yang, *DORNet: A Degradation Oriented and Regularized Network for Blind Depth
Super-Resolution*, CVPR 2025. An encoder describes the degradation of the enlarged map by features of each pixel and by
one vector of the image. They steer deformable convolutions of the photo's features, which are then added to the
depth's. The branch that learns the degradation by simulating it is needed for training only and left out.

Modulated deformable convolution: Zhu, Hu, Lin, Dai, *Deformable ConvNets v2: More Deformable, Better Results*, CVPR
2019. Each tap of a 3 x 3 kernel reads the features at its own position plus an offset, which differs from pixel to
pixel, and the value is multiplied by a mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.networks.peers.peer_network import PeerNetwork, fold_batch_norm, rename

_CHUNK = 2**20  # values that are read at once, so that they stay in the processor's cache

FEATURES = 24
_INNER = 6  # features in the bottlenecks
_STAGES = 5
_SENSOR_RATIO = 8 / 3  # of RGB-D-D's photos to the maps of its phone
_UNUSED = "Dab."
_BLOCK = (("backbone", 0), ("backbone", 3), ("shortcut", 0))
_NORMALISED = {
    "Enc.E.0": "Enc.E.1",
    "Enc.E.3": "Enc.E.4",
    **{f"Enc.E_pre.{i}.{conv}.{j}": f"Enc.E_pre.{i}.{conv}.{j + 1}" for i in range(3) for conv, j in _BLOCK},
}
"""Convolutions of the authors' files, and the batch normalisations that follow them."""
_RENAMED = {
    r"^R\.head\.0\.": "depth_head.",
    r"^R\.head_rgb\.0\.": "rgb_head.",
    r"^R\.tail\.0\.": "tail.",
    r"^R\.c_d5\.0\.": "merge.",
    r"^R\.c_d5\.1\.": "R.c_d5.",
    r"^R\.c_r([1-4])\.": r"rgb_convs.\1.",
    r"^R\.dgm([1-5])\.": r"transfers.\1.",
    r"^R\.c_d([1-5])\.body\.2\.": r"refinements.\1.conv.",
    r"^R\.c_d([1-5])\.body\.([01])\.": r"refinements.\1.blocks.\2.",
    r"\.DA_rgb\.dcnrgb\.conv_offset_mask\.": ".offsets.",
    r"\.DA_rgb\.dcnrgb\.c1\.": ".scale.",
    r"\.DA_rgb\.dcnrgb\.c2\.": ".mix.",
    r"\.DA_rgb\.dcnrgb\.": ".deformable.",
    r"\.DA_rgb\.rcab1\.": ".block.",
    r"\.DA_rgb\.conv\.": ".conv.",
    r"\.fb\.conv([123])\.": r".fusion\1.",
    r"\.fb\.conv\.": ".fuse.",
    r"\.body\.0\.": ".conv1.",
    r"\.body\.2\.": ".conv2.",
    r"\.body\.3\.conv_du\.0\.": ".squeeze.",
    r"\.body\.3\.conv_du\.2\.": ".excite.",
    r"^Enc\.E_pre\.": "encoder.blocks.",
    r"^Enc\.E\.0\.": "encoder.down1.",
    r"^Enc\.E\.3\.": "encoder.down2.",
    r"\.backbone\.0\.": ".conv1.",
    r"\.backbone\.3\.": ".conv2.",
    r"\.shortcut\.0\.": ".shortcut.",
}
"""Regular expressions of the authors' names, and their replacements here."""


def deformable_conv3x3(x: Tensor, offsets: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """Convolve features with 3 x 3 kernels whose taps are displaced; features outside the image are 0.

    Features ``x`` (B, C, H, W) become (B, D, H, W). ``offsets`` (B, 18, H, W) are in pixels, (dy, dx) for each tap, row
    by row, ``mask`` (B, 9, H, W) factors of the taps, ``weight`` (B, D, C, 3, 3) the kernels of each image.
    """
    batch, channels, height, width = x.shape
    kernels = weight.flatten(2)  # (B, D, C * 9)
    features = x.contiguous()
    count = max(1, _CHUNK // (batch * channels * 9 * width))
    results = []
    for top in range(0, height, count):
        rows = slice(top, min(top + count, height))
        grid = _sampling_grid(offsets[:, :, rows], top, height)  # (B, 9 * rows, W, 2)
        values = functional.grid_sample(features, grid, align_corners=False).view(batch, channels, 9, -1, width)
        values = values * mask[:, None, :, rows]
        result = (kernels @ values.flatten(3).flatten(1, 2)).unflatten(2, (-1, width))  # (B, D, rows, W)
        results.append(result.contiguous(memory_format=torch.channels_last))
    return torch.cat(results, dim=2)


def _sampling_grid(offsets: Tensor, top: int, height: int) -> Tensor:
    """Return the positions that the taps of some rows read, as ``grid_sample`` expects them."""
    rows, width = offsets.shape[-2:]
    taps = torch.arange(-1, 2, device=offsets.device)
    y = torch.arange(top, top + rows, device=offsets.device)[:, None] + taps.repeat_interleave(3)[:, None, None]
    x = torch.arange(width, device=offsets.device) + taps.repeat(3)[:, None, None]
    y = (offsets[:, ::2] + y) * (2 / height) + (1 / height - 1)  # (B, 9, rows, W)
    x = (offsets[:, 1::2] + x) * (2 / width) + (1 / width - 1)
    return torch.stack((x, y), dim=-1).flatten(1, 2)


class ChannelAttention(nn.Module):
    """A residual block whose features are weighted by factors of the whole image (Zhang et al., *RCAN*, ECCV 2018)."""

    def __init__(self, slope: float) -> None:
        super().__init__()
        self.slope = slope
        self.conv1, self.conv2 = _conv(FEATURES, FEATURES), _conv(FEATURES, FEATURES)
        self.squeeze, self.excite = nn.Conv2d(FEATURES, _INNER, 1), nn.Conv2d(_INNER, FEATURES, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, 24, H, W) to the same shape."""
        y = self.conv2(functional.leaky_relu_(self.conv1(x), self.slope))
        factors = self.excite(self.squeeze(y.mean(dim=(-2, -1), keepdim=True)).relu()).sigmoid()
        return torch.addcmul(x, y, factors)


class ResidualGroup(nn.Module):
    """Two blocks with channel attention, a convolution, and a connection around all."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = nn.Sequential(ChannelAttention(0.2), ChannelAttention(0.2))
        self.conv = _conv(FEATURES, FEATURES)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, 24, H, W) to the same shape."""
        return self.conv(self.blocks(x)).add_(x)


class EncoderBlock(nn.Module):
    """A residual block; batch normalisation is part of the convolutions."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = _conv(inputs, outputs), _conv(outputs, outputs)
        self.shortcut = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H, W)."""
        y = self.conv2(functional.leaky_relu_(self.conv1(x), 0.1))
        return functional.leaky_relu_(y.add_(self.shortcut(x)), 0.1)


class DegradationEncoder(nn.Module):
    """Features that describe how the enlarged map was degraded."""

    def __init__(self) -> None:
        super().__init__()
        sizes = ((1, FEATURES // 2), (FEATURES // 2, FEATURES), (FEATURES, FEATURES))
        self.blocks = nn.Sequential(*(EncoderBlock(*size) for size in sizes))
        self.down1 = nn.Conv2d(FEATURES, 2 * FEATURES, 3, stride=2, padding=1)
        self.down2 = nn.Conv2d(2 * FEATURES, 4 * FEATURES, 3, stride=2, padding=1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, 1, H, W) to the features of each pixel, (B, 24, H, W), and of the image, (B, 96, 1, 1)."""
        local = self.blocks(x)
        coarse = self.down2(functional.leaky_relu_(self.down1(local), 0.1))
        return local, coarse.mean(dim=(-2, -1), keepdim=True)


class Transfer(nn.Module):
    """The step that aligns the photo's features by the degradation and adds them to the depth's."""

    def __init__(self) -> None:
        super().__init__()
        self.block = ChannelAttention(0)
        self.deformable = _conv(FEATURES, FEATURES, bias=False)
        self.offsets = _conv(FEATURES, 27)
        self.scale = nn.Conv2d(4 * FEATURES, FEATURES, 1, bias=False)
        self.mix = nn.Conv2d(FEATURES, FEATURES, 1, bias=False)
        self.conv = _conv(FEATURES, FEATURES)
        self.fusion1, self.fusion2 = nn.Conv2d(FEATURES, _INNER, 1), nn.Conv2d(FEATURES, _INNER, 1)
        self.fusion3 = nn.Conv2d(_INNER, FEATURES, 1)
        self.fuse = _conv(2 * FEATURES, FEATURES)

    def forward(self, depth: Tensor, rgb: Tensor, local: Tensor, vector: Tensor) -> Tensor:
        """Return the depth's features, (B, 24, H, W), of those of photo and degradation; ``vector`` (B, 96, 1, 1)."""
        rgb = self.block(rgb)
        steering = self.offsets(local)
        scale = self.scale(vector)[:, None]  # (B, 1, 24, 1, 1): a factor of each input feature
        # the 1 x 1 convolution after the deformable one is part of the kernels
        mixed = torch.einsum("ed,dcij->ecij", self.mix.weight[..., 0, 0], self.deformable.weight)
        aligned = deformable_conv3x3(rgb, steering[:, :18], steering[:, 18:].sigmoid(), mixed * scale)
        rgb = self.conv(aligned + rgb)
        gate = self.fusion1(local).sigmoid_()
        rgb = rgb + self.fusion3(self.fusion2(rgb) * gate)
        return self.fuse(torch.cat((rgb, depth), dim=1)).add_(depth)


class DORNet(PeerNetwork):
    """The tiny DORNet: 24 features; 0.46 million parameters in a file, of which inference needs 0.43.

    Averages over the whole image steer it, so there are no tiles: large images need about 2 kB of memory per pixel.
    """

    title: ClassVar[str] = "DORNet-T"
    checksums: ClassVar[Mapping[str, float]] = MappingProxyType(
        {"f91a4b6387036348": 4, "6cbd299ec3a589c2": 8, "38bd20f150d138e3": _SENSOR_RATIO}
    )
    cost: ClassVar[Cost] = Cost(memory=2000, seconds=10)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.depth_range = (0.0, 5.0) if scale == _SENSOR_RATIO else None  # of weights trained on RGB-D-D's phone
        self.encoder = DegradationEncoder()
        self.depth_head, self.rgb_head = _conv(1, FEATURES), _conv(3, FEATURES)
        self.rgb_convs = nn.ModuleDict({str(i + 1): _conv(FEATURES, FEATURES) for i in range(_STAGES - 1)})
        self.transfers = nn.ModuleDict({str(i + 1): Transfer() for i in range(_STAGES)})
        self.refinements = nn.ModuleDict({str(i + 1): ResidualGroup() for i in range(_STAGES)})
        self.merge = nn.Conv2d(_STAGES * FEATURES, FEATURES, 1)
        self.tail = _conv(FEATURES, 1)

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the parameters by their names here, without those that training alone needs."""
        tensors = {name: value for name, value in tensors.items() if not name.startswith(_UNUSED)}
        for conv, norm in _NORMALISED.items():
            weight = tensors.get(f"{conv}.weight")
            if weight is not None and conv.startswith("Enc.E_pre."):  # these have no bias of their own
                tensors.setdefault(f"{conv}.bias", weight.new_zeros(weight.shape[:1]))
            fold_batch_norm(tensors, conv, norm)
        return rename(tensors, _RENAMED)

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        local, vector = self.encoder(values)
        head = depth = self.depth_head(values)
        guide = self.rgb_head(rgb)
        stages = []
        for stage, transfer in self.transfers.items():
            depth = transfer(depth, guide, local, vector)
            if stage in self.rgb_convs:
                # the last of the photo's features and the first of the depth's stay as they are
                depth = self.refinements[stage](depth if stage == "1" else functional.leaky_relu_(depth, 0.1))
                guide = self.rgb_convs[stage](guide)
                guide = guide if stage == str(_STAGES - 1) else functional.leaky_relu_(guide, 0.1)
            stages.append(depth)
        merged = self.refinements[str(_STAGES)](self.merge(torch.cat(stages, dim=1)))
        return self.tail(merged.add_(head))


def _conv(inputs: int, outputs: int, bias: bool = True) -> nn.Conv2d:
    """Make a 3 x 3 convolution that keeps the size."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=bias)
