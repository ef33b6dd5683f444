"""DORNet, its tiny variant: an unknown degradation is described by features, which steer how the photo is used.

Wang, Yan, Pan, Gao, Zhang, Yang, *DORNet: A Degradation Oriented and Regularized Network for Blind Depth
Super-Resolution*, CVPR 2025. An encoder describes the degradation of the enlarged map by features of each pixel and by
one vector of the image. They steer deformable convolutions (Zhu, Hu, Lin, Dai, *Deformable ConvNets v2*, CVPR 2019) of
the photo's features, which are then added to the depth's. The branch that learns the degradation by simulating it is
needed for training only and left out. Layers have the names of the authors' files.
"""

from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.networks.peers import (
    ChannelAttention,
    PeerNetwork,
    ResidualGroup,
    conv3x3,
    fold_batch_norm,
)

_CHUNK = 2**20  # values that are read at once, so that they stay in the processor's cache

FEATURES = 24
_INNER = 6  # features in the bottlenecks
_SENSOR_RATIO = 8 / 3  # of RGB-D-D's photos to the maps of its phone


def deformable_conv3x3(x: Tensor, offsets: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """Convolve features with 3 x 3 kernels whose taps are displaced; features outside the image are 0.

    Features ``x`` (B, C, H, W) become (B, D, H, W). ``offsets`` (B, 18, H, W) are in pixels, (dy, dx) for each tap, row
    by row, ``mask`` (B, 9, H, W) factors of the taps, ``weight`` (B, D, C, 3, 3) the kernels of each image.
    """
    batch, channels, height, width = x.shape
    kernels = weight.flatten(2)  # (B, D, C * 9)
    features = x.contiguous()
    count = max(1, _CHUNK // (batch * channels * 9 * width))
    taps = torch.arange(-1, 2, device=x.device)
    down, across = taps.repeat_interleave(3)[:, None, None], taps.repeat(3)[:, None, None]
    results = []
    for top in range(0, height, count):
        rows = slice(top, min(top + count, height))
        v = offsets[:, ::2, rows] + (torch.arange(rows.start, rows.stop, device=x.device)[:, None] + down)
        u = offsets[:, 1::2, rows] + (torch.arange(width, device=x.device) + across)  # (B, 9, rows, W)
        places = u * (2 / width) + (1 / width - 1), v * (2 / height) + (1 / height - 1)
        grid = torch.stack(places, dim=-1).flatten(1, 2)  # (B, 9 * rows, W, 2)
        values = functional.grid_sample(features, grid, align_corners=False).view(batch, channels, 9, -1, width)
        values = values * mask[:, None, :, rows]
        result = (kernels @ values.flatten(3).flatten(1, 2)).unflatten(2, (-1, width))  # (B, D, rows, W)
        results.append(result.contiguous(memory_format=torch.channels_last))
    return torch.cat(results, dim=2)


class EncoderBlock(nn.Module):
    """A residual block; batch normalisation is part of the convolutions."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(
            conv3x3(before, after), nn.Identity(), nn.LeakyReLU(0.1, inplace=True), conv3x3(after, after)
        )
        self.shortcut = nn.Sequential(nn.Conv2d(before, after, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, before, H, W) to (B, after, H, W)."""
        return functional.leaky_relu_(self.backbone(x).add_(self.shortcut(x)), 0.1)


class DegradationEncoder(nn.Module):
    """Features that describe how the enlarged map was degraded."""

    def __init__(self) -> None:
        super().__init__()
        self.E_pre = nn.Sequential(
            EncoderBlock(1, FEATURES // 2), EncoderBlock(FEATURES // 2, FEATURES), EncoderBlock(FEATURES, FEATURES)
        )
        self.E = nn.Sequential(
            nn.Conv2d(FEATURES, 2 * FEATURES, 3, stride=2, padding=1),
            nn.Identity(),  # batch normalisation, which is part of the convolution
            nn.LeakyReLU(0.1, inplace=True),
            nn.Conv2d(2 * FEATURES, 4 * FEATURES, 3, stride=2, padding=1),
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, 1, H, W) to the features of each pixel, (B, 24, H, W), and of the image, (B, 96, 1, 1)."""
        local = self.E_pre(x)
        return local, self.E(local).mean(dim=(-2, -1), keepdim=True)


class DeformableConv(nn.Module):
    """A deformable and a 1 x 1 convolution, steered by the features of the degradation."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = conv3x3(FEATURES, FEATURES).weight
        self.conv_offset_mask = conv3x3(FEATURES, 27)
        self.c1 = nn.Conv2d(4 * FEATURES, FEATURES, 1, bias=False)
        self.c2 = nn.Conv2d(FEATURES, FEATURES, 1, bias=False)

    def forward(self, x: Tensor, local: Tensor, vector: Tensor) -> Tensor:
        """Map (B, 24, H, W) to the same shape; ``local`` is (B, 24, H, W), ``vector`` (B, 96, 1, 1)."""
        steering = self.conv_offset_mask(local)
        scale = self.c1(vector)[:, None]  # (B, 1, 24, 1, 1): a factor of each input feature
        # the 1 x 1 convolution after the deformable one is part of the kernels
        mixed = torch.einsum("ed,dcij->ecij", self.c2.weight[..., 0, 0], self.weight)
        return deformable_conv3x3(x, steering[:, :18], steering[:, 18:].sigmoid(), mixed * scale)


class Transfer(nn.Module):
    """The step that aligns the photo's features by the degradation and adds them to the depth's."""

    def __init__(self) -> None:
        super().__init__()
        width, inner = FEATURES, _INNER
        align = {"dcnrgb": DeformableConv(), "rcab1": ChannelAttention(width, inner, 0), "conv": conv3x3(width, width)}
        fuse = {"conv1": nn.Conv2d(width, inner, 1), "conv2": nn.Conv2d(width, inner, 1)}
        fuse |= {"conv3": nn.Conv2d(inner, width, 1), "conv": conv3x3(2 * width, width)}
        self.DA_rgb, self.fb = nn.ModuleDict(align), nn.ModuleDict(fuse)

    def forward(self, depth: Tensor, rgb: Tensor, local: Tensor, vector: Tensor) -> Tensor:
        """Return the depth's features, (B, 24, H, W), of those of photo and degradation; ``vector`` (B, 96, 1, 1)."""
        rgb = self.DA_rgb["rcab1"](rgb)
        rgb = self.DA_rgb["conv"](self.DA_rgb["dcnrgb"](rgb, local, vector) + rgb)
        gate = self.fb["conv1"](local).sigmoid_()
        rgb = rgb + self.fb["conv3"](self.fb["conv2"](rgb) * gate)
        return self.fb["conv"](torch.cat((rgb, depth), dim=1)).add_(depth)


class Restoration(nn.Module):
    """The branch that refines the map: five transfers, each but the last followed by a residual group."""

    def __init__(self) -> None:
        super().__init__()
        self.head, self.head_rgb = nn.Sequential(conv3x3(1, FEATURES)), nn.Sequential(conv3x3(3, FEATURES))
        self.dgm1, self.dgm2, self.dgm3, self.dgm4, self.dgm5 = (Transfer() for _ in range(5))
        self.c_d1, self.c_d2, self.c_d3, self.c_d4, last = (ResidualGroup(FEATURES, _INNER, 0.2) for _ in range(5))
        self.c_d5 = nn.Sequential(nn.Conv2d(5 * FEATURES, FEATURES, 1), last)
        self.c_r1, self.c_r2, self.c_r3, self.c_r4 = (conv3x3(FEATURES, FEATURES) for _ in range(4))
        self.tail = nn.Sequential(conv3x3(FEATURES, 1))

    def forward(self, rgb: Tensor, values: Tensor, local: Tensor, vector: Tensor) -> Tensor:
        """Map a photo, an enlarged map and the features of the degradation to a refined map, (B, 1, H, W)."""
        head, guide = self.head(values), self.head_rgb(rgb)
        # the first of the depth's features and the last of the photo's stay as they are
        first = self.c_d1(self.dgm1(head, guide, local, vector))
        guide = functional.leaky_relu_(self.c_r1(guide), 0.1)
        second = self.c_d2(functional.leaky_relu_(self.dgm2(first, guide, local, vector), 0.1))
        guide = functional.leaky_relu_(self.c_r2(guide), 0.1)
        third = self.c_d3(functional.leaky_relu_(self.dgm3(second, guide, local, vector), 0.1))
        guide = functional.leaky_relu_(self.c_r3(guide), 0.1)
        fourth = self.c_d4(functional.leaky_relu_(self.dgm4(third, guide, local, vector), 0.1))
        fifth = self.dgm5(fourth, self.c_r4(guide), local, vector)
        return self.tail(self.c_d5(torch.cat((first, second, third, fourth, fifth), dim=1)).add_(head))


class DORNet(PeerNetwork):
    """The tiny DORNet: 24 features; 0.46 million parameters in a file, of which inference needs 0.43.

    Averages over the whole image steer it, so there are no tiles: large images need about 2 kB of memory per pixel.
    """

    title = "DORNet-T"
    checksums = MappingProxyType({"f91a4b6387036348": 4, "6cbd299ec3a589c2": 8, "38bd20f150d138e3": _SENSOR_RATIO})
    cost = Cost(memory=2000, seconds=10)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.depth_range = (0.0, 5.0) if scale == _SENSOR_RATIO else None  # of weights trained on RGB-D-D's phone
        self.R, self.Enc = Restoration(), DegradationEncoder()

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Merge the batch normalisations into the convolutions, and drop the branch that training alone needs."""
        tensors = {name: value for name, value in tensors.items() if not name.startswith("Dab.")}
        convs = [f"Enc.E_pre.{i}.{part}" for i in range(3) for part in ("backbone.0", "backbone.3", "shortcut.0")]
        for conv in convs:  # these have no bias of their own
            weight = tensors.get(f"{conv}.weight")
            if weight is not None:
                tensors.setdefault(f"{conv}.bias", weight.new_zeros(weight.shape[:1]))
        for conv in ("Enc.E.0", "Enc.E.3", *convs):
            layer, _, index = conv.rpartition(".")
            fold_batch_norm(tensors, conv, f"{layer}.{int(index) + 1}")
        return tensors

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        return self.R(rgb, values, *self.Enc(values))
