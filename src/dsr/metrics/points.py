"""Metrics of the points that a depth map is back-projected to, against those of the true map: P = z r, in metres.

The predicted cloud has the pixels with both depths, the true one all pixels with a true depth. Distances are Euclidean,
each to the nearest point of the other cloud; nothing is thinned out.

- *Chamfer distance*: the mean of the mean distances of either cloud to the other. ``chamfer_dist`` in
  ``unidepth/utils/evaluation_depth.py`` of lpiccinelli-eth/UniDepth (8d8cfe4).
- *F-score*: the harmonic mean of precision and recall, the fractions of the two clouds that are less than a threshold
  from the other one. Knapitsch et al., *Tanks and Temples*, SIGGRAPH 2017; at 5 cm as for ScanNet, ``eval_mesh`` in
  ``atlas/evaluation.py`` of magicleap/Atlas (bee3ddb), which thins both clouds out to 2 cm first; and at 1 cm.
- *Flying pixels*: predicted points in the void between two surfaces (Sabov and Krueger, SCCG 2008). A point flies if

  1. an occlusion edge of the truth is within 16 pixels along rows and columns, as far as one low-resolution pixel
     reaches at x16: two neighbours whose depths have a ratio of more than 1.05, as in Depth Pro's contours;
  2. along the ray it lies behind the nearest front and before the farthest back of these edges; and
  3. it is more than 1 % of its depth away from every true point.

A hole of a prediction does not fly and adds nothing to a precision, but the true points there are far from the
predicted cloud, and ``Points_covered`` stands beside these metrics.
"""

from __future__ import annotations

from functools import partial

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import max_pool2d

from dsr.metrics.depth import covered
from dsr.metrics.formats import column
from dsr.metrics.functional import SurfacePair, masked_mean, once_per_pair
from dsr.metrics.metric import Metric, depth_mask, target_mask

EDGE_RATIO = 1.05
EDGE_RADIUS = 16
FLYING = 0.01  # distance of a flying pixel from every true point, as a fraction of its depth


def nearest(points: Tensor, valid: Tensor, cloud: Tensor, known: Tensor) -> Tensor:
    """Return the distance of each point from the nearest one of another cloud, exactly, by a k-d tree on the CPU.

    Points and cloud are (B, 3, H, W), ``valid`` and ``known`` (B, 1, H, W) bool the points that there are. The
    distances, (B, 1, H, W), are 0 where there is no point, and infinite where there is no other one.
    """
    distances = torch.zeros_like(points[:, :1])
    if points.is_meta:  # values are needed, and there are none
        return distances
    for found, *image in zip(distances, points, valid, cloud, known, strict=True):
        own, has, other, there = (each.detach().cpu() for each in image)
        tree = cKDTree(other[:, there[0]].T.double().numpy(), balanced_tree=False, compact_nodes=False)
        near = torch.from_numpy(tree.query(own[:, has[0]].T.double().numpy())[0])
        found.copy_(torch.zeros(has.shape, dtype=torch.float64).masked_scatter(has, near))
    return distances


@once_per_pair
def distances(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the distances of the predicted points from the true cloud, and of the true ones from the predicted cloud.

    They are (B, 1, H, W) in metres, 0 without a point.
    """
    predicted, true = pair.prediction * pair.rays, pair.given[1] * pair.rays
    return (
        nearest(predicted, pair.depth_mask, true, pair.target_mask),
        nearest(true, pair.target_mask, predicted, pair.depth_mask),
    )


def chamfer(pair: SurfacePair) -> Tensor:
    """Return the Chamfer distance in metres, (B,); lower is better. NaN without a predicted point."""
    to_truth, to_prediction = distances(pair)
    return (masked_mean(to_truth, pair.depth_mask) + masked_mean(to_prediction, pair.target_mask)).squeeze(1) / 2


def f_score(pair: SurfacePair, threshold: float) -> Tensor:
    """Return the F-score at a threshold in metres, (B,), 0 to 1; higher is better. NaN without a predicted point."""
    to_truth, to_prediction = distances(pair)
    precision = masked_mean(to_truth < threshold, pair.depth_mask)
    recall = masked_mean(to_prediction < threshold, pair.target_mask)
    score = 2 * precision * recall / (precision + recall)
    return torch.where(precision + recall == 0, 0, score).squeeze(1)


def flying(pair: SurfacePair) -> Tensor:
    """Return the fraction of the predicted points that fly between two surfaces, (B,); lower is better."""
    truth = torch.where(pair.target_mask, pair.given[1], torch.nan)
    front, back = torch.full_like(truth, torch.inf), torch.zeros_like(truth)  # of the true edges at a pixel
    for dim in (-1, -2):
        size = truth.shape[dim] - 1
        sides = truth.narrow(dim, 0, size), truth.narrow(dim, 1, size)
        near, far = torch.minimum(*sides), torch.maximum(*sides)
        edge = far > EDGE_RATIO * near  # false where one is NaN
        for start in (0, 1):
            part = front.narrow(dim, start, size)
            part.copy_(torch.where(edge, torch.minimum(part, near), part))
            part = back.narrow(dim, start, size)
            part.copy_(torch.where(edge, torch.maximum(part, far), part))
    for window, padding in (((1, 2 * EDGE_RADIUS + 1), (0, EDGE_RADIUS)), ((2 * EDGE_RADIUS + 1, 1), (EDGE_RADIUS, 0))):
        front = -max_pool2d(-front, window, stride=1, padding=padding)
        back = max_pool2d(back, window, stride=1, padding=padding)
    between = (front < pair.prediction) & (pair.prediction < back)
    return masked_mean(between & (distances(pair)[0] > FLYING * pair.prediction), pair.depth_mask).squeeze(1)


METRICS: tuple[Metric, ...] = (
    Metric(
        "Points_flying",
        flying,
        depth_mask,
        column("Flying", "1 % of depth, %", 1e2, 2),
        min_size=1,
        unit="cm",
        regional=False,  # the outlines of a region's objects are edges of what lies outside
        whole=True,
    ),
    *(
        Metric(f"Points_{name}", function, target_mask, shown, min_size=1, unit="cm", whole=True)
        for name, function, shown in (
            ("chamfer", chamfer, column("Chamfer", "mm", 1e3, 2)),
            ("F_1cm", partial(f_score, threshold=0.01), column("F at 1 cm", "%", 1e2, 2, higher_is_better=True)),
            ("F_5cm", partial(f_score, threshold=0.05), column("F at 5 cm", "%", 1e2, 2, higher_is_better=True)),
            ("covered", covered, column("Covered", "points, %", 1e2, 1, higher_is_better=True)),
        )
    ),
)
