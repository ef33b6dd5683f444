"""Metrics of refined depth maps of real sensors, against a ground truth that is also measured.

Neither map is perfect: the sensor has a constant bias, which is not shape, the truth ends at ragged borders, and a few
pixels of either belong to another surface. Therefore the scored pixels are those at least four pixels away from unknown
truth, and two away from unknown predictions and from those more than 0.1 m off; distances are counted along rows and
columns. The median difference over them is subtracted from the prediction, and normals and renderings are compared as
in the paper's metrics, with unknown pixels replaced by the truth's median depth. A method must not look better for
leaving out what is difficult, so the fraction of scored pixels, ``Sensor_covered``, belongs to every score.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.metrics.formats import column
from dsr.metrics.functional import SSIM_WINDOW, SurfacePair, angle, masked_mean, masked_median, once_per_pair, ssim_map
from dsr.metrics.metric import Metric

TRUTH_EROSION = 3
PREDICTION_EROSION = 1
LARGEST_ERROR = 0.1  # metres; a prediction further off is another surface, not a shape of this one


class SensorComparison:
    """What the metrics derive from a pair of the refined map and the truth.

    ``inner`` are the pixels that a prediction should cover and ``scored`` those that it covers, (B, 1, H, W) bool;
    ``offset`` is the median of prediction - truth over the scored pixels in metres, (B, 1, 1, 1); ``surfaces`` are the
    prediction less the offset, and the truth, without unknown pixels.
    """

    def __init__(self, pair: SurfacePair) -> None:
        prediction, target = pair.given
        known = prediction.isfinite() & (prediction > 0)
        near = pair.target_mask & known & ((prediction - target).abs() < LARGEST_ERROR)
        self.inner = erode(pair.target_mask, TRUTH_EROSION)
        self.scored = self.inner & erode(near, PREDICTION_EROSION)
        self.offset = masked_median(prediction - target, self.scored)
        filler = masked_median(target, pair.target_mask)
        self.surfaces = SurfacePair(
            torch.where(known, prediction - self.offset, filler),
            torch.where(pair.target_mask, target, filler),
            pair.rays,
            image_dtype=pair.image_dtype,
        )


@once_per_pair
def compare(pair: SurfacePair) -> SensorComparison:
    """Return the comparison of a pair."""
    return SensorComparison(pair)


def erode(mask: Tensor, steps: int) -> Tensor:
    """Return a mask (B, 1, H, W) without the pixels within ``steps`` of an unset one along rows and columns.

    Pixels outside count as unset.
    """
    for _ in range(steps):
        padded = torch.nn.functional.pad(mask, (1, 1, 1, 1))
        along_u = padded[..., 1:-1, 2:] & padded[..., 1:-1, :-2]
        mask = mask & along_u & padded[..., 2:, 1:-1] & padded[..., :-2, 1:-1]
    return mask


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the inner pixels that are scored, (B,)."""
    comparison = compare(pair)
    return masked_mean(comparison.scored, comparison.inner).squeeze(1)


def offset_d(pair: SurfacePair) -> Tensor:
    """Return the absolute value of the offset in metres, (B,)."""
    return compare(pair).offset.abs().flatten()


def rmse_d(pair: SurfacePair) -> Tensor:
    """Return the RMS difference of orthogonal depth in metres after the offset's removal, (B,)."""
    comparison = compare(pair)
    difference = comparison.surfaces.prediction - comparison.surfaces.target
    return masked_mean(difference.square(), comparison.scored).sqrt().squeeze(1)


def rmse_v(pair: SurfacePair) -> Tensor:
    """Return RMSE_v over the scored pixels, (B,), see :func:`dsr.metrics.functional.rmse_v`."""
    comparison = compare(pair)
    first, second = comparison.surfaces.normals
    squares = (first - second).square().mean(dim=1, keepdim=True)
    return masked_mean(squares, comparison.scored).sqrt().squeeze(1)


def dssim_v(pair: SurfacePair) -> Tensor:
    """Return DSSIM_v over the scored pixels per light, (B, 4), see :func:`dsr.metrics.functional.dssim_v`."""
    comparison = compare(pair)
    border = SSIM_WINDOW // 2  # no scored pixel is so close to it
    scored = comparison.scored[..., border:-border, border:-border]
    lights = zip(*(maps.unbind(1) for maps in comparison.surfaces.renderings), strict=True)
    return torch.cat([1 - masked_mean(ssim_map(x, y)[:, None], scored) for x, y in lights], dim=1)


def angle_mean(pair: SurfacePair) -> Tensor:
    """Return the mean angle between the normals over the scored pixels, (B,) in degrees."""
    comparison = compare(pair)
    return masked_mean(angle(comparison.surfaces), comparison.scored).squeeze(1)


def angle_median(pair: SurfacePair) -> Tensor:
    """Return the median angle between the normals over the scored pixels, (B,) in degrees."""
    comparison = compare(pair)
    return masked_median(angle(comparison.surfaces), comparison.scored).flatten()


def _inner(pair: SurfacePair) -> Tensor:
    return compare(pair).inner


def _scored(pair: SurfacePair) -> Tensor:
    return compare(pair).scored


METRICS: tuple[Metric, ...] = (
    Metric("Sensor_RMSE_v", rmse_v, _scored, column("RMSE_v", "sensor, 1/1000", 1e3, 0), whole=True),
    Metric(
        "Sensor_DSSIM_v",
        dssim_v,
        _scored,
        column("DSSIM_v", "sensor, 1/1000", 1e3, 0),
        per_light=True,
        min_size=SSIM_WINDOW,
        whole=True,
    ),
    Metric("Sensor_angle_mean", angle_mean, _scored, column("Angle", "mean, deg", 1, 1), whole=True),
    Metric("Sensor_angle_median", angle_median, _scored, column("Angle", "median, deg", 1, 1), whole=True),
    Metric("Sensor_covered", covered, _inner, column("Covered", "%", 1e2, 1, higher_is_better=True), whole=True),
    Metric("Sensor_offset", offset_d, _scored, column("Offset", "mm", 1e3, 2), whole=True),
    Metric("Sensor_RMSE_d", rmse_d, _scored, column("RMSE_d", "sensor, mm", 1e3, 2), whole=True),
)  # the metrics of metrics=sensor
