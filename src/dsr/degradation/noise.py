"""Noise of low-resolution depth maps: multiplicative, and that of two kinds of sensors.

A noise model states the range type that it acts on, and maps low-resolution values of that type to noisy ones; see
:func:`dsr.degradation.downsampling.make_sample`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import RangeType


class Noise(Protocol):
    """A noise model: from (..., h, w) values of ``range_type`` (None for the one that is averaged) to noisy ones.

    NaN stays NaN, and what the sensor would not see becomes NaN. Random numbers are drawn on the CPU in float64, so
    they are the same on every device.
    """

    range_type: ClassVar[RangeType | None]

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return noisy values."""


@dataclass(frozen=True)
class GaussianMultiplicative:
    """Multiplicative noise: values times 1 + std N(0, 1), in the range type that is averaged (Voynov et al. 2019).

    Args:
        std: standard deviation of the factor.

    """

    range_type: ClassVar[RangeType | None] = None
    std: float

    def __post_init__(self) -> None:
        """Check the value."""
        if not 0 < self.std < 1:
            raise ValueError(f"std: expected a number above 0 and below 1, got {self.std}")

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return noisy values; NaN stays NaN."""
        draws = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        return values * (1 + self.std * draws).to(values)


@dataclass(frozen=True)
class TimeOfFlight:
    """Noise that grows with the third power of depth, after Riegler et al., *ATGV-Net*, ECCV 2016.

    They model a time-of-flight camera on Middlebury's disparities v by adding N(0, (strength / v)^2) with a strength of
    651; their published code takes strength / v as the standard deviation, v in pixels of the full-size photos. Here

        v = stereo_constant / z - doffs,

    which to first order makes the depth's standard deviation strength z^3 / stereo_constant^2 for ``doffs`` = 0. With
    the defaults it is 1.8 mm at 1 m, 15 mm at 2 m, 49 mm at 3 m, 116 mm at 4 m. It suits rooms: from about 10 m on, the
    tail of the distribution reaches infinity.

    Their v lacks the pixels by which Middlebury's views of 2005 were shifted (``dmin.txt``), so it is smaller, and
    their noise larger, than that of the defaults at the same depth. To apply their model to such a scene, set ``doffs``
    to that shift.

    The noisy Middlebury inputs that are often used with this model, after Park et al., ICCV 2011, do not follow it:
    they have white noise of five levels everywhere (docs/data.md).

    Args:
        strength: the product of v and its standard deviation, in square pixels.
        stereo_constant: baseline times focal length in metre pixels; 0.16 m x 3740 px for Middlebury 2005 and 2006.
        doffs: offset that the map's disparities lack, in pixels.

    """

    range_type: ClassVar[RangeType | None] = "orthogonal"
    strength: float = 651.0
    stereo_constant: float = 598.4
    doffs: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        _check_positive(self, "strength", "stereo_constant")
        if not 0 <= self.doffs < math.inf:
            raise ValueError(f"doffs: expected 0 or a positive number, got {self.doffs}")

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return noisy depth in metres, NaN in holes and where v is not positive, before or after the noise."""
        draws = torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values.device)
        clean = _positive(self.stereo_constant / values.double() - self.doffs)
        noisy = _positive(clean + self.strength / clean * draws)
        return (self.stereo_constant / (noisy + self.doffs)).to(values.dtype)


@dataclass(frozen=True)
class Kinect:
    """A structured-light sensor: disparity noise and quantisation, dropouts beside depth edges, limits of range.

    The sensor counts disparity d = stereo_constant / z in eighths of a pixel (Khoshelham and Oude Elberink, *Accuracy
    and Resolution of Kinect Depth Data*, Sensors 2012), so depth comes in steps of step z^2 / stereo_constant: 3 mm at
    1 m, 11 mm at 2 m, 72 mm at 5 m. Their random error is 1.425e-3 z^2 m, half a step. It includes the rounding error,
    step / sqrt(12). So N(0, std^2) with the default ``std`` of 0.05 px and rounding together give 1.42e-3 z^2 m: 1.4 mm
    at 1 m, 6 mm at 2 m, 35 mm at 5 m. Nguyen, Izadi and Lovell (3DIMPVT 2012) measured 0.0012 + 0.0019 (z - 0.4)^2 m
    on surfaces that face the sensor: 1.9, 6 and 41 mm. The noise of neighbouring pixels is independent here; that of a
    sensor, which matches windows, is not.

    Disparity and its steps are the sensor's, whatever the camera of the map.

    Args:
        std: standard deviation of the disparity noise, in the sensor's pixels.
        step: quantisation step of disparity, in the sensor's pixels.
        stereo_constant: baseline times focal length of the sensor in metre pixels; 0.075 m x 580 px for a Kinect.
        dropout: probability that a pixel beside a depth edge is a hole.
        jump: relative difference of two neighbours' depths beyond which an edge lies between them.
        reach: width of the band of dropouts on each side of an edge, in low-resolution pixels.
        nearest, farthest: range of valid readings in metres; None for no limit.

    """

    range_type: ClassVar[RangeType | None] = "orthogonal"
    std: float = 0.05
    step: float = 0.125
    stereo_constant: float = 43.5
    dropout: float = 0.5
    jump: float = 0.05
    reach: int = 1
    nearest: float | None = 0.4
    farthest: float | None = 8.0

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 <= self.std < math.inf:
            raise ValueError(f"std: expected 0 or a positive number of pixels, got {self.std}")
        _check_positive(self, "step", "stereo_constant", "jump", "nearest", "farthest")
        if not 0 <= self.dropout <= 1:
            raise ValueError(f"dropout: expected a number from 0 to 1, got {self.dropout}")
        if self.reach < 1 or not float(self.reach).is_integer():
            raise ValueError(f"reach: expected a positive whole number of low-resolution pixels, got {self.reach}")
        if self.nearest is not None and self.farthest is not None and self.farthest <= self.nearest:
            raise ValueError(f"farthest: expected more than nearest, {self.nearest}, got {self.farthest}")

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return the sensor's reading in metres, NaN in holes, at dropouts and out of range."""
        draws = torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values.device)
        chances = torch.rand(values.shape, generator=generator, dtype=torch.float64).to(values.device)
        disparity = _positive(self.stereo_constant / values.double()) + self.std * draws
        depth = self.stereo_constant / _positive((disparity / self.step).round() * self.step)
        edge = torch.zeros_like(values, dtype=torch.bool)
        for axis in (-2, -1):
            size = values.shape[axis] - 1
            near, far = values.narrow(axis, 0, size), values.narrow(axis, 1, size)
            steps = (near - far).abs() > self.jump * torch.minimum(near, far)  # holes make no jump
            edge.narrow(axis, 0, size).logical_or_(steps)
            edge.narrow(axis, 1, size).logical_or_(steps)
        planes = edge.reshape(-1, 1, *edge.shape[-2:]).float()
        beside = functional.max_pool2d(planes, 2 * self.reach - 1, stride=1, padding=self.reach - 1).view_as(edge) > 0
        lost = (chances < self.dropout) & beside
        if self.nearest is not None:
            lost |= depth < self.nearest
        if self.farthest is not None:
            lost |= depth > self.farthest
        return depth.masked_fill(lost, torch.nan).to(values.dtype)


def no_noise() -> None:
    """Return no noise, for ``noise=none``."""
    return


def _check_positive(noise: Noise, *names: str) -> None:
    for name in names:
        value = getattr(noise, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name}: expected a positive number, got {value}")


def _positive(values: Tensor) -> Tensor:
    """Return the values with those that are not positive replaced by NaN."""
    return torch.where(values > 0, values, torch.nan)
