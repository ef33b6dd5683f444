"""Hints: what a network may be given of a low-resolution map, and the noise of a map around each pixel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

KERNELS = ("box", "nearest", "bilinear", "bicubic", "gaussian")  # a sensor's point spread counts as gaussian
FACTS = len(KERNELS) + 3  # number of the facts of a map
LARGEST = 0.1  # relative errors beyond this are outliers, and do not count as noise
_WINDOW = 9  # low-resolution pixels of the window in which the noise is measured


class Hints(NamedTuple):
    """What is known of a low-resolution map."""

    noise: Tensor  # (1, h, w), the standard deviation of the logarithm of its inverse depth, 0 where not given
    facts: Tensor  # (FACTS,), those of encode_facts


def encode_facts(kernel: str | None = None, soft: bool | None = None, *, noise: bool = False) -> Tensor:
    """Encode what is known of a map as (``FACTS``,) numbers: five for the kernel, two for softness, one for noise."""
    facts = torch.zeros(FACTS)
    if kernel is not None:
        if kernel not in KERNELS:
            raise ValueError(f"kernel: expected one of {', '.join(KERNELS)}, got {kernel}")
        facts[KERNELS.index(kernel)] = 1
    if soft is not None:
        facts[len(KERNELS) + int(soft)] = 1
    facts[-1] = noise
    return facts


def known_kernels(facts: Tensor) -> list[str | None]:
    """Return the kernel in the facts of each map, (B, ``FACTS``); None where there is none."""
    kernels = facts[:, : len(KERNELS)].tolist()
    return [KERNELS[each.index(max(each))] if any(each) else None for each in kernels]


def relative_error(given: Tensor, result: Tensor) -> tuple[Tensor, Tensor]:
    """Return the relative difference of maps to block means of results, and a weight, 0 where unknown, (B, 1, h, w).

    ``given`` (B, 1, h, w) and ``result`` (B, 1, H, W) are inverse depth; the difference is 0 in holes and of outliers.
    """
    scale = result.shape[-1] // given.shape[-1]
    error = given / functional.avg_pool2d(result, scale) - 1
    known = error.isfinite() & (error.abs() < LARGEST)
    return torch.where(known, error, 0), known.to(given.dtype)


def local_noise(given: Tensor, result: Tensor) -> Tensor:
    """Return the noise of maps around each pixel, (B, 1, h, w); 0 where nothing around is known.

    It is the root mean square of their relative differences to results; arguments as for :func:`relative_error`.
    """
    error, weight = relative_error(given, result)
    padding = (_WINDOW // 2,) * 4
    squares, weights = (
        functional.avg_pool2d(functional.pad(each, padding, mode="replicate"), _WINDOW, stride=1)
        for each in (error.square(), weight)
    )
    return (squares / weights.clamp(min=1e-6)).sqrt()
