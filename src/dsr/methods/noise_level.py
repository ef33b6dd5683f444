"""Estimates of the noise of a low-resolution depth map and of its normals."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera

_FRACTION, _QUANTILE = 0.1, 0.12566  # a tenth of a normal variable's absolute values are below so many deviations
_QUARTER, _QUARTILE = 0.25, 0.31864  # a quarter of them are below so many
_STRIDES = (1, 2)  # distances of compared pixels: noise that neighbours share shows at a distance of two pixels


def estimate_noise(depth_lr: Tensor) -> float:
    """Return the standard deviation of a depth map's relative noise, estimated from the map alone.

    Immerkaer, *Fast Noise Variance Estimation*, CVIU 1996: the difference of two Laplacians, which is 0 on planes and
    on straight edges; here of the logarithm of depth, with the 10th percentile instead of the mean: noise is
    everywhere, while steps and curves of the surface are not.

    ``depth_lr`` is (1, 1, h, w) in metres, NaN in holes; the result is 0 without a valid 3 x 3 window.
    """
    return _low_quantile(depth_lr.double().log(), 1, _FRACTION) / _QUANTILE / 6


def estimate_sensor_noise(values: Tensor) -> float:
    """Return the standard deviation of a map's noise, also where a sensor rounds its values or neighbours share noise.

    As :func:`estimate_noise`, with two differences: a quarter of the responses instead of a tenth, because rounding
    makes many of them 0, and the larger of the estimates from neighbouring pixels and from every second one, because
    the first misses noise that is correlated between neighbours.

    ``values`` (1, 1, h, w), NaN in holes, are in a unit in which planes are linear and noise is alike everywhere, such
    as disparity; the result is in it, and 0 without a valid window.
    """
    return max(_low_quantile(values.double(), stride, _QUARTER) for stride in _STRIDES) / _QUARTILE / 6


def _low_quantile(values: Tensor, stride: int, fraction: float) -> float:
    """Return a quantile of the absolute differences of two Laplacians of a map, whose taps are ``stride`` apart."""
    if min(values.shape[-2:]) < 2 * stride + 1:
        return 0.0
    row = torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64, device=values.device)
    responses = functional.conv2d(values, torch.outer(row, row)[None, None], dilation=stride).abs()
    valid = responses[responses.isfinite()]
    if not len(valid):
        return 0.0
    return float(valid.kthvalue(max(round(fraction * len(valid)), 1)).values)


def normal_noise_deg(noise: float, camera: Camera) -> float:
    """Return the standard deviation, in degrees, by which relative depth noise tilts the normals of a frontal surface.

    Two neighbouring pixels at depth z are z / f metres apart; noise of standard deviation s z in each makes a slope of
    standard deviation sqrt(2) s f, for the low-resolution map's camera.
    """
    return math.degrees(math.atan(math.sqrt(2) * noise * camera.fx))
