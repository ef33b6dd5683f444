"""Hints: what a network may be given of a low-resolution map, and the noise of a map around each pixel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

KERNELS = ("box", "nearest", "bilinear", "bicubic", "gaussian")
"""Kernels in the order of their facts; a sensor's point spread counts as gaussian."""
FACTS = len(KERNELS) + 3  # number of the facts of a map
LARGEST = 0.1  # relative errors beyond this are outliers, and do not count as noise
_WINDOW = 9  # low-resolution pixels of the window in which the noise is measured


class Hints(NamedTuple):
    """What is known of a low-resolution map.

    ``noise`` (1, h, w): the standard deviation of the logarithm of its inverse depth, 0 where not given. ``facts``
    (``FACTS``,): those of :func:`encode_facts`.
    """

    noise: Tensor
    facts: Tensor


def encode_facts(kernel: str | None = None, soft: bool | None = None, *, noise: bool = False) -> Tensor:
    """Encode known properties of a map as numbers, (``FACTS``,): all 0 if nothing is known.

    Args:
        kernel: the kernel that made it, one of ``KERNELS``, as the first five.
        soft: whether its depth steps are soft, as the next two: sharp, soft.
        noise: whether its noise is given, as the last.

    """
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
    """Return the relative difference of maps to results of a multiple of their size, and a weight, 0 where unknown.

    Args:
        given: (B, 1, h, w) low-resolution inverse depth, NaN in holes.
        result: (B, 1, H, W) high-resolution inverse depth, whose block means are compared.

    Returns:
        Both (B, 1, h, w); 0 in holes and where the difference is an outlier.

    """
    scale = result.shape[-1] // given.shape[-1]
    error = given / functional.avg_pool2d(result, scale) - 1
    known = error.isfinite() & (error.abs() < LARGEST)
    return torch.where(known, error, 0), known.to(given.dtype)


def local_noise(given: Tensor, result: Tensor) -> Tensor:
    """Return the noise of maps around each pixel: root mean squares of their relative differences to results.

    Args:
        given: (B, 1, h, w) low-resolution inverse depth, NaN in holes, which do not count.
        result: (B, 1, H, W) high-resolution inverse depth.

    Returns:
        (B, 1, h, w), the standard deviation of the logarithm of inverse depth; 0 where nothing around is known.

    """
    error, weight = relative_error(given, result)
    padding = (_WINDOW // 2,) * 4
    squares, weights = (
        functional.avg_pool2d(functional.pad(each, padding, mode="replicate"), _WINDOW, stride=1)
        for each in (error.square(), weight)
    )
    return (squares / weights.clamp(min=1e-6)).sqrt()
