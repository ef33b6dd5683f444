"""DCTNet: features of the depth get those edges of the photo's features that an attention map selects.

Zhao, Zhang, Xu, Lin, Pfister, *Discrete Cosine Transform Network for Guided Depth Map Super-Resolution*, CVPR 2022. For
each feature channel, with depth d, photo r and attention w, the network minimises |x - d|^2 + lambda |L x - w L r|^2.
The normal equations (1 + lambda L^2) x = d + lambda L (w L r) are diagonal in the cosine basis.

As in the authors' code, the right-hand side has a Laplacian of 3 x 3 weights divided by 16, at a mirrored border, and
the left-hand side the eigenvalues of the Laplacian of four neighbours.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.networks.peers.base import PeerNetwork, upsample_pillow
from dsr.methods.networks.peers.dct import dct2, idct2

FEATURES = 64
_SHARED = 32
_LAYERS = 4
_CHUNK = 2**20
"""Number of values that the transforms process at once, so that they stay in the processor's cache."""
_RENAMED = (
    ("WPNet.", "attention."),
    ("Encoder_coupled.init_deep.0.", "depth_head."),
    ("Encoder_coupled.init_rgb.0.", "rgb_head."),
    ("Encoder_coupled.coupled_feat_extractor.", "layers."),
    ("Decoder_depth.Decoder_Deep.", "decoder."),
)


class EdgeAttention(nn.Module):
    """Weights in 0..1 of the photo's edges, from the photo's features and from a coarse map of them."""

    def __init__(self) -> None:
        """Make the layers."""
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
        coarse = functional.max_pool2d(self.conv2(x), 7, stride=3)  # a sixth of the size
        coarse = self.conv3_(self.conv3(self.conv_max(coarse).relu()).relu())
        coarse = functional.interpolate(coarse, x.shape[-2:], mode="bilinear", align_corners=False)
        return self.conv4(coarse + self.conv_f(x)).sigmoid()


class CoupledLayer(nn.Module):
    """A residual block for depth and one for the photo, which share half of their kernels."""

    def __init__(self) -> None:
        """Make the parameters; they get their values from a file."""
        super().__init__()
        for index in (1, 2):
            for kind, count in (("shared", _SHARED), ("depth", FEATURES - _SHARED), ("rgb", FEATURES - _SHARED)):
                self.register_parameter(f"kernel_{kind}_{index}", nn.Parameter(torch.zeros(count, FEATURES, 3, 3)))
                self.register_parameter(f"bias_{kind}_{index}", nn.Parameter(torch.zeros(count)))

    def forward(self, depth: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """Map two tensors of (B, 64, H, W) to two of the same shape."""
        return self._refine(depth, "depth"), self._refine(rgb, "rgb")

    def _refine(self, x: Tensor, kind: str) -> Tensor:
        """Apply the residual block of a kind."""
        y = functional.conv2d(x, *self._parameters_of(kind, 1), padding=1).relu_()
        return functional.conv2d(y, *self._parameters_of(kind, 2), padding=1).add_(x).relu_()

    def _parameters_of(self, kind: str, index: int) -> tuple[Tensor, Tensor]:
        """Return the kernels and biases of a convolution."""
        kernels, biases = (
            torch.cat([self.get_parameter(f"{part}_{each}_{index}") for each in ("shared", kind)])
            for part in ("kernel", "bias")
        )
        return kernels.contiguous(memory_format=torch.channels_last), biases


class DCTNet(PeerNetwork):
    """DCTNet with its authors' sizes: 64 features, 4 layers, 0.48 million parameters.

    The attention and the cosine transform see the whole image, so there are no tiles: large images need about 2 kB of
    memory per pixel.
    """

    title = "DCTNet"
    scales = (4, 8, 16)
    cost: ClassVar[Cost] = Cost(work=300_000, memory=2_000)

    def __init__(self) -> None:
        """Make the layers."""
        super().__init__()
        self.lambd = nn.Parameter(torch.zeros(1, FEATURES, 1, 1))
        self.depth_head = nn.Conv2d(1, FEATURES, 3, padding=1)
        self.rgb_head = nn.Conv2d(3, FEATURES, 3, padding=1)
        self.layers = nn.ModuleList(CoupledLayer() for _ in range(_LAYERS))
        self.attention = EdgeAttention()
        self.decoder = nn.Sequential(
            nn.Conv2d(FEATURES, FEATURES // 2, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FEATURES // 2, FEATURES // 4, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FEATURES // 4, 1, 3, padding=1),
            nn.ReLU(inplace=True),
        )

    @classmethod
    def rename(cls, name: str) -> str | None:
        """Return the name here of a tensor of the authors' file; None for the one layer that they do not use."""
        if name.startswith("WPNet.conv_dilation."):
            return None
        for theirs, ours in _RENAMED:
            if name.startswith(theirs):
                return ours + name.removeprefix(theirs)
        return name

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge as Pillow's bicubic filter does."""
        return upsample_pillow(values_lr, size)

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`. The result is not negative."""
        depth = self.depth_head(values).relu_()
        guide = self.rgb_head(normalise_imagenet(rgb)).relu_()
        for layer in self.layers:
            depth, guide = layer(depth, guide)
        return self.decoder(transfer_edges(depth, guide, self.attention(guide), self.lambd.exp()))


def transfer_edges(depth: Tensor, guide: Tensor, weight: Tensor, strength: Tensor) -> Tensor:
    """Return x with (1 + strength L^2) x = depth + strength L (weight L guide), L the Laplacian.

    Args:
        depth: (B, C, H, W).
        guide: (B, C, H, W).
        weight: (B, C, H, W) weights of the guide's edges.
        strength: (1, C, 1, 1).

    Returns:
        (B, C, H, W) in float32 or float64.

    """
    dtype = torch.promote_types(strength.dtype, torch.float32)
    height, width = depth.shape[-2:]
    eigenvalues = _laplacian_eigenvalues(height, width, strength).square()
    parts = [each.split(max(1, _CHUNK // (height * width)), dim=1) for each in (depth, guide, weight, strength)]
    solved = []
    for part in zip(*parts, strict=True):
        d, r, w, factor = (each.to(dtype).contiguous() for each in part)
        right = laplacian(laplacian(r) * (w * factor)) + d
        solved.append(idct2(dct2(right) / (factor * eigenvalues + 1)))
    return torch.cat(solved, dim=1)


def laplacian(x: Tensor) -> Tensor:
    """Return the sum of the 3 x 3 neighbours of each pixel minus 9 times the pixel, divided by 16; mirrored border.

    Args:
        x: (B, C, H, W) with at least two rows and columns.

    """
    padded = functional.pad(x, (1, 1, 1, 1), mode="reflect")
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    return (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:] - 9 * x) / 16


def _laplacian_eigenvalues(height: int, width: int, like: Tensor) -> Tensor:
    """Return the eigenvalues of the Laplacian of four neighbours in the cosine basis, (height, width)."""
    rows, columns = (
        torch.cos(math.pi / size * torch.arange(size, dtype=torch.float64, device=like.device))
        for size in (height, width)
    )
    return (2 * (rows[:, None] + columns - 2)).to(like)
