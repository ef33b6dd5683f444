"""Random numbers, choices and fields from an explicit generator, and what is computed around each pixel."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional


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


def power(low: float, high: float, generator: torch.Generator) -> float:
    """Return 10 to the power of a number from ``low`` to ``high``."""
    return 10 ** uniform(low, high, generator)


def normal(generator: torch.Generator) -> float:
    """Return a number with a mean of 0 and a variance of 1."""
    return float(torch.randn(1, generator=generator))


def field_of(like: Tensor, sigma: float | tuple[float, float], generator: torch.Generator) -> Tensor:
    """Return normal noise with a variance of 1, (1, h, w), blurred by a Gaussian.

    Args:
        like: a map of that size.
        sigma: standard deviation of the Gaussian in pixels, or one along v and one along u.
        generator: source of the random numbers.

    """
    if sigma == 0:
        return torch.randn(like.shape, generator=generator)
    down, across = (_normalised_taps(each) for each in (sigma if isinstance(sigma, tuple) else (sigma, sigma)))
    height, width = like.shape[-2:]
    draws = torch.randn((1, 1, height + len(down) - 1, width + len(across) - 1), generator=generator)
    return functional.conv2d(functional.conv2d(draws, down.view(1, 1, -1, 1)), across.view(1, 1, 1, -1))[0]


def _normalised_taps(sigma: float) -> Tensor:
    """Return the values of a Gaussian whose squares add up to 1."""
    radius = max(math.ceil(3.5 * sigma), 1)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma).square())
    return taps / taps.norm()


def window_means(values: Tensor, size: int) -> Tensor:
    """Return the means of windows of an odd size, (1, h, w)."""
    reach = size // 2
    return functional.avg_pool2d(functional.pad(values[None], (reach,) * 4, mode="replicate"), size, stride=1)[0]


def near_steps(values: Tensor, reach: int, jump: float = 0.04) -> Tensor:
    """Return the mask of pixels within ``reach`` pixels of a step, (1, h, w)."""
    size = 2 * reach + 1
    high = functional.max_pool2d(values.nan_to_num(-math.inf)[None], size, stride=1, padding=reach)
    low = -functional.max_pool2d((-values).nan_to_num(-math.inf)[None], size, stride=1, padding=reach)
    return (high > (1 + jump) * low)[0]
