"""The errors of depth that papers on depth estimation and completion print, over all pixels with both depths.

Relative errors, logarithms and accuracies are those of Eigen et al., *Depth Map Prediction from a Single Image using a
Multi-Scale Deep Network*, NIPS 2014, as ``compute_errors`` in ``evaluate_depth.py`` of nianticlabs/monodepth2 (b676244)
has them; ``log10`` is Make3D's (Saxena et al. 2009). SIlog and errors of the inverse depth are those of KITTI's
benchmarks (Uhrig et al., *Sparsity Invariant CNNs*, 3DV 2017), ``cpp/evaluate_depth.cpp`` of its development kit, a
copy of which is ``kitti_dc_devkit`` in ShreyasSkandanS/DFuseNet (a19c448). The accuracies at 1.05 and 1.10 are those of
Zhang and Funkhouser, *Deep Depth Completion of a Single RGB-D Image*, CVPR 2018.

Depth is orthogonal depth in metres, so that benchmarks in levels have none of these. RMSE and MAE are those of
``metrics=field``, in metres. No depth is capped and no border is cropped; codes for KITTI do both, for its laser. A
missing prediction is left out of every mean, while KITTI's code interpolates it beforehand: ``Depth_covered`` stands
beside them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from dsr.metrics import field
from dsr.metrics.formats import BEFORE_THE_PAPER, MetricFormat
from dsr.metrics.functional import SurfacePair, masked_mean
from dsr.metrics.metric import Metric, depth_mask, target_mask


def abs_rel(pair: SurfacePair) -> Tensor:
    """Return the mean of |z - t| / t, (B,); lower is better.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.functional import SurfacePair
        >>> from dsr.metrics.depth import abs_rel
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth = torch.full((1, 1, 24, 32), 2.0)
        >>> abs_rel(SurfacePair(1.02 * truth, truth, camera.rays()[None])).round(decimals=4)
        tensor([0.0200])

    """
    return masked_mean((pair.prediction - pair.target).abs() / pair.target, pair.depth_mask).squeeze(1)


def sq_rel(pair: SurfacePair) -> Tensor:
    """Return the mean of (z - t)^2 / t in metres, (B,); lower is better.

    That of Eigen et al.; KITTI's ``sqErrorRel`` is the mean of (z - t)^2 / t^2 in percent.
    """
    return masked_mean((pair.prediction - pair.target).square() / pair.target, pair.depth_mask).squeeze(1)


def within_ratio(pair: SurfacePair, ratio: float) -> Tensor:
    """Return the fraction of pixels where the larger depth is less than ``ratio`` times the smaller one, (B,).

    The accuracy delta of Eigen et al.; higher is better.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.functional import SurfacePair
        >>> from dsr.metrics.depth import within_ratio
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth = torch.full((1, 1, 24, 32), 2.0)
        >>> within_ratio(SurfacePair(1.02 * truth, truth, camera.rays()[None]), 1.05)
        tensor([1.], dtype=torch.float64)

    """
    return masked_mean(field.larger_ratio(pair) < ratio, pair.depth_mask).squeeze(1)


def log10(pair: SurfacePair) -> Tensor:
    """Return the mean of |log10 z - log10 t|, (B,); lower is better."""
    return masked_mean((pair.prediction.log10() - pair.target.log10()).abs(), pair.depth_mask).squeeze(1)


def rmse_log(pair: SurfacePair) -> Tensor:
    """Return the RMS of ln z - ln t, (B,); lower is better."""
    return masked_mean(_log_difference(pair).square(), pair.depth_mask).sqrt().squeeze(1)


def silog(pair: SurfacePair) -> Tensor:
    """Return the standard deviation of ln z - ln t, (B,), which a factor of all depths does not change.

    Lower is better. KITTI prints 100 times as much, and so do tables here.
    """
    difference = _log_difference(pair)
    mean = masked_mean(difference, pair.depth_mask)[..., None, None]
    return masked_mean((difference - mean).square(), pair.depth_mask).sqrt().squeeze(1)


def rmse(pair: SurfacePair) -> Tensor:
    """Return the RMS error of orthogonal depth in metres, (B,); lower is better."""
    return field.root_mean_square(pair.prediction - pair.target, pair)


def mae(pair: SurfacePair) -> Tensor:
    """Return the mean absolute error of orthogonal depth in metres, (B,); lower is better."""
    return field.mean_absolute(pair.prediction - pair.target, pair)


def irmse(pair: SurfacePair) -> Tensor:
    """Return the RMS of 1 / z - 1 / t in 1 / m, (B,); lower is better. Tables have it in 1 / km, as KITTI's."""
    return field.root_mean_square(1 / pair.prediction - 1 / pair.target, pair)


def imae(pair: SurfacePair) -> Tensor:
    """Return the mean of |1 / z - 1 / t| in 1 / m, (B,); lower is better. Tables have it in 1 / km."""
    return field.mean_absolute(1 / pair.prediction - 1 / pair.target, pair)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the pixels with a true depth that have a predicted one, (B,); higher is better."""
    return masked_mean(pair.depth_mask, pair.target_mask).squeeze(1)


def _log_difference(pair: SurfacePair) -> Tensor:
    return pair.prediction.log() - pair.target.log()


def _metric(
    name: str, function: Callable[[SurfacePair], Tensor], unit: str, factor: float, digits: int, heading: str = ""
) -> Metric:
    shown = MetricFormat(heading or name, unit, factor, digits, position=BEFORE_THE_PAPER)
    return Metric(f"Depth_{name}", function, depth_mask, shown, min_size=1, unit="cm")


def _within(name: str, ratio: float, shown: str) -> Metric:
    form = MetricFormat(f"delta {shown}", "%", 1e2, 2, higher_is_better=True, position=BEFORE_THE_PAPER)
    return Metric(f"Depth_delta_{name}", partial(within_ratio, ratio=ratio), depth_mask, form, min_size=1, unit="cm")


METRICS: tuple[Metric, ...] = (
    _metric("AbsRel", abs_rel, "%", 1e2, 2),
    _metric("SqRel", sq_rel, "m", 1, 4),
    _metric("RMSE", rmse, "m", 1, 4),
    _metric("MAE", mae, "m", 1, 4),
    _metric("RMSE_log", rmse_log, "", 1, 4, "RMSElog"),
    _metric("log10", log10, "", 1, 4),
    _metric("SIlog", silog, "x 100", 1e2, 2),
    _metric("iRMSE", irmse, "1/km", 1e3, 2),
    _metric("iMAE", imae, "1/km", 1e3, 2),
    _within("105", 1.05, "1.05"),
    _within("110", 1.10, "1.10"),
    _within("125", 1.25, "1.25"),
    _within("125_2", 1.25**2, "1.25^2"),
    _within("125_3", 1.25**3, "1.25^3"),
    Metric(
        "Depth_covered",
        covered,
        target_mask,
        MetricFormat("Covered", "%", 1e2, 1, higher_is_better=True, position=BEFORE_THE_PAPER),
        min_size=1,
        unit="cm",
        regional=True,
        whole=True,
    ),
)
"""The metrics of ``metrics=depth``."""
