"""Points and normals of a depth map."""

from __future__ import annotations

import torch
from torch import Tensor


def points_of(depth: Tensor, rays: Tensor) -> Tensor:
    """Back-project depth: P = z r.

    Args:
        depth: (B, 1, H, W) orthogonal depth in metres.
        rays: (B or 1, 3, H, W) rays with z = 1, see :meth:`dsr.geometry.camera.Camera.rays`.

    Returns:
        (B, 3, H, W) points in metres; x right, y down, z forward.

    """
    return depth * rays


def normals_of(depth: Tensor, rays: Tensor) -> Tensor:
    """Return the unit normals of the surface, facing the camera (n_z < 0).

    First-order forward differences along u and v, the last column's and row's differences repeated:
    n = dP/dv x dP/du, normalised (Voynov et al. 2019, section 3, with the border as its authors evaluate it).

    Args:
        depth: (B, 1, H, W) orthogonal depth in metres, H and W at least 2. Where it is NaN
            so are the normals that need it.
        rays: (B or 1, 3, H, W) rays with z = 1.

    Returns:
        (B, 3, H, W) unit vectors in the camera frame.

    Raises:
        ValueError: the map is less than 2 pixels high or wide.

    """
    if min(depth.shape[-2:]) < 2:
        raise ValueError(f"normals: expected a map of at least 2 x 2 pixels, got {tuple(depth.shape[-2:])}")
    points = points_of(depth, rays)
    along_u = _repeat_last(points.diff(dim=-1), dim=-1)
    along_v = _repeat_last(points.diff(dim=-2), dim=-2)
    vx, vy, vz = along_v.unbind(-3)
    ux, uy, uz = along_u.unbind(-3)
    normals = torch.stack((vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux), dim=-3)
    return normals / length(normals)


def length(vectors: Tensor) -> Tensor:
    """Return the Euclidean lengths of (..., 3, H, W) vectors, (..., 1, H, W).

    Many times faster on the CPU than ``torch.linalg.vector_norm`` over an axis that is not the last.
    """
    return vectors.square().sum(dim=-3, keepdim=True).sqrt()


def normal_mask(mask: Tensor) -> Tensor:
    """Return where a normal is known: where all the three or four pixels that its differences need are.

    Args:
        mask: (B, 1, H, W) bool, where depth is known.

    Returns:
        (B, 1, H, W) bool.

    """
    along_u = _repeat_last(mask[..., :, 1:] & mask[..., :, :-1], dim=-1)
    along_v = _repeat_last(mask[..., 1:, :] & mask[..., :-1, :], dim=-2)
    return along_u & along_v


def _repeat_last(values: Tensor, dim: int) -> Tensor:
    """Append a copy of the last slice along ``dim``."""
    return torch.cat((values, values.narrow(dim, -1, 1)), dim)
