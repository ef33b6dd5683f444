"""The errors of depth, normals and points that other papers print, one value per image.

- ``metrics=depth``: AbsRel, SqRel, RMSElog and the accuracies delta of Eigen et al., NIPS 2014 (``compute_errors`` of
  nianticlabs/monodepth2 b676244); SIlog, iRMSE and iMAE of KITTI (Uhrig et al., 3DV 2017, its development kit); log10
  of Make3D; the accuracies at 1.05 and 1.10 of Zhang and Funkhouser, CVPR 2018.
- ``metrics=field``: RMSE and MAE of depth super-resolution in centimetres (NYU, RGB-D-D) or in 8-bit levels
  (Middlebury, Lu), the fractions of pixels off by more than 5 cm or by a ratio of more than 1.25, and, for
  ``scores.csv`` alone, the RMSE without the six pixels at the border that DKN and those after it cut off.
- ``metrics=normals``: mean, median and fractions below five angles of Bae and Davison, CVPR 2024 (baegwangbin/DSINE
  ef0c2af). Both normal maps are forward differences of depth; central differences have smaller angles.
- ``metrics=points``: the pixels with both depths and all pixels with a true depth as two clouds, not thinned out.
  *Chamfer distance* as ``chamfer_dist`` of lpiccinelli-eth/UniDepth 8d8cfe4, *F-score* of Knapitsch et al., *Tanks and
  Temples*, SIGGRAPH 2017. *Flying pixels* (Sabov and Krueger, SCCG 2008) lie between the front and the back of true
  depth discontinuities within 16 pixels along rows and columns, and more than 1 % of their depth from every true point.

Otherwise depth is neither capped nor cropped. Missing predictions are left out; the fractions ``covered`` stand beside
the means.
"""

from functools import partial

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from dsr.geometry.hole_size import window_maxima
from dsr.geometry.surface import normal_mask as mask_of_normals
from dsr.metrics.formats import Metric, MetricFormat, column, depth_mask, normal_mask, of_parts, target_mask
from dsr.metrics.functional import SurfacePair, angle, masked_mean, masked_median, once_per_pair

_DELTAS = {"delta_105": 1.05, "delta_110": 1.1, "delta_125": 1.25, "delta_125_2": 1.25**2, "delta_125_3": 1.25**3}
_WITHIN = {"within_5": 5, "within_7_5": 7.5, "within_11_25": 11.25, "within_22_5": 22.5, "within_30": 30}  # degrees
EDGE_RATIO = 1.05  # of the depths of two neighbours at a discontinuity, as in Depth Pro's contours
EDGE_RADIUS = 16  # pixels, as far as a low-resolution pixel reaches at x16
BORDER = 6  # pixels that many papers on depth super-resolution cut off before scoring
FLYING = 0.01  # distance of a flying pixel from every true point, as a fraction of its depth


@once_per_pair
def depth_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the errors of depth by name, (B,) each: means over the pixels with both depths, z and a true t."""
    z, t = pair.prediction, pair.target
    mean = partial(masked_mean, mask=pair.depth_mask)  # (B, 1)
    logs = z.log() - t.log()
    ratio = torch.maximum(z / t, 1 / (z / t))
    found = {
        "AbsRel": mean((z - t).abs() / t),
        "SqRel": mean((z - t).square() / t),  # metres; KITTI's ``sqErrorRel`` divides by t^2
        "RMSE": mean((z - t).square()).sqrt(),
        "MAE": mean((z - t).abs()),
        "RMSE_log": mean(logs.square()).sqrt(),
        "log10": mean((z.log10() - t.log10()).abs()),
        "SIlog": mean((logs - mean(logs)[..., None, None]).square()).sqrt(),  # the same for a factor of all depths
        "iRMSE": mean((1 / z - 1 / t).square()).sqrt(),
        "iMAE": mean((1 / z - 1 / t).abs()),
        **{name: mean(ratio < limit) for name, limit in _DELTAS.items()},
    }
    return {name: value.squeeze(1) for name, value in found.items()}


@once_per_pair
def field_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the errors of depth super-resolution by name, (B,) each, in the benchmark's unit and its limits."""
    z, t = pair.prediction, pair.target
    mean = partial(masked_mean, mask=pair.depth_mask)  # (B, 1)
    converted = pair.unit.convert(z)
    if pair.unit.limits is not None:
        converted = converted.clamp(*pair.unit.limits)
    error = (converted - pair.unit.convert(t)).abs()
    ratio = torch.maximum(z / t, 1 / (z / t))
    found = {
        f"RMSE_{pair.unit.name}": mean(error.square()).sqrt(),
        f"MAE_{pair.unit.name}": mean(error),
        "Beyond_5cm": mean((z - t).abs() > 0.05),
        "Beyond_delta1": mean(ratio > 1.25),
    }
    return {name: value.squeeze(1) for name, value in found.items()}


def rmse_inside(pair: SurfacePair) -> Tensor:
    """Return the RMSE of :func:`field_errors` without a border of ``BORDER`` pixels, (B,)."""
    inside = torch.zeros_like(pair.target_mask)
    inside[..., BORDER:-BORDER, BORDER:-BORDER] = True
    cut = pair.replaced(mask=inside if pair.mask is None else inside & pair.mask)
    return field_errors(cut)[f"RMSE_{pair.unit.name}"]


@once_per_pair
def normal_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the mean and median angle in degrees, the fractions below some angles, and the coverage, (B,) each."""
    angles, mask = angle(pair), pair.normal_mask
    found = {"mean": masked_mean(angles, mask), "median": masked_median(angles, mask)}
    for name, degrees in _WITHIN.items():
        found[name] = masked_mean(angles < degrees, mask)
    found["covered"] = masked_mean(mask, true_normal_mask(pair))
    return {name: value.flatten() for name, value in found.items()}


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the true depths that have a predicted one."""
    return masked_mean(pair.depth_mask, pair.target_mask).squeeze(1)


def true_normal_mask(pair: SurfacePair) -> Tensor:
    """Return the pixels with a true normal."""
    return mask_of_normals(pair.target_mask)


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
    """Return the exact distances of valid points from the nearest known one of a cloud, (B, 1, H, W), else 0."""
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


_fraction = partial(column, factor=1e2, higher_is_better=True)
_depth = {
    "AbsRel": column("AbsRel", "%", 1e2, 2),
    "SqRel": column("SqRel", "m", 1, 4),
    "RMSE": column("RMSE", "m", 1, 4),
    "MAE": column("MAE", "m", 1, 4),
    "RMSE_log": column("RMSElog", "", 1, 4),
    "log10": column("log10", "", 1, 4),
    "SIlog": column("SIlog", "x 100", 1e2, 2),
    "iRMSE": column("iRMSE", "1/km", 1e3, 2),
    "iMAE": column("iMAE", "1/km", 1e3, 2),
    "delta_105": _fraction("delta 1.05", "%", digits=2),
    "delta_110": _fraction("delta 1.10", "%", digits=2),
    "delta_125": _fraction("delta 1.25", "%", digits=2),
    "delta_125_2": _fraction("delta 1.25^2", "%", digits=2),
    "delta_125_3": _fraction("delta 1.25^3", "%", digits=2),
}
_normal = {
    "mean": column("Mean angle", "forward, deg", 1, 2),
    "median": column("Median angle", "forward, deg", 1, 2),
    **{name: _fraction(f"< {degrees:g} deg", "forward, %") for name, degrees in _WITHIN.items()},
}
_field = {
    "RMSE_cm": column("RMSE", "cm", digits=3),
    "MAE_cm": column("MAE", "cm", digits=3),
    "Beyond_5cm": column("Beyond", "5 cm, %", 1e2, 2),
    "Beyond_delta1": column("Beyond", "1.25 x, %", 1e2, 2),
}
_inside = MetricFormat("RMSE", f"without {BORDER} px", position=None)  # only in scores.csv
_border = partial(Metric, function=rmse_inside, mask=depth_mask, format=_inside, min_size=2 * BORDER + 1, whole=True)
_levels = {"RMSE_levels": column("RMSE", "levels", digits=3), "MAE_levels": column("MAE", "levels", digits=3)}
_covered = _fraction("Covered", "%")
_normals_covered = {"covered": _fraction("Covered", "normals, %")}
DEPTH = (
    *of_parts("Depth_", depth_errors, depth_mask, _depth, min_size=1, unit="cm"),
    Metric("Depth_covered", covered, target_mask, _covered, min_size=1, unit="cm", regional=True, whole=True),
)
FIELD = (
    *of_parts("", field_errors, depth_mask, _field, min_size=1, unit="cm"),
    *of_parts("", field_errors, depth_mask, _levels, min_size=1, unit="levels"),
    *(_border(f"RMSE_{unit}_border{BORDER}", unit=unit) for unit in ("cm", "levels")),
)
NORMALS = (
    *of_parts("Normal_", normal_errors, normal_mask, _normal),
    *of_parts("Normal_", normal_errors, true_normal_mask, _normals_covered, regional=True, whole=True),
)
_clouds = {
    "chamfer": column("Chamfer", "mm", 1e3, 2),
    "F_1cm": _fraction("F at 1 cm", "%", digits=2),
    "F_5cm": _fraction("F at 5 cm", "%", digits=2),
}
_points_covered = _fraction("Covered", "points, %")
_of_points = partial(of_parts, "Points_", point_errors, min_size=1, unit="cm", whole=True)
POINTS = (
    # not of regions: the outlines of a region's objects are edges of what lies outside
    *_of_points(depth_mask, {"flying": column("Flying", "1 % of depth, %", 1e2, 2)}, regional=False),
    *_of_points(target_mask, _clouds),
    Metric("Points_covered", covered, target_mask, _points_covered, min_size=1, unit="cm", whole=True),
)
