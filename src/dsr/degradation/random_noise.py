"""The noise of cameras and sensors, drawn at random: functions of inverse depth in 1/m, (1, h, w), and brightness."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.draws import chance, field_of, near_steps, power, uniform, window_means
from dsr.degradation.random_holes import dark


def _white(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    strongest = chance(0.4, generator)  # as of simulated time of flight: 1 % and more
    strength = power(-2.2, -1.3, generator) if strongest else power(-3.4, -1.4, generator)
    return values * (1 + strength * field_of(values, 0, generator))


def _correlated(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    """Grain of 2 to 8 pixels, and a little white noise."""
    grain = field_of(values, uniform(0.5, 3.5, generator), generator)
    mixed = grain + uniform(0, 0.5, generator) * field_of(values, 0, generator)
    return values * (1 + power(-3.3, -1.8, generator) * mixed)


def _structured(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """A projector and a camera that match windows and count disparity in steps."""
    stereo_constant = uniform(0.04, 0.12, generator) * uniform(300, 700, generator)
    window = 2 * int(torch.randint(4, (1,), generator=generator)) + 1
    seen = _fatten(values, generator) if chance(0.5, generator) else values
    grain = window_means(field_of(values, 0, generator), window) * window
    result = _count(stereo_constant * seen, power(-1.8, -0.7, generator) * grain, generator) / stereo_constant
    lost = (torch.rand(values.shape, generator=generator) < uniform(0, 0.9, generator)) & near_steps(values, 1)
    if chance(0.3, generator):
        lost |= dark(values, luma, None, generator)
    if chance(0.25, generator):  # surfaces at grazing incidence
        steep = near_steps(values, 1, uniform(0.02, 0.06, generator))
        lost |= steep & (torch.rand(values.shape, generator=generator) < uniform(0.3, 0.9, generator))
    return result.masked_fill(lost, torch.nan)


def _count(disparity: Tensor, noise: Tensor, generator: torch.Generator) -> Tensor:
    """Return disparity in pixels as matching windows finds it: drawn to whole pixels, in steps, and smoothed again.

    Where the noise is weak against the step, a slanted wall becomes a stair.

    Args:
        disparity: (1, h, w) exact disparity in pixels.
        noise: (1, h, w) what is added to it.
        generator: source of all random numbers.

    """
    step = (0.0, 1 / 32, 1 / 16, 1 / 8)[int(torch.randint(4, (1,), generator=generator))]
    if step and chance(0.4, generator):
        noise = noise * (uniform(0.1, 0.6, generator) * step / noise.std().clamp(min=1e-9)).clamp(max=1)
    counted = disparity + noise
    if chance(0.3, generator):  # fits of a parabola to the costs favour whole pixels (Shimizu, Okutomi, IJCV 2005)
        counted = counted - uniform(0.02, 0.14, generator) * torch.sin(2 * math.pi * counted)
    if step:
        counted = (counted / step).round() * step
    if chance(0.3, generator):
        size = 2 * int(torch.randint(1, 3, (1,), generator=generator)) + 1
        error = counted - disparity
        known = error.isfinite().to(error)
        counted = disparity + window_means(error.nan_to_num(0), size) / window_means(known, size).clamp(min=1e-6)
    return counted


def _fatten(values: Tensor, generator: torch.Generator) -> Tensor:
    """Return a map in which near objects are a pixel wider in random places, as window matching makes them."""
    wide = functional.max_pool2d(values.nan_to_num(0)[None], 3, stride=1, padding=1)[0]
    return torch.where((field_of(values, 3, generator) > 0) & (wide > 0), wide, values)


def _flight(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """Time of flight: noise that grows with distance and on dark surfaces, flying pixels, and a smooth bias."""
    depth = values.reciprocal()
    if chance(0.6, generator):  # flying pixels: depth itself is averaged at steps
        taps = torch.tensor([0.25, 0.5, 0.25])
        known = depth.isfinite().to(depth)
        padded = functional.pad(torch.stack((depth.nan_to_num(0), known)), (1, 1, 1, 1), mode="replicate")
        sums, weights = functional.conv2d(padded, (taps[:, None] * taps).view(1, 1, 3, 3))
        mixed = sums / weights.clamp(min=1e-6)
        depth = torch.where(depth.isfinite() & (field_of(depth, 1, generator) > -0.5), mixed, depth)
    strength = power(-3.5, -2.4, generator) * depth ** uniform(1, 3, generator) / (luma + 0.05).sqrt()
    grain = field_of(depth, uniform(0, 1.5, generator) if chance(0.5, generator) else 0, generator)
    bias = field_of(depth, uniform(6, 15, generator), generator) * uniform(0, 0.006, generator) * depth
    return (depth + torch.minimum(strength, 0.05 * depth) * grain + bias).clamp(min=1e-3).reciprocal()


def _lidar(values: Tensor, _: Tensor, generator: torch.Generator) -> Tensor:
    """A phone's lidar: sparse dots, interpolated."""
    height, width = values.shape[-2:]
    stride = uniform(1.5, 8, generator)
    size = max(2, round(height / stride)), max(2, round(width / stride))
    dots = functional.interpolate(values[None], size, mode="nearest-exact")
    dots = dots * (1 + power(-3.3, -2.3, generator) * torch.randn(dots.shape, generator=generator))
    smooth = functional.interpolate(dots, (height, width), mode="bilinear", align_corners=False)[0]
    weight = uniform(0.4, 1, generator)
    smooth = torch.where(smooth.isfinite(), smooth, values)  # not beside holes of the truth
    result = weight * smooth + (1 - weight) * values
    grain = field_of(values, uniform(0.7, 3, generator), generator)
    return result * (1 + power(-3.3, -2.3, generator) * grain)


def _stereo(values: Tensor, luma: Tensor, generator: torch.Generator) -> Tensor:
    """Two cameras: disparity noise of windows, more where the photo has no texture."""
    stereo_constant = uniform(0.05, 0.2, generator) * uniform(400, 900, generator)
    window = 2 * int(torch.randint(1, 5, (1,), generator=generator)) + 1
    grain = window_means(field_of(values, 0, generator), window) * window
    flat = torch.exp(-(luma - window_means(luma, 5)).abs() / 0.03)
    seen = _fatten(values, generator)
    strength = power(-1.7, -0.5, generator) * (0.5 + 1.5 * flat)
    return _count(stereo_constant * seen, strength * grain, generator) / stereo_constant


NOISES: Mapping[str, Callable[[Tensor, Tensor, torch.Generator], Tensor]] = {
    "white": _white, "correlated": _correlated, "structured": _structured, "flight": _flight, "lidar": _lidar,
    "stereo": _stereo,
}  # fmt: skip
