"""A metric: how it is computed from a pair of depth maps, and how tables and figures show it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor

from dsr.geometry.lights import LIGHT_NAMES
from dsr.metrics.functional import SurfacePair
from dsr.utils.compute_device import in_own_precision

# positions among the columns of a table: before those of the paper's tables, and after them
BEFORE_THE_PAPER, AFTER_THE_PAPER = 0, 100
PAPER = "paper"  # the family of the paper's metrics, and of those that stand beside them
_MOST_DIGITS = 20
# the metrics of how a surface looks, by which results are compared first: RMSE_v, without lights, and three for the
# worst of four lights
LOOKS = ("RMSE_v", "RMSE_v1", "DSSIM_v", "LPIPS_v")
LIGHTS_NOTE = "RMSE_v has no lights, the other metrics of renderings are of the worst of four"
WORST, AVERAGE = "max", "avg"  # variants of metrics that have a value for each light, beside the lights' names
VARIANTS = (*LIGHT_NAMES, WORST, AVERAGE)
# variants of the value that stands for an image: without lights, or the worst of four lights (the smallest value where
# higher is better)
HEADLINES = ("", WORST, "min")


@dataclass(frozen=True)
class MetricFormat:
    """How tables and figures show a metric."""

    heading: str  # short name for readers
    unit: str = ""  # of the shown values
    factor: float = 1.0  # from raw values, as in ``scores.csv``, to shown ones
    digits: int = 3  # after the decimal point
    higher_is_better: bool = False
    position: int | None = AFTER_THE_PAPER  # among the columns of a table; None for a metric only in ``scores.csv``
    family: str = PAPER  # metrics of one family share a table; those of other families and of regions have their own

    def __post_init__(self) -> None:
        if not 0 < self.factor < math.inf:
            raise ValueError(f"{self.heading}: factor: expected a positive number, got {self.factor}")
        if not 0 <= self.digits <= _MOST_DIGITS:
            raise ValueError(f"{self.heading}: digits: expected 0 to {_MOST_DIGITS}, got {self.digits}")

    def text(self, value: float) -> str:
        """Return a shown value with its digits."""
        return f"{value:.{self.digits}f}"

    @property
    def title(self) -> str:
        """The heading with the unit in parentheses."""
        return f"{self.heading} ({self.unit})" if self.unit else self.heading

    def chart_title(self, *, by_light: bool) -> str:
        """Return the title of a chart of the metric's values, of the worst light where there is one for each light."""
        return f"{self.title}, worst light" if by_light else self.title


def column(
    heading: str, unit: str, factor: float = 1.0, digits: int = 1, *, higher_is_better: bool = False
) -> MetricFormat:
    """Return the format of a column that stands before those of the paper, or in a table of its own family."""
    return MetricFormat(heading, unit, factor, digits, higher_is_better, BEFORE_THE_PAPER)


depth_mask = attrgetter("depth_mask")  # the pixels with a depth in both maps
target_mask = attrgetter("target_mask")  # the pixels with a true depth, which a prediction should cover
normal_mask = attrgetter("normal_mask")  # the pixels with a normal in both maps


@dataclass(frozen=True)
class Metric:
    """A metric: how it is computed and how it is shown."""

    name: str  # as in ``scores.csv``
    function: Callable[..., Tensor]  # from a pair to (B,), or to (B, 4) if ``per_light``
    mask: Callable[[SurfacePair], Tensor]  # from a pair to the (B, 1, H', W') pixels that the metric uses
    format: MetricFormat
    per_light: bool = False  # whether there is a value for each of the lights e1..e4
    min_size: int = 2  # smallest height and width in pixels that it is defined for
    perceptual: bool = False  # whether the function takes an LPIPS ``network``, which the catalogue binds
    unit: str | None = None  # name of the benchmarks' unit that it is for, see :class:`dsr.sample.Unit`; None for all
    region: str | None = None  # the part of the image that it is of; scenes without it are skipped
    # whether tables of regions have it; None for means over the pixels with both depths or both normals
    regional: bool | None = None
    whole: bool = False  # whether it is of the whole image even where a method left out rows or columns at the border
    # what else of a pair it needs: ``depth_error``, ``angle_error`` or ``measured``; pairs without are skipped
    stated: str | None = None

    def applies(self, pair: SurfacePair) -> bool:
        """Return whether the metric is for the pair's benchmark, and the pair has its region and what else it needs."""
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
        shown = replace(self.format, unit=unit, family=region)
        return replace(self, name=f"{self.name}@{region}", region=region, format=shown)

    @property
    def worst(self) -> str:
        """The variant that is the worst of four lights: the largest value, the smallest if higher is better."""
        return "min" if self.format.higher_is_better else WORST

    @in_own_precision
    def variants(self, pair: SurfacePair) -> dict[str, Tensor]:
        """Return the value per image, (B,), by variant, or just ""; NaN for images below the metric's smallest size."""
        pair = pair if self.region is None else pair.within(self.region)
        shape = (len(pair.target), len(LIGHT_NAMES)) if self.per_light else (len(pair.target),)
        small = min(pair.target.shape[-2:]) < self.min_size
        values = pair.target.new_full(shape, torch.nan) if small else self.function(pair)
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


def of_parts(
    prefix: str,
    function: Callable[[SurfacePair], Mapping[str, Tensor]],
    mask: Callable[[SurfacePair], Tensor],
    formats: Mapping[str, MetricFormat],
    **settings: Any,
) -> list[Metric]:
    """Return the metrics PREFIX + NAME of a function that computes several values together, by name."""
    return [
        Metric(prefix + name, partial(_part, function=function, name=name), mask, shown, **settings)
        for name, shown in formats.items()
    ]


def _part(pair: SurfacePair, function: Callable[[SurfacePair], Mapping[str, Tensor]], name: str) -> Tensor:
    return function(pair)[name]


Formats = Mapping[str, MetricFormat]  # formats of metrics by their names in scores.csv


def in_tables(formats: Formats) -> dict[str, MetricFormat]:
    """Return the formats of the metrics that tables show, in the order of the columns."""
    shown = {name: each for name, each in formats.items() if each.position is not None}
    return dict(sorted(shown.items(), key=lambda item: item[1].position or 0))


def by_family(formats: Formats) -> dict[str, dict[str, MetricFormat]]:
    """Return the formats of each family, the paper's first."""
    families: dict[str, dict[str, MetricFormat]] = {PAPER: {}}
    for name, each in formats.items():
        families.setdefault(each.family, {})[name] = each
    return {family: members for family, members in families.items() if members}


def describe_directions(formats: Formats) -> str:
    """Return which way is better, such as "lower is better" or "lower is better, of PSNR higher"."""
    higher = [each.heading for each in formats.values() if each.higher_is_better]
    if not higher:
        return "lower is better"
    return "higher is better" if len(higher) == len(formats) else f"lower is better, of {', '.join(higher)} higher"


def complete_formats(names: Iterable[str], *defined: Formats) -> dict[str, MetricFormat]:
    """Return a format for each metric: the first that is defined, or the raw value under the metric's name."""
    known = {name: each for formats in reversed(defined) for name, each in formats.items()}
    return {name: known.get(name, MetricFormat(name)) for name in names}


def main_first(names: Iterable[str]) -> list[str]:
    """Return the names of metrics with those of :data:`LOOKS` first; the others keep their order."""
    return sorted(names, key=lambda name: LOOKS.index(name) if name in LOOKS else len(LOOKS))


def looks_and_depth(names: Collection[str]) -> dict[str, list[str]]:
    """Return the names of metrics by the heading of their charts, with those of :data:`LOOKS` first."""
    looks = main_first(name for name in names if "_v" in name)
    return {"Looks": looks, "Depth and normals": [name for name in names if name not in looks]}
