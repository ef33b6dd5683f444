"""The errors of depth and normals that other papers print, each a function from a pair to (B,).

- ``metrics=depth``: AbsRel, SqRel, RMSElog and the accuracies delta of Eigen et al., NIPS 2014 (``compute_errors`` of
  nianticlabs/monodepth2 b676244); SIlog, iRMSE and iMAE of KITTI (Uhrig et al., 3DV 2017, its development kit); log10
  of Make3D; the accuracies at 1.05 and 1.10 of Zhang and Funkhouser, CVPR 2018.
- ``metrics=field``: RMSE and MAE of depth super-resolution in centimetres (NYU, RGB-D-D) or in 8-bit levels
  (Middlebury, Lu), and the fractions of pixels off by more than 5 cm or by a ratio of more than 1.25.
- ``metrics=normals``: mean, median and fractions below five angles of Bae and Davison, CVPR 2024 (baegwangbin/DSINE
  ef0c2af), one value per image. Both normal maps are forward differences of depth; central differences have smaller
  angles for a noisy map, by a fifth and more.

Depth is orthogonal, in metres, neither capped nor cropped. Missing predictions are left out of every mean; the
fractions ``covered`` stand beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from dsr.geometry.surface import normal_mask as mask_of_normals
from dsr.metrics.formats import column
from dsr.metrics.functional import SurfacePair, angle, masked_mean, masked_median, once_per_pair
from dsr.metrics.metric import Metric, depth_mask, normal_mask, target_mask


def mean_depth(values: Tensor, pair: SurfacePair) -> Tensor:
    """Return the mean over the pixels with both depths, (B,)."""
    return masked_mean(values, pair.depth_mask).squeeze(1)


def abs_rel(pair: SurfacePair) -> Tensor:
    """Return the mean of |z - t| / t."""
    return mean_depth((pair.prediction - pair.target).abs() / pair.target, pair)


def sq_rel(pair: SurfacePair) -> Tensor:
    """Return the mean of (z - t)^2 / t in metres; KITTI's ``sqErrorRel`` divides by t^2."""
    return mean_depth((pair.prediction - pair.target).square() / pair.target, pair)


def rmse(pair: SurfacePair) -> Tensor:
    """Return the RMS error of orthogonal depth in metres."""
    return mean_depth((pair.prediction - pair.target).square(), pair).sqrt()


def mae(pair: SurfacePair) -> Tensor:
    """Return the mean absolute error of orthogonal depth in metres."""
    return mean_depth((pair.prediction - pair.target).abs(), pair)


def rmse_log(pair: SurfacePair) -> Tensor:
    """Return the RMS of ln z - ln t."""
    return mean_depth((pair.prediction.log() - pair.target.log()).square(), pair).sqrt()


def log10(pair: SurfacePair) -> Tensor:
    """Return the mean of |log10 z - log10 t|."""
    return mean_depth((pair.prediction.log10() - pair.target.log10()).abs(), pair)


def silog(pair: SurfacePair) -> Tensor:
    """Return the standard deviation of ln z - ln t, which a factor of all depths does not change."""
    difference = pair.prediction.log() - pair.target.log()
    return mean_depth((difference - mean_depth(difference, pair)[:, None, None, None]).square(), pair).sqrt()


def irmse(pair: SurfacePair) -> Tensor:
    """Return the RMS of 1 / z - 1 / t in 1 / m."""
    return mean_depth((1 / pair.prediction - 1 / pair.target).square(), pair).sqrt()


def imae(pair: SurfacePair) -> Tensor:
    """Return the mean of |1 / z - 1 / t| in 1 / m."""
    return mean_depth((1 / pair.prediction - 1 / pair.target).abs(), pair)


def larger_ratio(pair: SurfacePair) -> Tensor:
    """Return max(z / t, t / z), (B, 1, H, W); meaningful where both depths are known."""
    quotient = pair.prediction / pair.target
    return torch.maximum(quotient, 1 / quotient)


def within_ratio(pair: SurfacePair, ratio: float) -> Tensor:
    """Return the accuracy delta, the fraction with max(z / t, t / z) < ratio."""
    return mean_depth(larger_ratio(pair) < ratio, pair)


def beyond_ratio(pair: SurfacePair, ratio: float) -> Tensor:
    """Return the fraction with max(z / t, t / z) > ratio."""
    return mean_depth(larger_ratio(pair) > ratio, pair)


def beyond(pair: SurfacePair, distance: float) -> Tensor:
    """Return the fraction of pixels with an error of more than ``distance`` metres."""
    return mean_depth((pair.prediction - pair.target).abs() > distance, pair)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the true depths that have a predicted one."""
    return masked_mean(pair.depth_mask, pair.target_mask).squeeze(1)


@once_per_pair
def unit_error(pair: SurfacePair) -> Tensor:
    """Return the absolute error in the benchmark's unit, (B, 1, H, W), clamped to its limits as 8-bit levels are."""
    prediction = pair.unit.convert(pair.prediction)
    if pair.unit.limits is not None:
        prediction = prediction.clamp(*pair.unit.limits)
    return (prediction - pair.unit.convert(pair.target)).abs()


def unit_rmse(pair: SurfacePair) -> Tensor:
    """Return the RMS error in the benchmark's unit."""
    return mean_depth(unit_error(pair).square(), pair).sqrt()


def unit_mae(pair: SurfacePair) -> Tensor:
    """Return the mean absolute error in the benchmark's unit."""
    return mean_depth(unit_error(pair), pair)


def angle_mean(pair: SurfacePair) -> Tensor:
    """Return the mean angle between the normals in degrees."""
    return masked_mean(angle(pair), pair.normal_mask).squeeze(1)


def angle_median(pair: SurfacePair) -> Tensor:
    """Return the median angle between the normals in degrees, of an even number the mean of the middle two."""
    return masked_median(angle(pair), pair.normal_mask).flatten()


def angle_within(pair: SurfacePair, degrees: float) -> Tensor:
    """Return the fraction of normals that are less than ``degrees`` off."""
    return masked_mean(angle(pair) < degrees, pair.normal_mask).squeeze(1)


def true_normal_mask(pair: SurfacePair) -> Tensor:
    """Return the pixels with a true normal."""
    return mask_of_normals(pair.target_mask)


def normals_covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the true normals that have a predicted one."""
    return masked_mean(pair.normal_mask, true_normal_mask(pair)).squeeze(1)


_ERRORS: dict[str, tuple[Callable[[SurfacePair], Tensor], str, str, float, int]] = {  # heading, unit, factor, digits
    "AbsRel": (abs_rel, "AbsRel", "%", 1e2, 2),
    "SqRel": (sq_rel, "SqRel", "m", 1, 4),
    "RMSE": (rmse, "RMSE", "m", 1, 4),
    "MAE": (mae, "MAE", "m", 1, 4),
    "RMSE_log": (rmse_log, "RMSElog", "", 1, 4),
    "log10": (log10, "log10", "", 1, 4),
    "SIlog": (silog, "SIlog", "x 100", 1e2, 2),
    "iRMSE": (irmse, "iRMSE", "1/km", 1e3, 2),
    "iMAE": (imae, "iMAE", "1/km", 1e3, 2),
}
_DELTAS = {
    "105": ("1.05", 1.05),
    "110": ("1.10", 1.1),
    "125": ("1.25", 1.25),
    "125_2": ("1.25^2", 1.25**2),
    "125_3": ("1.25^3", 1.25**3),
}
DEPTH = (
    *(
        Metric(f"Depth_{name}", function, depth_mask, column(heading, unit, factor, digits), min_size=1, unit="cm")
        for name, (function, heading, unit, factor, digits) in _ERRORS.items()
    ),
    *(
        Metric(
            f"Depth_delta_{name}",
            partial(within_ratio, ratio=ratio),
            depth_mask,
            column(f"delta {shown}", "%", 1e2, 2, higher_is_better=True),
            min_size=1,
            unit="cm",
        )
        for name, (shown, ratio) in _DELTAS.items()
    ),
    Metric(
        "Depth_covered",
        covered,
        target_mask,
        column("Covered", "%", 1e2, higher_is_better=True),
        min_size=1,
        unit="cm",
        regional=True,
        whole=True,
    ),
)


def _in_unit(unit: str) -> list[Metric]:
    return [
        Metric(f"{name}_{unit}", function, depth_mask, column(name, unit, digits=3), min_size=1, unit=unit)
        for name, function in (("RMSE", unit_rmse), ("MAE", unit_mae))
    ]


_BEYOND = {
    "Beyond_5cm": (partial(beyond, distance=0.05), "5 cm, %"),
    "Beyond_delta1": (partial(beyond_ratio, ratio=1.25), "1.25 x, %"),
}
FIELD = (
    *_in_unit("cm"),
    *(
        Metric(name, function, depth_mask, column("Beyond", unit, 1e2, 2), min_size=1, unit="cm")
        for name, (function, unit) in _BEYOND.items()
    ),
    *_in_unit("levels"),
)

NORMALS = (
    Metric("Normal_mean", angle_mean, normal_mask, column("Mean angle", "forward, deg", 1, 2)),
    Metric("Normal_median", angle_median, normal_mask, column("Median angle", "forward, deg", 1, 2)),
    *(
        Metric(
            f"Normal_within_{degrees:g}".replace(".", "_"),
            partial(angle_within, degrees=degrees),
            normal_mask,
            column(f"< {degrees:g} deg", "forward, %", 1e2, higher_is_better=True),
        )
        for degrees in (5, 7.5, 11.25, 22.5, 30)
    ),
    Metric(
        "Normal_covered",
        normals_covered,
        true_normal_mask,
        column("Covered", "normals, %", 1e2, higher_is_better=True),
        regional=True,
        whole=True,
    ),
)
