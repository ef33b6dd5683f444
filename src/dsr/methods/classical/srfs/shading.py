"""The image formation model: Lambertian shading under first-order spherical harmonics lighting.

Haefner, Quéau, Möllenhoff and Cremers, *Fight Ill-Posedness with Ill-Posedness: Single-shot Variational Depth
Super-Resolution from Shading*, CVPR 2018, section 3: in each channel

    rgb = albedo * (l_1 n_x + l_2 n_y + l_3 n_z + l_4),    n = m / |m|,    m = (p, q, -z - x p - y q),

with the depth z, its slopes p = fx dz/du and q = fy dz/dv, and the ray (x, y, 1) of the pixel. m is the normal that
faces the camera, and its length gives the surface element: a pixel sees the area z |m| / (fx fy), whose sum is the
prior on the shape. z may be any multiple of depth in metres: m scales with it, n does not.

Shapes are (B, 3, H, W) for (p, q, z), called theta as in the paper, and for normals; (B, C, H, W) for photos and
albedos; (B, C, 4) for lighting.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dsr.geometry.surface import length

_TINY = 1e-12
"""Minimum length of m, which avoids division by 0."""


class Surface(NamedTuple):
    """Normals (B, 3, H, W) and the length of m before normalising, (B, 1, H, W)."""

    normals: Tensor
    length: Tensor


class Photometry(NamedTuple):
    """The photometric residual, (B, C, H, W), and its derivatives by theta, (B, C, 3, H, W)."""

    residual: Tensor
    slopes: Tensor


def compute_surface(theta: Tensor, rays: Tensor) -> Surface:
    """Return the normals, and the lengths of m.

    Args:
        theta: (B, 3, H, W), slopes along u and v and depth.
        rays: (1, 3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.

    """
    p, q, z = theta.split(1, dim=1)
    m = torch.cat((p, q, -z - rays[:, :1] * p - rays[:, 1:2] * q), dim=1)
    size = length(m).clamp(min=_TINY)
    return Surface(m / size, size)


def compute_shading(normals: Tensor, lighting: Tensor) -> Tensor:
    """Return the shading, (B, C, H, W)."""
    return torch.einsum("bck,bkhw->bchw", lighting[..., :3], normals) + lighting[..., 3, None, None]


def linearise_photometry(rgb: Tensor, albedo: Tensor, lighting: Tensor, surface: Surface, rays: Tensor) -> Photometry:
    """Return albedo * shading - rgb and its derivatives: albedo (l - (l . n) n) / |m| times those of m."""
    n = surface.normals
    directed = torch.einsum("bck,bkhw->bchw", lighting[..., :3], n)
    across = (lighting[..., :3, None, None] - directed[:, :, None] * n[:, None]) * (albedo / surface.length)[:, :, None]
    residual = albedo * (directed + lighting[..., 3, None, None]) - rgb
    return Photometry(residual, chain_to_theta(across, rays))


def chain_to_theta(by_m: Tensor, rays: Tensor) -> Tensor:
    """Convert derivatives by m to derivatives by theta, (..., 3, H, W)."""
    x, y = rays[0, 0], rays[0, 1]
    along_u, along_v, ahead = by_m.unbind(dim=-3)
    return torch.stack((along_u - x * ahead, along_v - y * ahead, -ahead), dim=-3)


def compute_area(theta: Tensor, surface: Surface) -> Tensor:
    """Return z |m|, (B, 1, H, W): fx fy times the surface area that a pixel sees."""
    return theta[:, 2:].abs() * surface.length


def fit_lighting(rgb: Tensor, albedo: Tensor, normals: Tensor, inside: Tensor) -> Tensor:
    """Return the lighting with the least squared error in each channel, (B, C, 4) float64.

    If the normals do not determine it, as on a plane, it is the one of minimum norm.

    Args:
        rgb: (B, C, H, W).
        albedo: (B, C, H, W).
        normals: (B, 3, H, W).
        inside: (B, 1, H, W) weight of each pixel.

    """
    ones = torch.ones_like(normals[:, :1])
    design = (torch.cat((normals, ones), dim=1) * inside)[:, None] * albedo[:, :, None]  # (B, C, 4, H, W)
    columns = design.flatten(3).double()
    gram = columns @ columns.mT
    right = columns @ (rgb * inside).flatten(2).double()[..., None]
    return (torch.linalg.pinv(gram, hermitian=True, rtol=_RANK) @ right)[..., 0]


_RANK = 1e-10
"""Relative cutoff of singular values, below which a direction of the light is not determined."""
