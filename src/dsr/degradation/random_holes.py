"""Holes drawn at random: masks of maps of inverse depth in 1/m, (1, h, w)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from dsr.degradation.draws import chance, field_of, near_steps, uniform
from dsr.degradation.holes import Blobs, Shadows


def _blobs(values: Tensor, _: Tensor, camera: object, generator: torch.Generator) -> Tensor:
    blobs = Blobs(uniform(0.02, 0.25, generator), uniform(2, 12, generator))
    return blobs(values.reciprocal(), camera, generator)  # type: ignore[arg-type]


def _shadows(values: Tensor, _: Tensor, camera: object, generator: torch.Generator) -> Tensor:
    side = -1 if chance(0.5, generator) else 1
    return Shadows(side * uniform(0.03, 0.2, generator))(values.reciprocal(), camera, generator)  # type: ignore[arg-type]


def _beside_steps(values: Tensor, _: Tensor, __: object, generator: torch.Generator) -> Tensor:
    reach = 1 + int(torch.randint(2, (1,), generator=generator))
    return near_steps(values, reach) & (torch.rand(values.shape, generator=generator) < uniform(0.3, 1, generator))


def dark(values: Tensor, luma: Tensor, _: object, generator: torch.Generator) -> Tensor:
    """Return the mask of the darkest pixels, most of them, (1, h, w)."""
    limit = float(luma[:, ::3, ::3].flatten().quantile(uniform(0.02, 0.2, generator)))
    return (luma < limit) & (field_of(values, 1, generator) > -0.3)


def _pixels(values: Tensor, _: Tensor, __: object, generator: torch.Generator) -> Tensor:
    return torch.rand(values.shape, generator=generator) < uniform(0.01, 0.4, generator)


HOLES: Mapping[str, Callable[[Tensor, Tensor, object, torch.Generator], Tensor]] = {
    "blobs": _blobs, "shadows": _shadows, "steps": _beside_steps, "dark": dark, "pixels": _pixels,
}  # fmt: skip
