"""Noise of low-resolution depth maps: models of users' choice, and the noise of cameras drawn at random for training.

A noise model states the range type that it acts on, and maps low-resolution values of that type to noisy ones; see
:func:`dsr.degradation.downsampling.make_sample`. ``NOISES`` are functions of inverse depth in 1/m, (1, h, w), of the
brightness of the photo and of a generator.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.holes import dark, occluded
from dsr.degradation.random_fields import chance, field_of, integer, near_steps, power, uniform, waves_of
from dsr.geometry.camera import RangeType
from dsr.geometry.hole_size import window_maxima
from dsr.utils.guards import expect_positive


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
    """Multiplicative noise: values times 1 + std N(0, 1), in the range type that is averaged (Voynov et al. 2019)."""

    range_type: ClassVar[RangeType | None] = None
    std: float

    def __post_init__(self) -> None:
        if not 0 < self.std < 1:
            raise ValueError(f"std: expected a number above 0 and below 1, got {self.std}")

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return noisy values; NaN stays NaN."""
        draws = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        return values * (1 + self.std * draws).to(values)


@dataclass(frozen=True)
class TimeOfFlight:
    """Noise that grows with the third power of depth, after Riegler et al., *ATGV-Net*, ECCV 2016.

    They add N(0, (strength / v)^2) to Middlebury's disparities v in pixels of the full-size photos. Here

        v = stereo_constant / z - doffs,

    which to first order makes the depth's standard deviation strength z^3 / stereo_constant^2 for ``doffs`` = 0: 1.8 mm
    at 1 m, 116 mm at 4 m. It suits rooms: from about 10 m on, the tail of the distribution reaches infinity. Their v
    lacks the shift of Middlebury's views of 2005 (``dmin.txt``), which ``doffs`` takes.
    """

    range_type: ClassVar[RangeType | None] = "orthogonal"
    strength: float = 651.0
    stereo_constant: float = 598.4
    doffs: float = 0.0

    def __post_init__(self) -> None:
        expect_positive(strength=self.strength, stereo_constant=self.stereo_constant)
        expect_positive(or_zero=True, doffs=self.doffs)

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
    and Resolution of Kinect Depth Data*, Sensors 2012), so depth comes in steps of step z^2 / stereo_constant. With the
    defaults, noise and rounding together have their random error, 1.42e-3 z^2 m. The noise of neighbouring pixels is
    independent here; that of a sensor, which matches windows, is not.
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
        limits = {name: getattr(self, name) for name in ("nearest", "farthest") if getattr(self, name) is not None}
        expect_positive(or_zero=True, std=self.std)
        expect_positive(step=self.step, stereo_constant=self.stereo_constant, jump=self.jump, **limits)
        if not 0 <= self.dropout <= 1:
            raise ValueError(f"dropout: expected a number from 0 to 1, got {self.dropout}")
        if self.reach < 1 or not float(self.reach).is_integer():
            raise ValueError(f"reach: expected a positive whole number of low-resolution pixels, got {self.reach}")
        if len(limits) == 2 and limits["farthest"] <= limits["nearest"]:
            raise ValueError(f"farthest: expected more than nearest, {self.nearest}, got {self.farthest}")

    def __call__(self, values: Tensor, generator: torch.Generator) -> Tensor:
        """Return the sensor's reading in metres, NaN in holes, at dropouts and out of range."""
        draws = torch.randn(values.shape, generator=generator, dtype=torch.float64).to(values.device)
        # drawn even where they are not used, so that all settings share the numbers
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
        lost |= (depth < (self.nearest or 0)) | (depth > (self.farthest or math.inf))
        return depth.masked_fill(lost, torch.nan).to(values.dtype)


def no_noise() -> None:
    """Return no noise, for ``noise=none``."""


def _positive(values: Tensor) -> Tensor:
    return torch.where(values > 0, values, torch.nan)


def _white(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    return values * (1 + draw_white_strength(generator) * field_of(values, 0, generator))


def draw_white_strength(generator: torch.Generator) -> float:
    """Return a random standard deviation of white noise, relative to the values."""
    strongest = chance(0.4, generator)  # as of simulated time of flight: 1 % and more
    return power(-2.2, -1.3, generator) if strongest else power(-3.4, -1.4, generator)


def _correlated(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    """Grain of 2 to 8 pixels, and a little white noise."""
    grain = field_of(values, uniform(0.5, 3.5, generator), generator)
    mixed = grain + uniform(0, 0.5, generator) * field_of(values, 0, generator)
    return values * (1 + power(-3.3, -1.8, generator) * mixed)


def _waves(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    """Waves of 2 to 27 pixels, as far as the map is large enough, of several octaves."""
    length = min(3.33 * power(-0.22, 0.9, generator), _longest(values))
    return values * (1 + power(-2.9, -2, generator) * waves_of(values, length, generator))


def _longest(values: Tensor) -> float:
    """Return the longest waves of a map in pixels: longer ones could not be distinguished from its shape."""
    return max(1.0, min(64.0, min(values.shape[-2:]) / 4))


def _structured(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """A projector and a camera that match windows and count disparity in steps, with axial and lateral noise."""
    focal = uniform(300, 700, generator)
    stereo_constant = uniform(0.04, 0.12, generator) * focal
    seen = _fatten(values, 1, generator) if chance(0.5, generator) else values
    seen = _jitter(seen, uniform(0, 0.8, generator), generator)
    # The noise of Nguyen et al., Modeling Kinect sensor noise, 3DIMPVT 2012, up to 0.8 pixels laterally
    depth = values.reciprocal()
    axial = 0.0012 + 0.0019 * (depth - 0.4).square()
    slope = (
        values.diff(dim=-1, append=values[..., -1:]).square() + values.diff(dim=-2, append=values[:, -1:]).square()
    ).sqrt()
    angle = torch.atan(focal * slope / values)  # between the surface and the view
    grazing = (angle / (math.pi / 2 - angle)).square().clamp(max=25).nan_to_num(0)
    axial = axial + 0.0001 / depth.sqrt() * grazing
    noise = stereo_constant * values.square() * axial * power(-0.4, 0.4, generator)
    length = min(power(0, 1.1, generator), _longest(values))
    smooth = chance(0.5, generator)  # a matching window averages: where steps are coarser, plateaus with winding edges
    grain = field_of(values, length / 3.33, generator) if smooth else waves_of(values, length, generator)
    if chance(0.4, generator):
        strength, width = uniform(0.2, 1, generator), values.shape[-1]
        bands = torch.randn((1, 1, max(2, round(width / power(0.9, 1.9, generator)))), generator=generator)
        grain = grain + strength * functional.interpolate(bands, width, mode="nearest-exact").expand_as(values)
    result = _count(stereo_constant * seen, noise.nan_to_num(0) * grain, generator) / stereo_constant
    lost = (torch.rand(values.shape, generator=generator) < uniform(0, 1, generator)) & near_steps(values, 1)
    if chance(0.4, generator):  # the projector's light does not get there
        lost |= occluded(stereo_constant * values)
    if chance(0.4, generator):
        lost |= _between(values, 3, generator)
    if chance(0.3, generator):
        lost |= dark(values, luma, generator)
    if chance(0.25, generator):
        lost |= _steep(values, generator)
    return result.masked_fill(lost, torch.nan)


def _steep(values: Tensor, generator: torch.Generator) -> Tensor:
    """Return the mask of pixels lost on surfaces at grazing incidence."""
    steep = near_steps(values, 1, uniform(0.02, 0.06, generator))
    return steep & (torch.rand(values.shape, generator=generator) < uniform(0.3, 0.9, generator))


def _jitter(values: Tensor, strength: float, generator: torch.Generator) -> Tensor:
    """Return a map whose edges are displaced by normal noise of ``strength`` pixels, alike over few pixels."""
    height, width = values.shape[-2:]
    down, across = (
        (strength * field_of(values, uniform(0.3, 1.2, generator), generator)[0]).round().long() for _ in range(2)
    )
    rows = (torch.arange(height)[:, None] + down).clamp(0, height - 1)
    columns = (torch.arange(width) + across).clamp(0, width - 1)
    return torch.where(near_steps(values, 2), values[:, rows, columns], values)


def _count(disparity: Tensor, noise: Tensor, generator: torch.Generator, *, stereo: bool = False) -> Tensor:
    """Return disparity in pixels as matching windows finds it: drawn to whole pixels, in steps, and smoothed again."""
    steps = (0.0, 1 / 64, 1 / 32, 1 / 32) if stereo else (1 / 32, 1 / 16, 1 / 8, 1 / 8)
    step = steps[integer(0, 3, generator)]
    if step and chance(0.15 if stereo else 0.4, generator):  # noise so weak that a slanted wall becomes a stair
        noise = noise * (uniform(0.1, 0.6, generator) * step / noise.std().clamp(min=1e-9)).clamp(max=1)
    counted = disparity + noise
    if chance(0.3, generator):  # fits of a parabola to the costs favour whole pixels (Shimizu, Okutomi, IJCV 2005)
        counted = counted - uniform(0.02, 0.14, generator) * torch.sin(2 * math.pi * counted)
    if step:
        counted = (counted / step).round() * step
    if chance(0.3, generator):
        size = 2 * integer(1, 2, generator) + 1
        counted = disparity + _means(counted - disparity, size)
    return counted


def _fatten(values: Tensor, reach: int, generator: torch.Generator) -> Tensor:
    """Return a map in which near objects are ``reach`` pixels wider in random places, as window matching makes them."""
    wide = window_maxima(values.nan_to_num(0), reach)
    return torch.where((field_of(values, 3, generator) > 0) & (wide > 0), wide, values)


def _flight(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """Time of flight: noise where little light returns, flying pixels, light by several ways, wiggling by distance."""
    depth = values.reciprocal()
    amplitude = (luma + 0.05) * values.square()
    if chance(0.6, generator):  # flying pixels on both sides of steps: depth, weighted by the light, is averaged
        size = 3 + 2 * integer(0, 4, generator)
        mixed = _means(depth, size, amplitude)
        depth = torch.where(depth.isfinite() & (field_of(depth, 1, generator) > -0.5), mixed, depth)
    if chance(0.3, generator):  # enlarged by interpolation, or filtered
        wide = _means(depth, 3 + 2 * integer(0, 2, generator))
        depth = torch.where(depth.isfinite(), wide, depth)
    exact = depth
    strength = power(-3.8, -2.5, generator) * depth ** uniform(1, 3, generator) / (luma + 0.05).sqrt()
    length = min(uniform(1, 9, generator), _longest(values)) if chance(0.6, generator) else 1
    grain = waves_of(depth, length, generator)
    if chance(0.5, generator):  # light that comes by other surfaces
        height, width = exact.shape[-2:]
        coarser = power(0.6, 1.3, generator)
        coarse = max(2, round(height / coarser)), max(2, round(width / coarser))
        stack = functional.adaptive_avg_pool2d(torch.stack((exact.nan_to_num(0), exact.isfinite().to(exact))), coarse)
        sums, weights = functional.interpolate(stack, (height, width), mode="bilinear", align_corners=False)
        rounded = (sums / weights.clamp(min=1e-6) / exact - 1).clamp(min=-0.1)
        rounded = rounded.clamp(max=0) * torch.exp(-(rounded / 0.04).square())  # inner corners, not steps
        wide = field_of(depth, min(power(0.8, 1.4, generator), _longest(values)), generator)
        depth = depth + exact * (uniform(0, 1, generator) * rounded + uniform(0, 0.01, generator) * (wide + 1))
    if chance(0.4, generator):  # harmonics of the modulation
        wave = uniform(0.4, 1.5, generator)
        depth = depth + uniform(0, 0.01, generator) * torch.sin(
            2 * math.pi * exact / wave + uniform(0, 6.28, generator)
        )
    if chance(0.4, generator):  # dark surfaces seem too far
        depth = depth + uniform(0, 0.02, generator) * torch.exp(-luma / 0.1)
    noisy = (depth + torch.minimum(strength, 0.05 * exact) * grain).clamp(min=1e-3).reciprocal()
    if chance(0.2, generator):
        noisy = noisy.masked_fill(dark(values, luma, generator), torch.nan)
    if chance(0.4, generator):  # cameras leave out what flies
        noisy = noisy.masked_fill(_between(values, 3, generator), torch.nan)
    return noisy


def _means(values: Tensor, size: int, weights: Tensor | None = None) -> Tensor:
    """Return means of windows, weighted if weights are given, holes left out, (1, h, w)."""
    weights = torch.where(values.isfinite(), torch.ones_like(values) if weights is None else weights, 0)
    return _window_means(values.nan_to_num(0) * weights, size) / _window_means(weights, size).clamp(min=1e-9)


def _window_means(values: Tensor, size: int) -> Tensor:
    """Return the means of windows of an odd size, (1, h, w)."""
    padded = functional.pad(values[None], (size // 2,) * 4, mode="replicate")
    return functional.avg_pool2d(padded, size, stride=1)[0]


def _lidar(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """A phone's lidar: a grid of dots coarser than the map, interpolated, with blobs of doubtful pixels."""
    height, width = values.shape[-2:]
    stride = uniform(1.5, 8, generator)
    size = max(2, round(height / stride)), max(2, round(width / stride))
    shift, places = uniform(0, 0.5, generator), []  # each dot is measured up to this part of their distance aside
    for axis, count in enumerate(size):
        middles = (torch.arange(count) + 0.5).view((-1, 1) if axis == 0 else (1, -1))
        aside = shift * (2 * torch.rand(size, generator=generator) - 1)
        whole = values.shape[axis - 2]
        places.append(((middles + aside) * (whole / count)).long().clamp(0, whole - 1))
    dots = values[:, places[0], places[1]]
    smooth = functional.interpolate(dots[None], (height, width), mode="bilinear", align_corners=False)[0]
    smooth = torch.where(smooth.isfinite(), smooth, values)  # not beside holes of the truth
    weight = uniform(0.5, 1, generator)
    result = weight * smooth + (1 - weight) * values
    length = min(uniform(3, 9, generator), _longest(values))
    strength = power(-3.8, -2.6, generator) * (1 + torch.exp(-luma / 0.1))  # twice on dark surfaces
    doubtful = torch.sigmoid(3 * (field_of(values, min(5.0, _longest(values)), generator) - uniform(1, 3, generator)))
    result = result * (1 + strength * (1 + 4 * doubtful) * waves_of(values, length, generator).clamp(-3, 3))
    if chance(0.4, generator):  # 2.9 % at 0.35 m, 1.6 % at 1.1 m, 0.6 % at 3 m; whether near or far is not known
        result = result * (1 + uniform(-1, 1, generator) * (0.015 * values**0.7).clamp(max=0.03))
    return result


def _stereo(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """Two cameras of a size of their own, whose map is enlarged to this one by repeating values."""
    length = _longest(values) ** math.sqrt(uniform(0, 1, generator))  # of the waves, in pixels of this map
    ratio = uniform(1, max(1.0, min(3.4, length / 2)), generator) if chance(0.7, generator) else 1.0
    repeats, sees = [], []  # which of the sensor's pixels each of the map's repeats, and which of the map's those see
    for size in values.shape[-2:]:
        repeats.append(((torch.arange(size) + uniform(0, 1, generator) * (ratio > 1)) / ratio).long())
        count = int(repeats[-1][-1]) + 1
        sees.append(((torch.arange(count) + 0.5) * (size / count)).long().clamp(max=size - 1))
    seen, shades = (each[:, sees[0]][..., sees[1]] for each in (values, luma))
    return _match(seen, shades, length / ratio, generator)[:, repeats[0]][..., repeats[1]]


def _match(values: Tensor, luma: Tensor, length: float, generator: torch.Generator) -> Tensor:
    """Return inverse depth as stereo matching finds it, at the sensor's size, with waves of ``length`` pixels."""
    middle = values.nanmedian().clamp(min=1e-6)  # of a map of holes, NaN
    pixels = power(0.7, 1.8, generator)  # disparity at the middle
    stereo_constant = float(pixels / middle)
    amplitude = min(max(power(-2.9, -1.8, generator) * pixels, 0.02), 0.4)
    flat = 0.3 + torch.exp(-(luma - _window_means(luma, 5)).abs() / 0.03)
    reach = integer(0, 4, generator)  # half the matching window
    seen = _fatten(values, reach, generator) if reach else values
    stretch = uniform(1, 1.6, generator)
    waves = waves_of(values, length, generator, stretch)
    if length > 3:  # filters stop at steps
        beside = window_maxima(near_steps(values, 1).to(values), max(1, int(length / 4))) > 0
        waves = torch.where(beside, waves_of(values, length / 2.5, generator, stretch), waves)
    if chance(0.4, generator):  # rows are matched one by one
        waves = waves + uniform(0, 0.4, generator) * field_of(values, (0.3, max(length / 3, 0.3)), generator)
    counted = _count(stereo_constant * seen, amplitude * (flat / flat.mean()) * waves, generator, stereo=True)
    if chance(0.35, generator):  # filters that do not stop at steps
        counted = _means(counted, 2 * integer(1, 3, generator) + 1)
    return _lose(counted, values, luma, stereo_constant, generator) / stereo_constant


def _lose(
    disparity: Tensor, values: Tensor, luma: Tensor, stereo_constant: float, generator: torch.Generator
) -> Tensor:
    """Return disparity with holes where only one camera sees a surface, or where both see too little."""
    if chance(0.7, generator):
        hidden = occluded(stereo_constant * values)
        if chance(0.25, generator):  # some cameras fill such holes with the value to their left
            places = torch.where(hidden, 0, torch.arange(hidden.shape[-1])).cummax(dim=-1).values
            disparity = disparity.gather(-1, places)
        else:
            disparity = disparity.masked_fill(hidden, torch.nan)
    lost = torch.zeros_like(values, dtype=torch.bool)
    if chance(0.2, generator):
        lost |= dark(values, luma, generator)
    if chance(0.2, generator):  # gloss
        shining = luma > max(0.8, float(luma[:, ::3, ::3].flatten().quantile(uniform(0.9, 0.99, generator))))
        lost |= shining & (field_of(values, 2, generator) > -0.5)
    if chance(0.25, generator):  # bare surfaces
        bare = _window_means((luma - _window_means(luma, 5)).abs(), 5) < 0.01
        lost |= bare & (field_of(values, 5, generator) > uniform(0.8, 2.5, generator))
    if chance(0.25, generator):
        lost |= _steep(values, generator)
    if chance(0.5, generator):  # windows that see two surfaces
        lost |= _between(values, 4, generator)
    return disparity.masked_fill(lost, torch.nan)


def _between(values: Tensor, most: int, generator: torch.Generator) -> Tensor:
    """Return the mask of pixels lost where two surfaces are seen, up to ``most`` pixels from steps, (1, h, w)."""
    reach = integer(1, most, generator)
    beside = window_maxima(near_steps(values, 1).to(values), reach) > 0
    return beside & (field_of(values, 1.5, generator) > uniform(-2, 1, generator))


NOISES: Mapping[str, Callable[[Tensor, Tensor, torch.Generator], Tensor]] = {
    "white": _white, "correlated": _correlated, "waves": _waves, "structured": _structured, "flight": _flight,
    "lidar": _lidar, "stereo": _stereo,
}  # fmt: skip
