"""Metrics of refined depth maps of real sensors, against a ground truth that is also measured.

Neither map is perfect: the sensor has a constant bias, which is not shape, the truth ends at ragged borders, and a few
pixels of either belong to another surface. Therefore the scored pixels are those at least four pixels away from unknown
truth, and two away from unknown predictions and from those more than 0.1 m off; distances are counted along rows and
columns. The median difference over them is subtracted from the prediction, and normals and renderings are compared as
in the paper's metrics, with unknown pixels replaced by the truth's median depth. A method must not look better for
leaving out what is difficult, so the fraction of scored pixels, ``Sensor_covered``, belongs to every score.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from dsr.metrics import functional
from dsr.metrics.formats import Metric, column, of_parts
from dsr.metrics.functional import SSIM_WINDOW, SurfacePair, angle, masked_mean, masked_median, once_per_pair

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


compare = once_per_pair(SensorComparison)


def erode(mask: Tensor, steps: int) -> Tensor:
    """Return a mask (B, 1, H, W) without the pixels within ``steps`` of an unset one, or of the border."""
    for _ in range(steps):
        padded = torch.nn.functional.pad(mask, (1, 1, 1, 1))
        along_u = padded[..., 1:-1, 2:] & padded[..., 1:-1, :-2]
        mask = mask & along_u & padded[..., 2:, 1:-1] & padded[..., :-2, 1:-1]
    return mask


@once_per_pair
def sensor_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the scores without lights by name, (B,) each, over the scored pixels: metres and degrees."""
    comparison = compare(pair)
    surfaces, scored = comparison.surfaces, comparison.scored
    first, second = surfaces.normals
    angles = angle(surfaces)
    found = {
        "RMSE_v": masked_mean((first - second).square().mean(dim=1, keepdim=True), scored).sqrt(),
        "angle_mean": masked_mean(angles, scored),
        "angle_median": masked_median(angles, scored),
        "covered": masked_mean(scored, comparison.inner),
        "offset": comparison.offset.abs(),
        "RMSE_d": masked_mean((surfaces.prediction - surfaces.target).square(), scored).sqrt(),
    }
    return {name: value.flatten() for name, value in found.items()}


def dssim_v(pair: SurfacePair) -> Tensor:
    """Return DSSIM_v over the scored pixels per light, (B, 4), see :func:`dsr.metrics.functional.dssim_v`."""
    border = SSIM_WINDOW // 2  # no scored pixel is so close to it
    return functional.dssim_v(compare(pair).surfaces, compare(pair).scored[..., border:-border, border:-border])


def _inner(pair: SurfacePair) -> Tensor:
    return compare(pair).inner


def _scored(pair: SurfacePair) -> Tensor:
    return compare(pair).scored


_errors = partial(of_parts, "Sensor_", sensor_errors, whole=True)
_angles = {"angle_mean": column("Angle", "mean, deg"), "angle_median": column("Angle", "median, deg")}
_offsets = {"offset": column("Offset", "mm", 1e3, 2), "RMSE_d": column("RMSE_d", "sensor, mm", 1e3, 2)}
_dssim = column("DSSIM_v", "sensor, 1/1000", 1e3, 0)
METRICS: tuple[Metric, ...] = (
    *_errors(_scored, {"RMSE_v": column("RMSE_v", "sensor, 1/1000", 1e3, 0)}),
    Metric("Sensor_DSSIM_v", dssim_v, _scored, _dssim, per_light=True, min_size=SSIM_WINDOW, whole=True),
    *_errors(_scored, _angles),
    *_errors(_inner, {"covered": column("Covered", "%", 1e2, higher_is_better=True)}),
    *_errors(_scored, _offsets),
)  # the metrics of metrics=sensor
