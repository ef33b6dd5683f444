"""How tables and figures show a metric: its heading, unit, precision, direction and position."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

BEFORE_THE_PAPER = 0  # the position of metrics that stand before those of the paper's tables
AFTER_THE_PAPER = 100  # the position of metrics that the paper's tables do not have
PAPER = "paper"  # the family of the paper's metrics, and of those that stand beside them
_MOST_DIGITS = 20
# the metrics of how a surface looks, by which results are compared first: RMSE_v, without lights, and three for the
# worst of four lights
LOOKS = ("RMSE_v", "RMSE_v1", "DSSIM_v", "LPIPS_v")
LIGHTS_NOTE = "RMSE_v has no lights, the other metrics of renderings are of the worst of four"
# variants of the value that stands for an image: without lights, or the worst of four lights (the smallest value where
# higher is better)
HEADLINES = ("", "max", "min")


@dataclass(frozen=True)
class MetricFormat:
    """How tables and figures show a metric.

    Args:
        heading: short name for readers.
        unit: of the shown values; may be empty.
        factor: from raw values, as in ``scores.csv``, to shown ones.
        digits: number of digits after the decimal point.
        higher_is_better: direction of the ranking.
        family: metrics of one family share a table; those of other families and of regions have one of their own.
        position: place among the columns of a table, from the left; None for a metric that is only in ``scores.csv``.

    """

    heading: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 3
    higher_is_better: bool = False
    position: int | None = AFTER_THE_PAPER
    family: str = PAPER

    def __post_init__(self) -> None:
        """Check the values."""
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


Formats = Mapping[str, MetricFormat]  # formats of metrics by their names in scores.csv


def in_tables(formats: Formats) -> dict[str, MetricFormat]:
    """Return the formats of the metrics that tables show, in the order of the columns."""
    shown = {name: each for name, each in formats.items() if each.position is not None}
    return dict(sorted(shown.items(), key=lambda item: item[1].position or 0))


def by_family(formats: Formats) -> dict[str, dict[str, MetricFormat]]:
    """Return the formats of each family, the paper's first."""
    families = dict.fromkeys((PAPER, *(each.family for each in formats.values())))
    found = {name: {key: each for key, each in formats.items() if each.family == name} for name in families}
    return {name: members for name, members in found.items() if members}


def describe_directions(formats: Formats) -> str:
    """Return which way is better, such as "lower is better" or "lower is better, of PSNR higher"."""
    higher = [each.heading for each in formats.values() if each.higher_is_better]
    if not higher:
        return "lower is better"
    if len(higher) == len(formats):
        return "higher is better"
    return f"lower is better, of {', '.join(higher)} higher"


def complete_formats(names: Iterable[str], *defined: Formats) -> dict[str, MetricFormat]:
    """Return a format for each metric: the first that is defined, or the raw value under the metric's name."""
    found: dict[str, MetricFormat] = {}
    for name in names:
        formats = (each[name] for each in defined if name in each)
        found[name] = next(formats, MetricFormat(name))
    return found


def main_first(names: Iterable[str]) -> list[str]:
    """Return the names of metrics with those of :data:`LOOKS` first; the others keep their order."""
    return sorted(names, key=lambda name: LOOKS.index(name) if name in LOOKS else len(LOOKS))
