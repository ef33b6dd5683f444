"""SVLRM and FDKN: networks that estimate a filter for each pixel. Layers have the names of the authors' files.

SVLRM: Pan, Dong, Ren, Lin, Tang, Yang, *Spatially Variant Linear Representation Models for Joint Filtering*, CVPR 2019,
github.com/sunny2109/SVLRM. The refined map is a linear function of the grey photo; a plain convolutional network
estimates gain and offset of each pixel from the enlarged map and the photo.

FDKN, the fast deformable kernel network: Kim, Ponce, Ham, *Deformable Kernel Networks for Joint Image Filtering*, IJCV
2021 (arXiv 1910.08373), github.com/cvlab-yonsei/dkn (GPL-3). For each pixel the network estimates nine positions around
it and their weights, from the enlarged map and the photo, and adds the weighted sum of the map there.
"""

from itertools import pairwise
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import cubic_kernel
from dsr.methods.base import Cost
from dsr.methods.images import grey
from dsr.methods.networks.peers import SWAPPED_LUMA, PeerNetwork, fold_batch_norm

_WIDTH, _DEPTH, _SLOPE = 64, 10, 0.1
_CUBIC = -0.75  # parameter of the cubic kernel

_FACTOR, _TAPS, _RADIUS = 4, 3, 7
_WIDTHS = (16, 32, 32, 64, 64, 128, 128)


class SVLRM(PeerNetwork):
    """SVLRM with its authors' sizes: twelve layers of 64 features, 0.37 million parameters."""

    title = "SVLRM"
    checksums = MappingProxyType({"d0b47c00e5a8e074": 4, "a23c7cda0bccb284": 8, "77f6b973783a722d": 16})
    receptive_field_radius = _DEPTH + 2
    cost = Cost(800, 5)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.first_layer = nn.Conv2d(2, _WIDTH, 3, padding=1)
        self.feature_block = nn.Sequential()
        for _ in range(_DEPTH):
            self.feature_block.extend([nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1), nn.LeakyReLU(_SLOPE, inplace=True)])
        self.final_layer = nn.Conv2d(_WIDTH, 2, 3, padding=1)

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map by cubic interpolation, shifted to the left and upwards by (scale - 1) / 2 pixels.

        The authors' training takes the last pixel of each block for its middle, so the network undoes such a shift.
        """
        shift, matrices = (self.scale - 1) / 2, []
        for old, new in zip(values_lr.shape[-2:], size, strict=True):
            place = (torch.arange(new, dtype=torch.float64) + 0.5 + shift) * (old / new) - 0.5
            index = place.floor().long()[:, None] + torch.arange(-1, 3)
            weight = cubic_kernel((place[:, None] - index).abs(), _CUBIC)
            matrix = torch.zeros(new, old, dtype=torch.float64)
            matrices.append(matrix.scatter_add_(1, index.clamp(0, old - 1), weight).to(values_lr))
        down, across = matrices
        return down @ values_lr @ across.T

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        luma = grey(rgb)
        x = functional.leaky_relu(self.first_layer(torch.cat((values, luma), dim=1)), _SLOPE)
        gain, offset = self.final_layer(self.feature_block(x)).split(1, dim=1)
        return gain * luma + offset


class FDKN(PeerNetwork):
    """FDKN with its authors' sizes: nine positions in a window of 15 x 15 pixels, 0.69 million parameters."""

    title = "FDKN"
    checksums = MappingProxyType({"036ec8f27eec624c": 8})
    multiple = _FACTOR
    receptive_field_radius = _FACTOR * len(_WIDTHS)
    cost = Cost(420, 1)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.ImageKernel, self.DepthKernel = _Kernel(), _Kernel()

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Merge the batch normalisations into the convolutions before them."""
        for branch in ("ImageKernel", "DepthKernel"):
            for index in (1, 3, 5):
                fold_batch_norm(tensors, f"{branch}.conv{index}", f"{branch}.conv{index}_bn")
        return tensors

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        rgb_weights, rgb_offsets = self.ImageKernel(grey(rgb, SWAPPED_LUMA))
        depth_weights, depth_offsets = self.DepthKernel(values)
        weights = functional.pixel_shuffle(rgb_weights * depth_weights, _FACTOR).float()
        offsets = functional.pixel_shuffle(rgb_offsets * depth_offsets, _FACTOR).float()
        return values + _sample(values, weights - weights.mean(dim=1, keepdim=True), offsets)


class _Kernel(nn.Module):
    """The branch of one image, (B, 1, H, W): weights and offsets for each block of 4 x 4 pixels."""

    def __init__(self) -> None:
        super().__init__()
        for index, (before, after) in enumerate(pairwise(_WIDTHS)):
            self.add_module(f"conv{index + 1}", nn.Conv2d(before, after, 3, padding=1))
        self.conv_weight = nn.Conv2d(_WIDTHS[-1], _TAPS**2 * _FACTOR**2, 1)
        self.conv_offset = nn.Conv2d(_WIDTHS[-1], 2 * _TAPS**2 * _FACTOR**2, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        x = functional.pixel_unshuffle(image, _FACTOR)
        for index in range(1, len(_WIDTHS)):
            x = functional.relu_(self.get_submodule(f"conv{index}")(x))
        return self.conv_weight(x).sigmoid_(), self.conv_offset(x)


def _sample(values: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    """Return the weighted sum of a map at nine positions within 15 x 15 pixels around each pixel; 0 outside."""
    height, width = values.shape[-2:]
    rows = torch.arange(height, device=values.device, dtype=values.dtype)[:, None]
    columns = torch.arange(width, device=values.device, dtype=values.dtype)
    total = torch.zeros_like(values)
    for tap in range(_TAPS**2):
        # The grid's first pixel is the window's middle one, less half a pixel, and its rows lie across.
        across, down = (offsets[:, 2 * tap + axis] + place - 0.5 for axis, place in enumerate(divmod(tap, _TAPS)))
        inside = (_RADIUS + 1 - across.abs()).clamp(0, 1) * (_RADIUS + 1 - down.abs()).clamp(0, 1)
        x, y = across.clamp(-_RADIUS, _RADIUS) + columns, down.clamp(-_RADIUS, _RADIUS) + rows
        grid = torch.stack((2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1), dim=-1)
        sampled = functional.grid_sample(values, grid, align_corners=True)
        total += sampled * (weights[:, tap] * inside)[:, None]
    return total
