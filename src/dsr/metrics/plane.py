"""Metrics of depth maps of a flat target: a wall at an unknown place, or a board whose plane is the ground truth.

:class:`PlaneFit` needs no truth: it has what Intel's Depth Quality Tool shows, ``tools/depth-quality`` of
IntelRealSense/librealsense (cacc8e7), ``rs-depth-quality.cpp`` and ``depth-metrics.h``. A map that is wrong as a whole
may be flat, and so is a blurred one.

The metrics of a pair need an exact plane as the truth, known within its outline alone. A constant offset, the median
difference, does not count, nor do pixels that are more than 60 mm off it: those belong to another surface, and
``Plane_covered`` is the fraction of the others. What blur does shows within some pixels of the outline, so that a
region of these is scored for itself.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.surface import back_project
from dsr.metrics.formats import column
from dsr.metrics.functional import SurfacePair, masked_mean, masked_median
from dsr.metrics.metric import Metric, depth_mask, target_mask
from dsr.utils.compute_device import in_own_precision

NEAR = 0.06
"""Metres between a prediction and the plane up to which it is of the plane."""
_OUTLIERS = 200
"""One over the fraction of the points that is left out at the near end, and at the far end."""


class PlaneFit:
    """A plane fitted to a part of a depth map, and how the map differs from it.

    The plane is that of least squares along the axis that it faces most. The nearest and the farthest 0.5 % of the
    points count for the plane, but not for the errors.

    Args:
        depth: (1, H, W) orthogonal depth in metres; NaN is a hole, and so is a depth that is not positive.
        rays: (3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.
        region: (1, H, W) bool, the part; None for the middle two fifths of both sides.

    Attributes:
        normal: (3,) float64, unit normal of the plane, away from the camera.
        distance: () distance of the plane from the camera in metres.
        fill_rate: () fraction of the region that has a depth; higher is better.
        errors: (N,) signed distance of the points to the plane in metres, positive behind it.

    Raises:
        ValueError: shapes do not fit together, or the region has fewer than three points, or points in a line.

    """

    def __init__(self, depth: Tensor, rays: Tensor, region: Tensor | None = None) -> None:
        height, width = depth.shape[-2:]
        if region is None:
            region = torch.zeros(depth.shape, dtype=torch.bool, device=depth.device)
            rows, columns = (slice(int(0.3 * size), int(0.7 * size)) for size in (height, width))
            region[..., rows, columns] = True
        if depth.dim() != 3 or rays.shape != (3, height, width) or region.shape != depth.shape:
            came = ", ".join(str(tuple(each.shape)) for each in (depth, rays, region))
            raise ValueError(f"depth, rays, region: expected shapes (1, H, W), (3, H, W), (1, H, W), got {came}")
        known = region & depth.isfinite() & (depth > 0)
        points = back_project(depth.double(), rays.double())[:, known[0]].T
        self.normal, self.distance = fit_plane(points)
        self.fill_rate = known.sum() / region.sum()
        cut = len(points) // _OUTLIERS
        self._points = points[points[:, 2].argsort(stable=True)][cut : len(points) - cut]
        self.errors = self._points @ self.normal - self.distance
        self._middle = rays[:, height // 2, width // 2].double()

    @property
    def rms(self) -> Tensor:
        """The plane fit RMS error: the RMS distance to the plane as a fraction of ``distance``, (); lower is better."""
        return self.errors.square().mean().sqrt() / self.distance

    def subpixel_rms(self, baseline: float, focal: float) -> Tensor:
        """Return the RMS error of a stereo camera's disparity in pixels, (); lower is better.

        As the tool computes it, disparity is that of the distance from the camera, where its manual has the depth.

        Args:
            baseline: between the two cameras, in metres.
            focal: focal length in pixels of the map.

        """
        feet = self._points - self.errors[:, None] * self.normal
        difference = baseline * focal * (1 / self._points.norm(dim=1) - 1 / feet.norm(dim=1))
        return difference.square().mean().sqrt()

    def z_accuracy(self, distance: float) -> Tensor:
        """Return how much too far away the map is as a fraction of a true distance, (): the median; best is 0.

        Args:
            distance: true distance of the wall in the middle of the image along the optical axis, in metres.

        """
        offset = self._middle[2] * self.distance / (self.normal @ self._middle) - distance
        return (offset + self.errors.sort().values[len(self.errors) // 2]) / distance


def fit_plane(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the plane n . P = d through points, of least squares along the axis that it faces most.

    Args:
        points: (N, 3) in metres.

    Returns:
        The unit normal (3,) with n . P > 0, and the distance d (), in the dtype of the points.

    Raises:
        ValueError: there are fewer than three points, or they are in a line.

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


class PlaneComparison:
    """What the metrics derive from a pair whose truth is a plane.

    Args:
        pair: a prediction and the plane's depth.

    Attributes:
        scored: (B, 1, H, W) bool, the pixels that are of the plane.
        off: (B, 1, H, W) prediction - truth less its median in metres; 0 elsewhere.

    """

    def __init__(self, pair: SurfacePair) -> None:
        difference = pair.prediction - pair.target
        off = difference - masked_median(difference, pair.depth_mask)
        self.scored = pair.depth_mask & (off.abs() < NEAR)
        self.off = torch.where(self.scored, off, 0)


def deviation(pair: SurfacePair) -> Tensor:
    """Return the standard deviation of depth about the plane in metres, (B,); lower is better."""
    comparison = pair.derive(PlaneComparison)
    mean = masked_mean(comparison.off, comparison.scored)[..., None, None]
    return masked_mean((comparison.off - mean).square(), comparison.scored).sqrt().squeeze(1)


@in_own_precision
def angle(pair: SurfacePair) -> Tensor:
    """Return the mean angle between the normals and the plane's in degrees, (B,); 0 to 90, lower is better.

    The normals are by differences over two pixels, whose neighbours may be beyond the outline; the plane's is that of a
    fit to the truth, whose values may be rounded.
    """
    normals = _central_normals(back_project(pair.given[0], pair.rays))
    true = torch.full_like(normals[:, :, 0, 0], torch.nan)
    for index, mask in enumerate(pair.target_mask):
        if mask.sum() > 2:
            points = (pair.given[1][index] * pair.rays.expand(len(true), -1, -1, -1)[index])[:, mask[0]].T
            true[index] = fit_plane(points)[0].to(true)
    cosine = torch.einsum("bchw,bc->bhw", normals, true)[:, None].abs().clamp(max=1)
    angles = torch.rad2deg(cosine.acos())
    return masked_mean(angles, pair.derive(PlaneComparison).scored & angles.isfinite()).squeeze(1)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the plane's pixels where the prediction is of the plane, (B,); higher is better."""
    return masked_mean(pair.derive(PlaneComparison).scored, pair.target_mask).squeeze(1)


def _central_normals(points: Tensor) -> Tensor:
    """Return the normals of points by differences over two pixels, (B, 3, H, W); NaN where a neighbour is missing."""
    along_u, along_v = torch.full_like(points, torch.nan), torch.full_like(points, torch.nan)
    along_u[..., 1:-1] = points[..., 2:] - points[..., :-2]
    along_v[..., 1:-1, :] = points[..., 2:, :] - points[..., :-2, :]
    normals = torch.linalg.cross(along_u, along_v, dim=1)
    return normals / normals.norm(dim=1, keepdim=True)


METRICS: tuple[Metric, ...] = (
    Metric("Plane_std", deviation, depth_mask, column("Std", "plane, mm", 1e3, 2), unit="cm"),
    Metric("Plane_angle", angle, depth_mask, column("Angle", "plane, central, deg", 1, 1), min_size=3),
    Metric(
        "Plane_covered",
        covered,
        target_mask,
        column("Covered", "plane, %", 1e2, 1, higher_is_better=True),
        unit="cm",
        regional=True,
        whole=True,
    ),
)
"""The metrics of ``metrics=plane``."""
