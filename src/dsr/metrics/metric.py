"""A metric: how it is computed and how it is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from dsr.geometry.lights import LIGHT_NAMES
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import SurfacePair
from dsr.utils.compute_device import in_own_precision

WORST, AVERAGE = "max", "avg"
VARIANTS = (*LIGHT_NAMES, WORST, AVERAGE)


@dataclass(frozen=True)
class Metric:
    """A metric: how it is computed and how it is shown.

    Args:
        name: as in ``scores.csv``.
        function: from a pair to (B,), or to (B, 4) if ``per_light``.
        mask: from a pair to the (B, 1, H', W') pixels that the metric uses.
        format: how tables and figures show it.
        per_light: whether there is a value for each of the lights e1..e4.
        min_size: smallest height and width in pixels that it is defined for.
        perceptual: whether the function takes an LPIPS ``network``; :func:`dsr.metrics.catalogue.catalogue` binds it.
        unit: name of the benchmarks' unit that it is for, see :class:`dsr.sample.Unit`; None for all of them.
        region: the part of the image that it is of, see :class:`dsr.sample.Scene`. Scenes without it are skipped.
        regional: whether tables of regions have it; None for means over the pixels with both depths or both normals.
        whole: whether it is computed of the whole image even where a method left out rows or columns at the border.
        stated: the expected errors that it compares, ``depth_error`` or ``angle_error``; methods without are skipped.

    """

    name: str
    function: Callable[..., Tensor]
    mask: Callable[[SurfacePair], Tensor]
    format: MetricFormat
    per_light: bool = False
    min_size: int = 2
    perceptual: bool = False
    unit: str | None = None
    region: str | None = None
    regional: bool | None = None
    whole: bool = False
    stated: str | None = None

    def applies(self, pair: SurfacePair) -> bool:
        """Return whether the metric is for the pair's benchmark, and the pair has its region and expected errors."""
        known = self.stated is None or getattr(pair, self.stated) is not None
        return known and self.unit in (None, pair.unit.name) and (self.region is None or self.region in pair.regions)

    @property
    def in_regions(self) -> bool:
        """Whether tables of regions have it."""
        if self.per_light or self.perceptual or self.region is not None or self.format.position is None:
            return False
        return self.mask in (depth_mask, normal_mask) if self.regional is None else self.regional

    def within(self, region: str) -> Metric:
        """Return the metric of a region, ``NAME@REGION``."""
        unit = f"{region}, {self.format.unit}" if self.format.unit else region
        return replace(
            self, name=f"{self.name}@{region}", region=region, format=replace(self.format, unit=unit, family=region)
        )

    @property
    def worst(self) -> str:
        """The variant that is the worst of four lights: the largest value, the smallest if higher is better."""
        return "min" if self.format.higher_is_better else WORST

    @in_own_precision
    def variants(self, pair: SurfacePair) -> dict[str, Tensor]:
        """Return the value per image, (B,), by variant: e1..e4, the worst of them and their average, or just "".

        NaN for images below the metric's smallest size.
        """
        pair = pair if self.region is None else pair.within(self.region)
        shape = (len(pair.target), len(LIGHT_NAMES)) if self.per_light else (len(pair.target),)
        if min(pair.target.shape[-2:]) < self.min_size:
            values = pair.target.new_full(shape, torch.nan)
        else:
            values = self.function(pair)
        if tuple(values.shape) != shape:
            raise ValueError(f"{self.name}: expected values of shape {shape}, got {tuple(values.shape)}")
        if not self.per_light:
            return {"": values}
        by_light = dict(zip(LIGHT_NAMES, values.unbind(1), strict=True))
        worst = values.amin(dim=1) if self.format.higher_is_better else values.amax(dim=1)
        return {**by_light, self.worst: worst, AVERAGE: values.mean(dim=1)}

    def valid_fraction(self, pair: SurfacePair) -> Tensor:
        """Return the valid fraction of the pixels that the metric would use in a complete map, (B,)."""
        if min(pair.target.shape[-2:]) < self.min_size:
            return torch.zeros(len(pair.target), dtype=torch.float64)
        pair = pair if self.region is None else pair.within(self.region)
        return self.mask(pair).double().mean(dim=(-3, -2, -1))


depth_mask = attrgetter("depth_mask")  # the pixels with a depth in both maps
target_mask = attrgetter("target_mask")  # the pixels with a true depth, which a prediction should cover
normal_mask = attrgetter("normal_mask")  # the pixels with a normal in both maps


def part_of(pair: SurfacePair, function: Callable[[SurfacePair], Any], part: Any) -> Tensor:
    """Return one of the values of a function that computes several together."""
    value: Tensor = function(pair)[part]
    return value
