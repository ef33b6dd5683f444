"""Metrics of depth maps of a board whose plane is the ground truth, known within its outline alone.

A constant offset, the median difference, does not count, nor do pixels that are more than 60 mm off it: those belong to
another surface, and ``Plane_covered`` is the fraction of the others. Blur shows near the outline, so a region of these
pixels has scores of its own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.metrics.formats import Metric, column, depth_mask, target_mask
from dsr.metrics.functional import SurfacePair, masked_mean, masked_median, once_per_pair
from dsr.utils.compute_device import in_own_precision

NEAR = 0.06  # metres between a prediction and the plane up to which it is of the plane


def fit_plane(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the plane n . P = d through points (N, 3), of least squares along the axis that it faces most.

    The normal (3,) is of length 1 and n . P > 0; d is (), in the dtype of the points.
    """
    centre = points.mean(dim=0)
    moments = (points - centre).T @ (points - centre)
    others = torch.tensor([[1, 2], [0, 2], [0, 1]], device=points.device)
    minors = torch.stack([moments[each][:, each] for each in others])
    sizes = torch.linalg.det(minors)
    axis = int(sizes.argmax())
    if len(points) < 3 or not sizes[axis] > 0:
        raise ValueError(f"points: expected at least three that are not in a line, got {len(points)}")
    normal = torch.ones(3, dtype=points.dtype, device=points.device)
    normal[others[axis]] = -torch.linalg.solve(minors[axis], moments[others[axis], axis])
    normal = normal / normal.norm()
    distance = normal @ centre
    return normal * distance.sign(), distance.abs()


@once_per_pair
def compare(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the pixels of the plane, and prediction - truth less its median in metres, 0 elsewhere; (B, 1, H, W)."""
    difference = pair.prediction - pair.target
    off = difference - masked_median(difference, pair.depth_mask)
    scored = pair.depth_mask & (off.abs() < NEAR)
    return scored, torch.where(scored, off, 0)


def deviation(pair: SurfacePair) -> Tensor:
    """Return the standard deviation of depth about the plane in metres, (B,); lower is better."""
    scored, off = compare(pair)
    mean = masked_mean(off, scored)[..., None, None]
    return masked_mean((off - mean).square(), scored).sqrt().squeeze(1)


@in_own_precision
def angle(pair: SurfacePair) -> Tensor:
    """Return the mean angle between the normals and the plane's in degrees, (B,); 0 to 90, lower is better.

    The normals are by differences over two pixels, whose neighbours may be beyond the outline; the plane's is that of a
    fit to the truth, whose values may be rounded.
    """
    points = pair.given[0] * pair.rays
    along_u, along_v = torch.full_like(points, torch.nan), torch.full_like(points, torch.nan)
    along_u[..., 1:-1] = points[..., 2:] - points[..., :-2]
    along_v[..., 1:-1, :] = points[..., 2:, :] - points[..., :-2, :]
    normals = torch.linalg.cross(along_u, along_v, dim=1)
    normals = normals / normals.norm(dim=1, keepdim=True)
    true = torch.full_like(normals[:, :, 0, 0], torch.nan)
    for index, mask in enumerate(pair.target_mask):
        if mask.sum() > 2:
            points = (pair.given[1][index] * pair.rays.expand(len(true), -1, -1, -1)[index])[:, mask[0]].T
            true[index] = fit_plane(points)[0].to(true)
    cosine = torch.einsum("bchw,bc->bhw", normals, true)[:, None].abs().clamp(max=1)
    angles = torch.rad2deg(cosine.acos())
    return masked_mean(angles, compare(pair)[0] & angles.isfinite()).squeeze(1)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the plane's pixels where the prediction is of the plane, (B,); higher is better."""
    return masked_mean(compare(pair)[0], pair.target_mask).squeeze(1)


_covered = column("Covered", "plane, %", 1e2, higher_is_better=True)
METRICS: tuple[Metric, ...] = (
    Metric("Plane_std", deviation, depth_mask, column("Std", "plane, mm", 1e3, 2), unit="cm"),
    Metric("Plane_angle", angle, depth_mask, column("Angle", "plane, central, deg"), min_size=3),
    Metric("Plane_covered", covered, target_mask, _covered, unit="cm", regional=True, whole=True),
)  # the metrics of metrics=plane
