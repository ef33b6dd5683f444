"""LPIPS with a random trunk."""

import torch
from torch import Tensor

from dsr.metrics.lpips import LPIPS

_SHAPES = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}


def random_trunk(seed: int = 0) -> dict[str, Tensor]:
    """Return weights of AlexNet's convolutions that keep the size of features."""
    random = torch.Generator().manual_seed(seed)
    trunk = {}
    for index, shape in _SHAPES.items():
        fan_in = shape[1] * shape[2] * shape[3]
        trunk[f"features.{index}.weight"] = torch.randn(shape, generator=random) * (2 / fan_in) ** 0.5
        trunk[f"features.{index}.bias"] = 0.1 * torch.randn(shape[0], generator=random)
    return trunk


def random_lpips() -> LPIPS:
    """Return the network."""
    return LPIPS(random_trunk())
