"""Estimates of the noise of a low-resolution depth map and of its normals."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera

_FRACTION, _QUANTILE = 0.1, 0.12566
"""A tenth of a normal variable's absolute values are below this many standard deviations."""


def estimate_noise(depth_lr: Tensor) -> float:
    """Return the standard deviation of a depth map's relative noise, estimated from the map alone.

    Immerkaer, *Fast Noise Variance Estimation*, CVIU 1996: the difference of two Laplacians, which is 0 on planes and
    on straight edges; here of the logarithm of depth, with the 10th percentile instead of the mean: noise is
    everywhere, while steps and curves of the surface are not.

    Args:
        depth_lr: (1, 1, h, w) in metres, NaN in holes.

    Returns:
        Standard deviation of relative depth; 0 without a valid 3 x 3 window.

    """
    if min(depth_lr.shape[-2:]) < 3:
        return 0.0
    row = torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64, device=depth_lr.device)
    responses = functional.conv2d(depth_lr.double().log(), torch.outer(row, row)[None, None]).abs()
    valid = responses[responses.isfinite()]
    if not len(valid):
        return 0.0
    return float(valid.kthvalue(max(round(_FRACTION * len(valid)), 1)).values) / _QUANTILE / 6


def normal_noise_deg(noise: float, camera: Camera) -> float:
    """Return the standard deviation, in degrees, by which relative depth noise tilts the normals of a frontal surface.

    Two neighbouring pixels at depth z are z / f metres apart; noise of standard deviation s z in each makes a slope of
    standard deviation sqrt(2) s f.

    Args:
        noise: relative standard deviation of depth, s.
        camera: of the low-resolution map.

    """
    return math.degrees(math.atan(math.sqrt(2) * noise * camera.fx))
