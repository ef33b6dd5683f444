"""Normals of a depth map."""

from __future__ import annotations

import torch
from torch import Tensor


def depth_to_normals(depth: Tensor, rays: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return the unit normals of the surface, (B, 3, H, W), facing the camera (n . r < 0).

    First-order forward differences along u and v, the last column's and row's differences repeated: n = dP/dv x dP/du,
    normalised (Voynov et al. 2019, section 3, with the border as its authors evaluate it).

    For a pinhole camera the product is known in closed form. With z' and z'' the depths of the neighbours along u and v
    it is, up to a positive factor, n = (fx (z' - z) z'', fy (z'' - z) z', -z' z'' - x n_x - y n_y), as n . r = -z' z''.
    Unlike differences of points, this cancels digits only in z' - z.

    Args:
        depth: (B, 1, H, W) orthogonal depth in metres, at least 2 x 2. Normals that need a NaN are NaN.
        rays: (B or 1, 3, H, W) rays of a pinhole camera with z = 1.
        dtype: of the result, None for the depth's. Differences, where digits cancel, are taken in the depth's dtype.
    """
    if min(depth.shape[-2:]) < 2:
        raise ValueError(f"normals: expected a map of at least 2 x 2 pixels, got {tuple(depth.shape[-2:])}")
    dtype = dtype or depth.dtype
    step_u = _repeat_last(depth.diff(dim=-1).to(dtype), dim=-1)
    step_v = _repeat_last(depth.diff(dim=-2).to(dtype), dim=-2)
    values = depth.to(dtype)  # of the next pixel; the last pixel's is the one before it
    along_u = torch.cat((values[..., 1:], values[..., -2:-1]), dim=-1)
    along_v = torch.cat((values[..., 1:, :], values[..., -2:-1, :]), dim=-2)
    x, y, _ = rays.split(1, dim=-3)
    height, width = depth.shape[-2:]
    fx = ((width - 1) / (x[..., :1, -1:] - x[..., :1, :1])).to(dtype)
    fy = ((height - 1) / (y[..., -1:, :1] - y[..., :1, :1])).to(dtype)
    x, y = x.to(dtype), y.to(dtype)
    nx = fx * step_u * along_v
    ny = fy * step_v * along_u
    nz = -(along_u * along_v + x * nx + y * ny)
    normals = torch.cat((nx, ny, nz), dim=-3)
    return normals / length(normals)


def length(vectors: Tensor) -> Tensor:
    """Return the Euclidean lengths of (..., 3, H, W) vectors, (..., 1, H, W).

    Much faster on the CPU than ``torch.linalg.vector_norm`` over an axis that is not the last.
    """
    x, y, z = vectors.split(1, dim=-3)
    return (x.square() + y.square() + z.square()).sqrt()


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle between unit vectors, (..., 3, H, W) each, in degrees: (..., 1, H, W).

    It is computed from the chord, which is precise for small angles, too.
    """
    return torch.rad2deg(2 * (length(first - second) / 2).clamp(max=1).asin())


def normal_mask(mask: Tensor) -> Tensor:
    """Return the mask of normals of a mask of depth, (B, 1, H, W): each needs its pixel and two neighbours."""
    along_u = _repeat_last(mask[..., :, 1:] & mask[..., :, :-1], dim=-1)
    along_v = _repeat_last(mask[..., 1:, :] & mask[..., :-1, :], dim=-2)
    return along_u & along_v


def _repeat_last(values: Tensor, dim: int) -> Tensor:
    """Append a copy of the last slice along ``dim``."""
    return torch.cat((values, values.narrow(dim, -1, 1)), dim)
