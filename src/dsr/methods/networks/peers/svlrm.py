"""SVLRM: spatially variant linear representation models.

Pan, Dong, Ren, Lin, Tang, Yang, *Spatially Variant Linear Representation Models for Joint Filtering*, CVPR 2019. The
refined map is a linear function of the grey photo whose gain and offset, one of each per pixel, a plain convolutional
network estimates from the enlarged map and the photo. Weights: github.com/sunny2109/SVLRM.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.degradation.downsampling import cubic_kernel
from dsr.methods.base import Cost
from dsr.methods.classical.finite_differences import grey
from dsr.methods.networks.peers.base import PeerNetwork

_WIDTH, _DEPTH, _SLOPE = 64, 10, 0.1
_CUBIC = -0.75
"""Parameter of the cubic kernel."""


class SVLRM(PeerNetwork):
    """The network of :mod:`dsr.methods.networks.peers.svlrm`."""

    title: ClassVar[str] = "SVLRM"
    checksums: ClassVar[Mapping[str, float]] = MappingProxyType(
        {"d0b47c00e5a8e074": 4, "a23c7cda0bccb284": 8, "77f6b973783a722d": 16}
    )
    receptive_field_radius: ClassVar[int | None] = _DEPTH + 2
    cost: ClassVar[Cost] = Cost(800, 5)

    def __init__(self, scale: float) -> None:
        super().__init__(scale)
        self.first_layer = nn.Conv2d(2, _WIDTH, 3, padding=1)
        self.feature_block = nn.ModuleDict(
            {str(2 * index): nn.Conv2d(_WIDTH, _WIDTH, 3, padding=1) for index in range(_DEPTH)}
        )
        self.final_layer = nn.Conv2d(_WIDTH, 2, 3, padding=1)

    def enlarge(self, values_lr: Tensor, size: tuple[int, int]) -> Tensor:
        """Enlarge a map by cubic interpolation, shifted to the left and upwards by (scale - 1) / 2 pixels.

        The authors' training takes the last pixel of each block as the low-resolution value and enlarges the map as if
        it were the middle one, so the network has learnt to undo such a shift.
        """
        for dim, new in ((-2, size[0]), (-1, size[1])):
            values_lr = _resize(values_lr, dim, new, (self.scale - 1) / 2)
        return values_lr

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Refine an enlarged map; see :meth:`PeerNetwork.forward`."""
        luma = grey(rgb)
        x = functional.leaky_relu(self.first_layer(torch.cat((values, luma), dim=1)), _SLOPE)
        for layer in self.feature_block.values():
            x = functional.leaky_relu(layer(x), _SLOPE)
        gain, offset = self.final_layer(x).split(1, dim=1)
        return gain * luma + offset


def _resize(values: Tensor, dim: int, new: int, shift: float) -> Tensor:
    """Return cubic interpolation along a dimension, at positions further on by ``shift`` new pixels."""
    old = values.shape[dim]
    place = (torch.arange(new, dtype=torch.float64) + 0.5 + shift) * (old / new) - 0.5
    first = place.floor()
    index = first.long()[:, None] + torch.arange(-1, 3)
    weight = cubic_kernel((place[:, None] - index).abs(), _CUBIC)
    matrix = torch.zeros(new, old, dtype=torch.float64).scatter_add_(1, index.clamp(0, old - 1), weight).to(values)
    return matrix @ values if dim == -2 else values @ matrix.T
