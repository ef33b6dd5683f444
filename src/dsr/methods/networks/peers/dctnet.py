"""DCTNet: features of the depth get those edges of the photo's features that an attention map selects.

Zhao, Zhang, Xu, Lin, Pfister, *Discrete Cosine Transform Network for Guided Depth Map Super-Resolution*, CVPR 2022. For
each feature channel, with depth d, photo r and attention w, the network minimises |x - d|^2 + lambda |L x - w L r|^2.
The normal equations (1 + lambda L^2) x = d + lambda L (w L r) are diagonal in the cosine basis.

As in the authors' code, the right-hand side has a Laplacian of 3 x 3 weights divided by 16, at a mirrored border, and
the left-hand side the eigenvalues of the Laplacian of four neighbours. Layers have the names of the authors' files.
"""

import itertools
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.images import dct2, idct2, laplacian_eigenvalues, normalise_imagenet
from dsr.methods.networks.peers import PeerNetwork

FEATURES = 64
_LAYERS = 4
_CHUNK = 2**20  # values that the transforms process at once, so that they stay in the processor's cache


class EdgeAttention(nn.Module):
    """Weights in 0..1 of the photo's edges, from the photo's features and from a coarse map of them."""

    def __init__(self) -> None:
        super().__init__()
        inner = FEATURES // 4
        self.conv1 = nn.Conv2d(FEATURES, inner, 1)
        self.conv_f = nn.Conv2d(inner, inner, 1)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride=2)
        self.conv_max = nn.Conv2d(inner, inner, 3, padding=1)
        self.conv3 = nn.Conv2d(inner, inner, 3, padding=1)
        self.conv3_ = nn.Conv2d(inner, inner, 3, padding=1)
        self.conv4 = nn.Conv2d(inner, FEATURES, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, 64, H, W) to (B, 64, H, W)."""
        x = self.conv1(x)
        coarse = self.conv2(x)
        # a sixth of the size; the authors' code has no answer to images of less than 15 pixels
        coarse = functional.max_pool2d(coarse, [min(7, size) for size in coarse.shape[-2:]], stride=3)
        coarse = self.conv3_(self.conv3(self.conv_max(coarse).relu()).relu())
        coarse = functional.interpolate(coarse, x.shape[-2:], mode="bilinear", align_corners=False)
        return self.conv4(coarse + self.conv_f(x)).sigmoid()


class CoupledLayer(nn.Module):
    """A residual block of two convolutions of the depth's features and of the photo's, which share half the kernels."""

    def __init__(self) -> None:
        super().__init__()
        for number in (1, 2):
            for kind in ("shared", "depth", "rgb"):
                conv = nn.Conv2d(FEATURES, FEATURES // 2, 3)
                self.register_parameter(f"kernel_{kind}_{number}", conv.get_parameter("weight"))
                self.register_parameter(f"bias_{kind}_{number}", conv.get_parameter("bias"))

    def forward(self, depth: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """Map two tensors of (B, 64, H, W) to two of the same shape."""
        depth = self._conv(self._conv(depth, "depth", 1).relu_(), "depth", 2).add_(depth).relu_()
        return depth, self._conv(self._conv(rgb, "rgb", 1).relu_(), "rgb", 2).add_(rgb).relu_()

    def _conv(self, x: Tensor, kind: str, number: int) -> Tensor:
        weight, bias = (
            torch.cat([self.get_parameter(f"{part}_{each}_{number}") for each in ("shared", kind)])
            for part in ("kernel", "bias")
        )
        return functional.conv2d(x, weight.contiguous(memory_format=torch.channels_last), bias, padding=1)


class DCTNet(PeerNetwork):
    """DCTNet with 64 features and 4 layers, 0.48 million parameters; it sees the whole image, so there are no tiles."""

    title = "DCTNet"
    checksums = MappingProxyType(
        {"383745e7223d0b2c": 4, "2526a628d307b79c": 8, "b9a75d3c1404c01d": 16, "87dee6a437887894": 8 / 3}
    )
    cost = Cost(memory=1600, seconds=8)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.lambd = nn.Parameter(torch.zeros(1, FEATURES, 1, 1))
        self.WPNet = EdgeAttention()
        self.Encoder_coupled = nn.ModuleDict(
            {
                "init_deep": nn.Sequential(nn.Conv2d(1, FEATURES, 3, padding=1)),
                "init_rgb": nn.Sequential(nn.Conv2d(3, FEATURES, 3, padding=1)),
                "coupled_feat_extractor": nn.ModuleList(CoupledLayer() for _ in range(_LAYERS)),
            }
        )
        decoder = nn.Sequential()
        for before, after in itertools.pairwise((FEATURES, FEATURES // 2, FEATURES // 4, 1)):
            decoder.extend([nn.Conv2d(before, after, 3, padding=1), nn.ReLU(inplace=True)])
        self.Decoder_depth = nn.ModuleDict({"Decoder_Deep": decoder})

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Drop the one layer that the authors do not use."""
        return {name: value for name, value in tensors.items() if not name.startswith("WPNet.conv_dilation.")}

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        encoder = self.Encoder_coupled
        depth = encoder["init_deep"](values).relu_()
        guide = encoder["init_rgb"](normalise_imagenet(rgb)).relu_()
        for layer in encoder["coupled_feat_extractor"].children():
            depth, guide = layer(depth, guide)
        return self.Decoder_depth["Decoder_Deep"](transfer_edges(depth, guide, self.WPNet(guide), self.lambd.exp()))


def transfer_edges(depth: Tensor, guide: Tensor, weight: Tensor, strength: Tensor) -> Tensor:
    """Return x with (1 + strength L^2) x = depth + strength L (weight L guide), (B, C, H, W), L the Laplacian."""
    dtype = torch.promote_types(strength.dtype, torch.float32)
    height, width = depth.shape[-2:]
    eigenvalues = laplacian_eigenvalues(height, width, strength).square()
    parts = [each.split(max(1, _CHUNK // (height * width)), dim=1) for each in (depth, guide, weight, strength)]
    solved = []
    for part in zip(*parts, strict=True):
        d, r, w, factor = (each.to(dtype).contiguous() for each in part)
        right = laplacian(laplacian(r) * (w * factor)) + d
        solved.append(idct2(dct2(right) / (factor * eigenvalues + 1)))
    return torch.cat(solved, dim=1)


def laplacian(x: Tensor) -> Tensor:
    """Return the sum of the 3 x 3 neighbours of each pixel minus 9 times the pixel, divided by 16; mirrored border."""
    padded = functional.pad(x, (1, 1, 1, 1), mode="reflect")
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    return (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:] - 9 * x) / 16
