"""Metrics of the points that a depth map is back-projected to, against those of the true map: P = z r, in metres.

The predicted cloud has the pixels with both depths, the true one all pixels with a true depth; nothing is thinned out.

- *Chamfer distance*: the mean of the mean distances of either cloud to the other. ``chamfer_dist`` in
  ``unidepth/utils/evaluation_depth.py`` of lpiccinelli-eth/UniDepth (8d8cfe4).
- *F-score*: the harmonic mean of precision and recall, the fractions of the two clouds that are less than a threshold
  from the other one (Knapitsch et al., *Tanks and Temples*, SIGGRAPH 2017). ``eval_mesh`` in ``atlas/evaluation.py`` of
  magicleap/Atlas (bee3ddb) takes 5 cm, as for ScanNet, and thins both clouds out to 2 cm first.
- *Flying pixels*: predicted points in the void between two surfaces (Sabov and Krueger, SCCG 2008). A point flies if it
  lies between the front and the back of true depth discontinuities within 16 pixels along rows and columns, as far as
  one low-resolution pixel reaches at x16, and more than 1 % of its depth away from every true point.
"""

from __future__ import annotations

from functools import partial

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from dsr.geometry.hole_size import window_maxima
from dsr.metrics.depth import covered
from dsr.metrics.formats import Metric, column, depth_mask, of_parts, target_mask
from dsr.metrics.functional import SurfacePair, masked_mean, once_per_pair

EDGE_RATIO = 1.05  # of the depths of two neighbours at a discontinuity, as in Depth Pro's contours
EDGE_RADIUS = 16  # pixels
FLYING = 0.01  # distance of a flying pixel from every true point, as a fraction of its depth


@once_per_pair
def point_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the errors of the points by name, (B,) each; NaN without a predicted point."""
    predicted, true = pair.prediction * pair.rays, pair.given[1] * pair.rays
    to_truth = nearest(predicted, pair.depth_mask, true, pair.target_mask)
    to_prediction = nearest(true, pair.target_mask, predicted, pair.depth_mask)
    flying = between_edges(pair) & (to_truth > FLYING * pair.prediction)
    found = {
        "flying": masked_mean(flying, pair.depth_mask),
        "chamfer": (masked_mean(to_truth, pair.depth_mask) + masked_mean(to_prediction, pair.target_mask)) / 2,
    }
    for name, threshold in (("F_1cm", 0.01), ("F_5cm", 0.05)):
        precision = masked_mean(to_truth < threshold, pair.depth_mask)
        recall = masked_mean(to_prediction < threshold, pair.target_mask)
        score = 2 * precision * recall / (precision + recall)
        found[name] = torch.where(precision + recall == 0, 0, score)
    return {name: value.squeeze(1) for name, value in found.items()}


def nearest(points: Tensor, valid: Tensor, cloud: Tensor, known: Tensor) -> Tensor:
    """Return the distance of each valid point (B, 3, H, W) from the nearest known one of a cloud (B, 3, H, W), exactly.

    The distances, (B, 1, H, W), are 0 where there is no point, and infinite where there is no other one.
    """
    distances = torch.zeros_like(points[:, :1])
    for found, *image in zip(distances, points, valid, cloud, known, strict=True):
        own, has, other, there = (each.detach().cpu() for each in image)
        tree = cKDTree(other[:, there[0]].T.double().numpy(), balanced_tree=False, compact_nodes=False)
        near = torch.from_numpy(tree.query(own[:, has[0]].T.double().numpy())[0])
        found.copy_(torch.zeros(has.shape, dtype=torch.float64).masked_scatter(has, near))
    return distances


def between_edges(pair: SurfacePair) -> Tensor:
    """Return whether a prediction is between the front and the back of the true edges around it, (B, 1, H, W) bool."""
    truth = torch.where(pair.target_mask, pair.given[1], torch.nan)
    front, back = torch.full_like(truth, torch.inf), torch.zeros_like(truth)  # of the true edges at a pixel
    for dim in (-1, -2):
        size = truth.shape[dim] - 1
        sides = truth.narrow(dim, 0, size), truth.narrow(dim, 1, size)
        near, far = torch.minimum(*sides), torch.maximum(*sides)
        edge = far > EDGE_RATIO * near  # false where one is NaN
        near, far = torch.where(edge, near, torch.inf), torch.where(edge, far, 0)
        for start in (0, 1):
            beside = front.narrow(dim, start, size), back.narrow(dim, start, size)
            beside[0].copy_(torch.minimum(beside[0], near))
            beside[1].copy_(torch.maximum(beside[1], far))
    front, back = -window_maxima(-front, EDGE_RADIUS), window_maxima(back, EDGE_RADIUS)
    return (front < pair.prediction) & (pair.prediction < back)


_points = partial(of_parts, "Points_", point_errors, min_size=1, unit="cm", whole=True)
_fraction = partial(column, factor=1e2, higher_is_better=True)
METRICS: tuple[Metric, ...] = (
    # not of regions: the outlines of a region's objects are edges of what lies outside
    *_points(depth_mask, {"flying": column("Flying", "1 % of depth, %", 1e2, 2)}, regional=False),
    *_points(
        target_mask,
        {
            "chamfer": column("Chamfer", "mm", 1e3, 2),
            "F_1cm": _fraction("F at 1 cm", "%", digits=2),
            "F_5cm": _fraction("F at 5 cm", "%", digits=2),
        },
    ),
    Metric(
        "Points_covered", covered, target_mask, _fraction("Covered", "points, %"), min_size=1, unit="cm", whole=True
    ),
)
