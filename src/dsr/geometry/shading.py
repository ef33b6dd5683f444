"""The four lights, and renderings under them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

LIGHT_NAMES: tuple[str, ...] = ("e1", "e2", "e3", "e4")
_LIGHTS = (
    (0.0, -math.sqrt(2 / 3), -1 / math.sqrt(3)),
    (-1 / math.sqrt(2), 1 / math.sqrt(6), -1 / math.sqrt(3)),
    (1 / math.sqrt(2), 1 / math.sqrt(6), -1 / math.sqrt(3)),
    (0.0, 0.0, -1.0),
)


def lights(*, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Return the paper's lights e1..e4 in the camera frame, (4, 3) unit vectors that point from surface to light.

    e1, e2, e3 are orthonormal, so renderings under them are the normal map in another basis; e4 is frontal.
    """
    return torch.tensor(_LIGHTS, dtype=dtype, device=device)


def shade(normals: Tensor, directions: Tensor) -> Tensor:
    """Return the unclipped Lambertian shading e . n.

    Args:
        normals: (B, 3, H, W) unit vectors.
        directions: (L, 3) unit vectors towards the lights.

    Returns:
        (B, L, H, W) in [-1, 1].

    """
    return torch.einsum("lc,bchw->blhw", directions, normals)


def render(normals: Tensor) -> Tensor:
    """Return the renderings clip(e . n, 0, 1) under the four lights, (B, 4, H, W) in [0, 1]."""
    return shade(normals, lights(dtype=normals.dtype, device=normals.device)).clamp(0, 1)
