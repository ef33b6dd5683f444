"""Random numbers and fields from an explicit generator."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.hole_size import window_maxima


def draw(shares: Mapping[str, float], generator: torch.Generator) -> str:
    """Return a random key, each as often as its share says."""
    weights = torch.tensor(list(shares.values()), dtype=torch.float64)
    return list(shares)[int(torch.multinomial(weights, 1, generator=generator))]


def chance(share: float, generator: torch.Generator) -> bool:
    """Return true with a probability of ``share``."""
    return float(torch.rand(1, generator=generator)) < share


def uniform(low: float, high: float, generator: torch.Generator) -> float:
    """Return a number from ``low`` to ``high``."""
    return low + (high - low) * float(torch.rand(1, generator=generator))


def integer(low: int, high: int, generator: torch.Generator) -> int:
    """Return a whole number from ``low`` to ``high``, both included."""
    return int(torch.randint(low, high + 1, (1,), generator=generator))


def power(low: float, high: float, generator: torch.Generator) -> float:
    """Return 10 to the power of a number from ``low`` to ``high``."""
    return 10 ** uniform(low, high, generator)


def normal(generator: torch.Generator) -> float:
    """Return a number with a mean of 0 and a variance of 1."""
    return float(torch.randn(1, generator=generator))


def field_of(like: Tensor, sigma: float | tuple[float, float], generator: torch.Generator) -> Tensor:
    """Return normal noise with a variance of 1, (1, h, w), blurred by a Gaussian of ``sigma`` pixels, or of (v, u)."""
    if sigma == 0:
        return torch.randn(like.shape, generator=generator)
    sigmas = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    factors = [max(int(each / 1.25), 1) for each in sigmas]  # wide Gaussians are drawn on a coarse grid and enlarged
    height, width = like.shape[-2:]
    rows, columns = (
        -(-size // factor) + 2 * (factor > 1) for size, factor in zip((height, width), factors, strict=True)
    )
    taps = []  # the values of Gaussians whose squares add up to 1
    for each, factor in zip(sigmas, factors, strict=True):
        radius = max(math.ceil(3.5 * (each / factor)), 1)
        values = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / (each / factor)).square())
        taps.append(values / values.norm())
    draws = torch.randn((1, 1, rows + len(taps[0]) - 1, columns + len(taps[1]) - 1), generator=generator)
    field = _weighted_sums(_weighted_sums(draws, taps[0], -2), taps[1], -1)
    if max(factors) == 1:
        return field[0]
    size = rows * factors[0], columns * factors[1]
    top, left = (factor if factor > 1 else 0 for factor in factors)
    fine = functional.interpolate(field, size, mode="bicubic", align_corners=False)
    return fine[0, :, top : top + height, left : left + width]


def waves_of(like: Tensor, length: float, generator: torch.Generator, stretch: float = 1) -> Tensor:
    """Return normal noise of several octaves with a variance of 1, (1, h, w), ``stretch`` times as long along rows.

    ``length``: full width at half maximum of its autocorrelation in pixels; white noise for 1 and less.
    """
    if length <= 1:
        return field_of(like, 0, generator)
    ratio = uniform(0.1, 0.6, generator)  # of one octave's standard deviation to that of the next longer one
    sigma = length / (4 * math.sqrt(math.log(2)) * (1 - 0.7 * ratio**2))  # fits the sum of the octaves within 5 %
    field, variance = torch.zeros(like.shape), 0.0
    for octave in range(3):
        size = sigma / 2**octave
        field += ratio**octave * field_of(like, (size / stretch, size * stretch), generator)
        variance += ratio ** (2 * octave)
    return field / math.sqrt(variance)


def _weighted_sums(values: Tensor, taps: Tensor, dim: int) -> Tensor:
    """Convolve along a dimension without padding; for a single channel faster than a convolution."""
    size = values.shape[dim] - len(taps) + 1
    result = values.narrow(dim, 0, size) * taps[0]
    for place, tap in enumerate(taps[1:].tolist(), 1):
        result.add_(values.narrow(dim, place, size), alpha=tap)
    return result


def near_steps(values: Tensor, reach: int, jump: float = 0.04) -> Tensor:
    """Return the mask of pixels within ``reach`` pixels of a step, (1, h, w)."""
    high = window_maxima(values.nan_to_num(-math.inf), reach)
    low = -window_maxima((-values).nan_to_num(-math.inf), reach)
    return high > (1 + jump) * low
