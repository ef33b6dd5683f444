"""Renderings under the paper's four lights, and under a softer one for pictures that people look at."""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.lights import LIGHTS, VIEWING_LIGHT


def lights(*, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
    """Return the paper's lights e1..e4 in the camera frame, (4, 3) unit vectors that point from surface to light.

    e1, e2, e3 are orthonormal, so renderings under them are the normal map in another basis; e4 is frontal.
    """
    return torch.tensor([light.direction for light in LIGHTS.values()], dtype=dtype, device=device)


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


VIEWING_TONES = (0.06, 0.9, 1.25)
"""Brightness of a surface that faces away from the light and of one that faces it, and the exponent between them."""


def render_for_viewing(normals: Tensor) -> Tensor:
    """Return a rendering in which no direction of the surface is clipped: floors, walls and ceilings all keep tone.

    Clipped Lambertian shading is white or black over whole floors, side walls and ceilings, so that their relief cannot
    be seen. Here the cosine to the light is mapped to a brightness over its whole range from -1 to 1, as in the "half
    Lambert" shading of Mitchell et al., "Shading in Valve's Source Engine", SIGGRAPH 2006 course. It is for pictures
    alone; metrics and the renderings e1 to e4 use :func:`render`.

    Args:
        normals: (B, 3, H, W) unit vectors.

    Returns:
        (B, 1, H, W) in (0, 1), NaN where the normal is.

    """
    low, high, exponent = VIEWING_TONES
    cosine = shade(normals, torch.tensor([VIEWING_LIGHT], dtype=normals.dtype, device=normals.device))
    return low + (high - low) * ((1 + cosine) / 2).clamp(0, 1) ** exponent
