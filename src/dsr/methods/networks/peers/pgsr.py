"""PGSR: guidance by piecewise planes.

Xu, Yao, Guan, Xiong, *Learning Piecewise Planar Representation for RGB Guided Depth Super-Resolution*, IEEE
Transactions on Computational Imaging 2024. Three times, features of the photo become a plane per pixel, planes are
moved along offsets that the map's features give, and the depth of both is fused into the features of map and photo.
Attention between the planes of both then weighs the photo's features. Everything but the last layers has a quarter of
the photo's resolution. Weights: github.com/XrKang/PGSR.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.images import grey, normalise_imagenet
from dsr.methods.networks.peers.peer_network import SWAPPED_LUMA, PeerNetwork, fold_batch_norm, rename

_FACTOR, _WIDTH, _SHARED, _LAST = 4, 32, 16, 64
_ROUNDS, _GROUPS, _BLOCKS, _SQUEEZED = 3, 2, 2, 2
_SLOPE, _BLOCK_SLOPE = 0.1, 0.01
_LARGEST_OFFSET, _STEPS = 0.1, 3
_TINY = 1e-6
_STRIP = 2**18  # pixels of the photo that the last layers compute at a time
_HALO = 2  # rows, at a quarter of the resolution, that a row of the last layers depends on at either side
_NAMES = {
    r"\.body\.(\d)\.body\.0\.0\.": r".blocks.\1.first.",
    r"\.body\.(\d)\.body\.2\.0\.": r".blocks.\1.second.",
    r"\.body\.(\d)\.body\.3\.conv_du\.0\.": r".blocks.\1.squeeze.",
    r"\.body\.(\d)\.body\.3\.conv_du\.2\.": r".blocks.\1.excite.",
    rf"\.body\.{_BLOCKS}\.0\.": ".last.",
    r"^conv_(depth|rgb|shared)\.": r"stems.\1.",
    r"^feature_extraction_": "features.",
    r"^conv_(depth|rgb)_semi\.": r"merges.\1.",
    r"^conv_(depth|rgb)_mapping1\.": r"updates.\1.",
    r"^PAI_(\d)\.": r"interactions.\1.",
    r"^PGR\.": "reconstruction.",
    r"\.conv_offset\.": ".offset.",
    r"\.conv_parameterized_depth\.": ".planes.",
    r"\.conv_depth2Plane\.": ".depth_planes.",
    r"(offset|planes)\.3\.": r"\1.2.",
    r"\.conv_depth2feature\.": ".estimate.",
    r"\.conv_depthMapping\.": ".depth.",
    r"\.conv_fusion\.": ".fusion.",
    r"\.conv_MP\.": ".mutual.",
    r"\.depth_mapping\.body\.(\d)\.": r".depth.\1.",
    r"\.Q_(\d)\.": r".query.\1.",
    r"\.K_(\d)\.": r".key.\1.",
    r"\.V\.": ".value.",
    r"\.recon_trunk\.": ".trunk.",
    r"\.upconv(\d)\.": r".doublings.\1.",
    r"\.HRconv\.": ".smooth.",
    r"\.conv_last\.": ".last.",
}
"""Regular expressions of the authors' names, and their replacements here."""
_UNUSED = re.compile(r"^(PAI_\d\.(upconv\d|fusion2Depth)|conv_(depth|rgb)_mapping[23])\.(weight|bias)$")
"""Tensors of the authors' file that serve the training, or nothing."""


class PGSR(PeerNetwork):
    """The network of :mod:`dsr.methods.networks.peers.pgsr`.

    Its attention averages over the whole image, and its offsets are fractions of the image's size, so large images are
    not processed in tiles. Only the last layers, which need most of the memory, are computed in strips.
    """

    title: ClassVar[str] = "PGSR"
    checksums: ClassVar[Mapping[str, float]] = MappingProxyType(
        {"4e652c04c6523058": 4, "0774dd5c80ddc29a": 8, "ea327e3050228fb5": 16}
    )
    multiple: ClassVar[int] = _FACTOR
    cost: ClassVar[Cost] = Cost(320, 1.5)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        widths = {"depth": _WIDTH, "rgb": _WIDTH, "shared": _SHARED}
        self.stems = nn.ModuleDict({name: _conv(_FACTOR**2, width) for name, width in widths.items()})
        self.features = nn.ModuleDict({name: _groups(width) for name, width in widths.items()})
        self.merges, self.updates = (
            nn.ModuleDict({name: _conv(_WIDTH + _SHARED, _WIDTH) for name in ("depth", "rgb")}) for _ in range(2)
        )
        self.interactions = nn.ModuleDict({str(i): _Interaction() for i in range(1, _ROUNDS + 1)})
        self.reconstruction = _Reconstruction()

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Drop what inference does not need, and merge the batch normalisations into the convolutions before them."""
        heads = [f"PAI_{i}.conv_{kind}" for i in range(1, _ROUNDS + 1) for kind in ("offset", "parameterized_depth")]
        for head in (*heads, "PGR.conv_depth2Plane", "PGR.conv_parameterized_depth"):
            fold_batch_norm(tensors, f"{head}.0", f"{head}.1")
        return rename({name: value for name, value in tensors.items() if not _UNUSED.match(name)}, _NAMES)

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map by cubic convolution with a = -0.75, edge pixels repeated."""
        return functional.interpolate(values_lr, size, mode="bicubic", align_corners=False)

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        luma = grey(normalise_imagenet(rgb), SWAPPED_LUMA)
        depth, photo = (functional.pixel_unshuffle(each, _FACTOR) for each in (values, luma))
        of_depth, of_photo = self.features["shared"](_apply(self.stems["shared"], torch.cat((depth, photo)))).chunk(2)
        depth = _apply(self.merges["depth"], self.features["depth"](_apply(self.stems["depth"], depth)), of_depth)
        photo = _apply(self.merges["rgb"], self.features["rgb"](_apply(self.stems["rgb"], photo)), of_photo)
        fused = of_depth
        for interaction in self.interactions.values():
            fused = interaction(depth, photo)
            depth, photo = _apply(self.updates["depth"], fused, depth), _apply(self.updates["rgb"], fused, photo)
        result: Tensor = self.reconstruction(depth, photo, fused)
        return result


class _Block(nn.Module):
    """Two convolutions, the channels of their result weighed by its means over the image, and added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        self.squeeze, self.excite = nn.Conv2d(width, _SQUEEZED, 1), nn.Conv2d(_SQUEEZED, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        y = self.second(functional.leaky_relu_(self.first(x), _BLOCK_SLOPE))
        weights = self.excite(functional.relu(self.squeeze(y.mean(dim=(-2, -1), keepdim=True)))).sigmoid()
        return torch.addcmul(x, y, weights)


class _Group(nn.Module):
    """Blocks and a convolution, and their input added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.blocks = nn.Sequential(*(_Block(width) for _ in range(_BLOCKS)))
        self.last = _conv(width, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return self.last(self.blocks(x)) + x


class _Interaction(nn.Module):
    """The map's and the photo's features become one estimate of the depth, and that becomes features."""

    def __init__(self) -> None:
        super().__init__()
        self.offset, self.planes = _head(_WIDTH // 4, 3), _head(_WIDTH // 4, 4)
        self.estimate, self.depth, self.fusion = _conv(1, _SHARED), _conv(_WIDTH, _SHARED), _conv(_WIDTH, _SHARED)

    def forward(self, depth: Tensor, photo: Tensor) -> Tensor:
        """Map (B, 32, h, w) and (B, 32, h, w) to (B, 16, h, w)."""
        confidence, offset = self.offset(depth).split((1, 2), dim=1)
        confidence, offset = confidence.sigmoid(), offset.tanh() * _LARGEST_OFFSET
        places = _pixel_grid(offset)
        for _ in range(_STEPS):
            offset = offset + functional.grid_sample(offset, _move(places, offset), align_corners=True)
        planes = _normalise(self.planes(photo))
        others = functional.grid_sample(planes, _move(places, offset), padding_mode="border", align_corners=True)
        estimate = torch.lerp(_evaluate(planes), _evaluate(others), confidence)
        return self.fusion(torch.cat((_apply(self.depth, depth), _apply(self.estimate, estimate)), dim=1))


class _Reconstruction(nn.Module):
    """Attention between the planes of the map and of the photo, and the layers that return to full resolution."""

    def __init__(self) -> None:
        super().__init__()
        self.depth_planes, self.planes = _head(_WIDTH // 8, 4), _head(_WIDTH // 4, 4)
        self.mutual = _conv(_SHARED + 4, 4)
        self.query, self.key = (nn.ModuleDict({"1": _conv(4, _WIDTH), "2": _conv(_WIDTH, _WIDTH)}) for _ in range(2))
        self.value = _conv(_WIDTH, _WIDTH)
        self.depth = nn.ModuleDict({name: _conv(_WIDTH, _WIDTH, bias=False) for name in ("0", "2")})
        self.fusion = nn.Conv2d(2 * _WIDTH, _WIDTH, 1)
        self.trunk = _groups(_WIDTH)
        self.doublings = nn.ModuleDict({"1": _conv(_WIDTH, 4 * _WIDTH), "2": _conv(_WIDTH, 4 * _LAST)})
        self.smooth, self.last = _conv(_LAST, _LAST), _conv(_LAST, 1)

    def forward(self, depth: Tensor, photo: Tensor, fused: Tensor) -> Tensor:
        """Map (B, 32, h, w), (B, 32, h, w) and (B, 16, h, w) to (B, 1, 4 h, 4 w)."""
        mutual = _apply(self.mutual, _normalise(self.depth_planes(depth)), fused)
        query = self.query["2"](self.query["1"](mutual))
        key = self.key["2"](self.key["1"](_normalise(self.planes(photo))))
        weighed = self.value(photo) * (query * key).sum(dim=1, keepdim=True).sigmoid()
        depth = self.depth["2"](_apply(self.depth["0"], depth)) + depth
        x = self.trunk(_apply(self.fusion, weighed, depth))
        height, strip = x.shape[-2], max(_STRIP // (_FACTOR**2 * x.shape[-1]), 1)
        parts = []
        for start in range(0, height, strip):
            first, stop = max(start - _HALO, 0), min(start + strip, height)
            part = self._enlarge(x[..., first : min(stop + _HALO, height), :])
            parts.append(part[..., _FACTOR * (start - first) : _FACTOR * (stop - first), :])
        return torch.cat(parts, dim=-2)

    def _enlarge(self, x: Tensor) -> Tensor:
        """Map (B, 32, h, w) to (B, 1, 4 h, 4 w)."""
        for layer in self.doublings.values():
            x = functional.pixel_shuffle(_apply(layer, x), 2)
        result: Tensor = self.last(_apply(self.smooth, x))
        return result


def _conv(before: int, after: int, *, bias: bool = True) -> nn.Conv2d:
    return nn.Conv2d(before, after, 3, padding=1, bias=bias)


def _groups(width: int) -> nn.Sequential:
    return nn.Sequential(*(_Group(width) for _ in range(_GROUPS)))


def _head(hidden: int, after: int) -> nn.Sequential:
    return nn.Sequential(_conv(_WIDTH, hidden), nn.ELU(inplace=True), _conv(hidden, after))


def _apply(layer: nn.Module, *inputs: Tensor) -> Tensor:
    """Return a convolution of the inputs' channels, followed by a leaky ReLU."""
    return functional.leaky_relu_(layer(inputs[0] if len(inputs) == 1 else torch.cat(inputs, dim=1)), _SLOPE)


def _pixel_grid(like: Tensor) -> Tensor:
    """Return the pixels' positions, (1, h, w, 2): across and down, -1 and 1 at the centres of the border pixels."""
    down, across = (torch.linspace(-1, 1, n, dtype=like.dtype, device=like.device) for n in like.shape[-2:])
    return torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)[None]


def _move(places: Tensor, offset: Tensor) -> Tensor:
    """Return positions, (1, h, w, 2), moved by (B, 2, h, w)."""
    return (places + offset.movedim(1, -1)).clamp(-1, 1)


def _normalise(planes: Tensor) -> Tensor:
    """Return planes, (B, 4, h, w), whose first three components have length 1."""
    direction, inverse = planes.split((3, 1), dim=1)
    length = (direction.square().sum(dim=1, keepdim=True) + _TINY).sqrt()
    return torch.cat((direction / length, inverse), dim=1)


def _evaluate(planes: Tensor) -> Tensor:
    """Return the depth, (B, 1, h, w), of each pixel's plane; at most 1."""
    across, down = (_plane_coordinates(n, max(planes.shape[-2:]), planes) for n in (planes.shape[-1], planes.shape[-2]))
    p, q, r, s = planes.split(1, dim=1)
    return ((p * across + q * down[:, None] + r) * s).clamp(min=1).reciprocal()


def _plane_coordinates(size: int, longest: int, like: Tensor) -> Tensor:
    """Return the coordinates of pixels along an axis, as the authors' code has them: nearly constant."""
    centred = torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2
    return 2 * (centred / (longest * max(size - 1, 1)) - 0.5)
