"""The metrics that papers on depth super-resolution print.

Errors are in the benchmark's unit, see :class:`dsr.sample.Unit`: RMSE in centimetres of depth for NYU and RGB-D-D (Kim
et al., *Deformable Kernel Networks for Joint Image Filtering*, IJCV 2021; He et al., *Towards Fast and Accurate
Real-World Depth Super-Resolution*, CVPR 2021) and in 8-bit levels of disparity for Middlebury and Lu, and the mean
absolute error (Lin et al., *Prompting Depth Anything for 4K Resolution Accurate Metric Depth Estimation*, CVPR 2025).
The fraction of pixels that are off by more than 5 cm is the bad-pixel rate of Scharstein and Szeliski (IJCV 2002); the
fraction with a ratio to the true depth of more than 1.25 is 1 less the accuracy delta_1 of Eigen et al. (NIPS 2014).
Both need metres and are left out for benchmarks in levels. Depth is orthogonal depth, while RMSE_d and BadPix_d of
Voynov et al. are of perspective depth.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from dsr.metrics.formats import BEFORE_THE_PAPER, MetricFormat
from dsr.metrics.functional import SurfacePair, masked_mean
from dsr.metrics.metric import Metric, depth_mask


def unit_error(pair: SurfacePair) -> Tensor:
    """Return the absolute error in the benchmark's unit, (B, 1, H, W); 0 where invalid.

    The prediction is clamped to the unit's limits first, as benchmarks in 8-bit levels do.
    """
    prediction, target = pair.unit.convert(pair.prediction), pair.unit.convert(pair.target)
    if pair.unit.limits is not None:
        prediction = prediction.clamp(*pair.unit.limits)
    return torch.where(pair.depth_mask, (prediction - target).abs(), 0)


def rmse(pair: SurfacePair) -> Tensor:
    """Return the RMS error in the benchmark's unit, (B,)."""
    return root_mean_square(pair.derive(unit_error), pair)


def mae(pair: SurfacePair) -> Tensor:
    """Return the mean absolute error in the benchmark's unit, (B,)."""
    return mean_absolute(pair.derive(unit_error), pair)


def root_mean_square(error: Tensor, pair: SurfacePair) -> Tensor:
    """Return the RMS of an error, (B, 1, H, W), over the pixels with both depths, (B,)."""
    return masked_mean(error.square(), pair.depth_mask).sqrt().squeeze(1)


def mean_absolute(error: Tensor, pair: SurfacePair) -> Tensor:
    """Return the mean of the absolute value of an error, (B, 1, H, W), over the pixels with both depths, (B,)."""
    return masked_mean(error.abs(), pair.depth_mask).squeeze(1)


def beyond(pair: SurfacePair, distance: float) -> Tensor:
    """Return the fraction of pixels with an error of more than ``distance`` metres, (B,)."""
    return masked_mean((pair.prediction - pair.target).abs() > distance, pair.depth_mask).squeeze(1)


def beyond_ratio(pair: SurfacePair, ratio: float) -> Tensor:
    """Return the fraction of pixels where the larger depth is more than ``ratio`` times the smaller one, (B,)."""
    return masked_mean(larger_ratio(pair) > ratio, pair.depth_mask).squeeze(1)


def larger_ratio(pair: SurfacePair) -> Tensor:
    """Return the larger of the two depths over the smaller one, (B, 1, H, W); meaningful where both are."""
    return pair.derive(_larger_ratio)


def _larger_ratio(pair: SurfacePair) -> Tensor:
    quotient = pair.prediction / pair.target
    return torch.maximum(quotient, 1 / quotient)


def _in_unit(unit: str) -> tuple[Metric, Metric]:
    """Return RMSE and MAE for the benchmarks in a unit."""
    rmse_format, mae_format = (MetricFormat(name, unit, position=BEFORE_THE_PAPER) for name in ("RMSE", "MAE"))
    return (
        Metric(f"RMSE_{unit}", rmse, depth_mask, rmse_format, min_size=1, unit=unit),
        Metric(f"MAE_{unit}", mae, depth_mask, mae_format, min_size=1, unit=unit),
    )


def _fraction(name: str, function: partial[Tensor], unit: str) -> Metric:
    shown = MetricFormat("Beyond", unit, 1e2, 2, position=BEFORE_THE_PAPER)
    return Metric(name, function, depth_mask, shown, min_size=1, unit="cm")


METRICS: tuple[Metric, ...] = (
    *_in_unit("cm"),
    _fraction("Beyond_5cm", partial(beyond, distance=0.05), "5 cm, %"),
    _fraction("Beyond_delta1", partial(beyond_ratio, ratio=1.25), "1.25 x, %"),
    *_in_unit("levels"),
)
"""The metrics of ``metrics=field``, those for each unit."""
