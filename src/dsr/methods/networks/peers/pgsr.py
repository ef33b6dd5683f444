"""PGSR: guidance by piecewise planes.

Xu, Yao, Guan, Xiong, *Learning Piecewise Planar Representation for RGB Guided Depth Super-Resolution*, IEEE
Transactions on Computational Imaging 2024. Three times, features of the photo become a plane per pixel, planes are
moved along offsets that the map's features give, and the depth of both is fused into the features of map and photo.
Attention between the planes of both then weighs the photo's features. Everything but the last layers has a quarter of
the photo's resolution. Layers have the names of the authors' files. Weights: github.com/XrKang/PGSR.
"""

import re
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Cost
from dsr.methods.images import grey, normalise_imagenet
from dsr.methods.networks.peers import SWAPPED_LUMA, PeerNetwork, ResidualGroup, conv3x3, fold_batch_norm

_FACTOR, _WIDTH, _SHARED, _LAST = 4, 32, 16, 64
_SQUEEZED = 2
_SLOPE, _BLOCK_SLOPE = 0.1, 0.01
_LARGEST_OFFSET, _STEPS = 0.1, 3
_TINY = 1e-6
_STRIP = 2**18  # pixels of the photo that the last layers compute at a time
_HALO = 2  # rows, at a quarter of the resolution, that a row of the last layers depends on at either side
# tensors of the authors' file that serve the training, or nothing
_UNUSED = re.compile(r"^(PAI_\d\.(upconv\d|fusion2Depth)|conv_(depth|rgb)_mapping[23])\.(weight|bias)$")


class PGSR(PeerNetwork):
    """PGSR with 32 features, 0.73 million parameters; it sees the whole image, so only its last layers use strips."""

    title = "PGSR"
    checksums = MappingProxyType({"4e652c04c6523058": 4, "0774dd5c80ddc29a": 8, "ea327e3050228fb5": 16})
    multiple = _FACTOR
    cost = Cost(320, 1.5)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.conv_depth, self.conv_rgb = (conv3x3(_FACTOR**2, _WIDTH) for _ in range(2))
        self.conv_shared = conv3x3(_FACTOR**2, _SHARED)
        self.feature_extraction_depth, self.feature_extraction_rgb = (_groups(_WIDTH) for _ in range(2))
        self.feature_extraction_shared = _groups(_SHARED)
        self.conv_depth_semi, self.conv_rgb_semi = (conv3x3(_WIDTH + _SHARED, _WIDTH) for _ in range(2))
        self.conv_depth_mapping1, self.conv_rgb_mapping1 = (conv3x3(_WIDTH + _SHARED, _WIDTH) for _ in range(2))
        self.PAI_1, self.PAI_2, self.PAI_3 = (_Interaction() for _ in range(3))
        self.PGR = _Reconstruction()

    @classmethod
    def convert(cls, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Drop what inference does not need, and merge the batch normalisations into the convolutions before them."""
        heads = [f"PAI_{i}.conv_{kind}" for i in (1, 2, 3) for kind in ("offset", "parameterized_depth")]
        for head in (*heads, "PGR.conv_depth2Plane", "PGR.conv_parameterized_depth"):
            fold_batch_norm(tensors, f"{head}.0", f"{head}.1")
        return {  # their convolutions of residual blocks are sequences of one layer
            re.sub(r"\.body\.([02])\.0\.(weight|bias)$", r".body.\1.\2", name): value
            for name, value in tensors.items()
            if not _UNUSED.match(name)
        }

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map by cubic convolution with a = -0.75, edge pixels repeated."""
        return functional.interpolate(values_lr, size, mode="bicubic", align_corners=False)

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        luma = grey(normalise_imagenet(rgb), SWAPPED_LUMA)
        depth, photo = (functional.pixel_unshuffle(each, _FACTOR) for each in (values, luma))
        shared = self.feature_extraction_shared(_apply(self.conv_shared, torch.cat((depth, photo))))
        fused, of_photo = shared.chunk(2)
        depth = self.feature_extraction_depth(_apply(self.conv_depth, depth))
        photo = self.feature_extraction_rgb(_apply(self.conv_rgb, photo))
        depth, photo = _apply(self.conv_depth_semi, depth, fused), _apply(self.conv_rgb_semi, photo, of_photo)
        for interaction in (self.PAI_1, self.PAI_2, self.PAI_3):
            fused = interaction(depth, photo)
            depth = _apply(self.conv_depth_mapping1, fused, depth)
            photo = _apply(self.conv_rgb_mapping1, fused, photo)
        result: Tensor = self.PGR(depth, photo, fused)
        return result


class _Interaction(nn.Module):
    """The map's and the photo's features become one estimate of the depth, and that becomes features."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_offset, self.conv_parameterized_depth = _head(_WIDTH // 4, 3), _head(_WIDTH // 4, 4)
        self.conv_depth2feature, self.conv_depthMapping = conv3x3(1, _SHARED), conv3x3(_WIDTH, _SHARED)
        self.conv_fusion = conv3x3(_WIDTH, _SHARED)

    def forward(self, depth: Tensor, photo: Tensor) -> Tensor:
        """Map (B, 32, h, w) and (B, 32, h, w) to (B, 16, h, w)."""
        confidence, offset = self.conv_offset(depth).float().split((1, 2), dim=1)
        confidence, offset = confidence.sigmoid(), offset.tanh() * _LARGEST_OFFSET
        # -1 and 1 at the centres of the border pixels
        down, across = (torch.linspace(-1, 1, n, dtype=offset.dtype, device=offset.device) for n in offset.shape[-2:])
        places = torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)[None]  # (1, h, w, 2)
        for _ in range(_STEPS):
            offset = offset + functional.grid_sample(offset, _move(places, offset), align_corners=True)
        planes = _normalise(self.conv_parameterized_depth(photo))
        others = functional.grid_sample(planes, _move(places, offset), padding_mode="border", align_corners=True)
        estimate = torch.lerp(_evaluate(planes), _evaluate(others), confidence)
        mapped = _apply(self.conv_depthMapping, depth)
        return self.conv_fusion(torch.cat((mapped, _apply(self.conv_depth2feature, estimate)), dim=1))


class _Reconstruction(nn.Module):
    """Attention between the planes of the map and of the photo, and the layers that return to full resolution."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_depth2Plane, self.conv_parameterized_depth = _head(_WIDTH // 8, 4), _head(_WIDTH // 4, 4)
        self.conv_MP = conv3x3(_SHARED + 4, 4)
        self.Q_1, self.Q_2 = conv3x3(4, _WIDTH), conv3x3(_WIDTH, _WIDTH)
        self.K_1, self.K_2 = conv3x3(4, _WIDTH), conv3x3(_WIDTH, _WIDTH)
        self.V = conv3x3(_WIDTH, _WIDTH)
        layers = conv3x3(_WIDTH, _WIDTH, bias=False), nn.LeakyReLU(_SLOPE), conv3x3(_WIDTH, _WIDTH, bias=False)
        self.depth_mapping = nn.ModuleDict({"body": nn.Sequential(*layers)})
        self.fusion = nn.Conv2d(2 * _WIDTH, _WIDTH, 1)
        self.recon_trunk = _groups(_WIDTH)
        self.upconv1, self.upconv2 = conv3x3(_WIDTH, 4 * _WIDTH), conv3x3(_WIDTH, 4 * _LAST)
        self.HRconv, self.conv_last = conv3x3(_LAST, _LAST), conv3x3(_LAST, 1)

    def forward(self, depth: Tensor, photo: Tensor, fused: Tensor) -> Tensor:
        """Map (B, 32, h, w), (B, 32, h, w) and (B, 16, h, w) to (B, 1, 4 h, 4 w)."""
        mutual = _apply(self.conv_MP, _normalise(self.conv_depth2Plane(depth)), fused)
        query = self.Q_2(self.Q_1(mutual))
        key = self.K_2(self.K_1(_normalise(self.conv_parameterized_depth(photo))))
        weighed = self.V(photo) * (query * key).sum(dim=1, keepdim=True).sigmoid()
        depth = self.depth_mapping["body"](depth) + depth
        x = self.recon_trunk(_apply(self.fusion, weighed, depth))
        height, strip = x.shape[-2], max(_STRIP // (_FACTOR**2 * x.shape[-1]), 1)
        parts = []
        for start in range(0, height, strip):
            first, stop = max(start - _HALO, 0), min(start + strip, height)
            part = x[..., first : min(stop + _HALO, height), :]
            for layer in (self.upconv1, self.upconv2):
                part = functional.pixel_shuffle(_apply(layer, part), 2)
            part = self.conv_last(_apply(self.HRconv, part))
            parts.append(part[..., _FACTOR * (start - first) : _FACTOR * (stop - first), :])
        return torch.cat(parts, dim=-2)


def _groups(width: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualGroup(width, _SQUEEZED, _BLOCK_SLOPE, bias=False) for _ in range(2)))


def _head(hidden: int, after: int) -> nn.Sequential:
    """Return layers from features to a few values; batch normalisation is part of the first convolution."""
    return nn.Sequential(conv3x3(_WIDTH, hidden), nn.Identity(), nn.ELU(inplace=True), conv3x3(hidden, after))


def _apply(layer: nn.Module, *inputs: Tensor) -> Tensor:
    """Return a convolution of the inputs' channels, followed by a leaky ReLU."""
    return functional.leaky_relu_(layer(torch.cat(inputs, dim=1)), _SLOPE)


def _move(places: Tensor, offset: Tensor) -> Tensor:
    """Return positions, (1, h, w, 2), moved by (B, 2, h, w)."""
    return (places + offset.movedim(1, -1)).clamp(-1, 1)


def _normalise(planes: Tensor) -> Tensor:
    """Return planes, (B, 4, h, w), whose first three components have length 1, in float32."""
    direction, inverse = planes.float().split((3, 1), dim=1)
    length = (direction.square().sum(dim=1, keepdim=True) + _TINY).sqrt()
    return torch.cat((direction / length, inverse), dim=1)


def _evaluate(planes: Tensor) -> Tensor:
    """Return the depth, (B, 1, h, w), of each pixel's plane; at most 1."""
    coordinates = []  # nearly constant, as the authors' code has them
    for size in planes.shape[-2:]:
        centred = torch.arange(size, dtype=planes.dtype, device=planes.device) - (size - 1) / 2
        coordinates.append(2 * (centred / (max(planes.shape[-2:]) * max(size - 1, 1)) - 0.5))
    down, across = coordinates
    p, q, r, s = planes.split(1, dim=1)
    return ((p * across + q * down[:, None] + r) * s).clamp(min=1).reciprocal()
