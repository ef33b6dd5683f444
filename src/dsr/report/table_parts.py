"""Parts of a table like those of the paper, without layout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dsr.report.scene_sets import SceneSet


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Args:
        key: metric as in ``scores.csv``, or column of the user study.
        heading, unit: displayed texts; the unit may be empty.
        digits: number of decimals.
        higher_is_better: whether the largest value is the best.

    """

    key: str
    heading: str
    unit: str
    digits: int
    higher_is_better: bool = False

    def text(self, value: float) -> str:
        """Format a value, without a sign before zero."""
        text = f"{value:.{self.digits}f}"
        return text.removeprefix("-") if float(text) == 0 else text


@dataclass(frozen=True)
class Cell:
    """One value of a table, in its column's unit.

    Args:
        mean: mean over seeds, then over scenes.
        spread: sample standard deviation over seeds; None for one seed.
        seeds: number of seeds of the spread; 0 for values without seeds.
        scenes, of: number of scenes with a value, and of all scenes of the row.
        interval: 95 % confidence interval of a percentage of answers.
        rank: 1 for the best displayed value, 2 for the second best; 0 for others and for incomplete averages.

    """

    mean: float
    spread: float | None = None
    seeds: int = 1
    scenes: int = 1
    of: int = 1
    interval: tuple[float, float] | None = None
    rank: int = 0

    def against(self, paper: float | None) -> tuple[float, float | None] | None:
        """Return the difference from the paper's value and the ratio to it; None if they are not comparable."""
        if paper is None or not self.complete:
            return None
        return self.mean - paper, self.mean / paper if paper else None

    @property
    def complete(self) -> bool:
        """Whether all scenes of the row have a value."""
        return self.scenes == self.of


@dataclass(frozen=True)
class Row:
    """The values of a method.

    Args:
        label: name of the method.
        cells: cells by column; missing values have none.
        published: the paper's values by column, if any.
        seeds: maximum number of seeds of a cell.

    """

    label: str
    cells: Mapping[str, Cell]
    published: Mapping[str, float]
    seeds: int = 1


@dataclass(frozen=True)
class Group:
    """The rows of all methods for a scene or an average.

    Args:
        about: scenes.
        rows: methods in order.
        paper_only: the paper's values of methods that were not run.

    """

    about: SceneSet
    rows: tuple[Row, ...]
    paper_only: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class PaperTable:
    """A table like those of the paper.

    Args:
        name: file name without suffix: letters, digits, "_", "-" and "." only.
        title: one line.
        notes: remarks, one sentence each.
        scale, downsampling: degradation of the runs.
        columns: columns with values, in order.
        groups: scenes, then averages.

    """

    name: str
    title: str
    notes: tuple[str, ...]
    scale: float
    downsampling: str
    columns: tuple[Column, ...]
    groups: tuple[Group, ...]

    @property
    def has_published(self) -> bool:
        """Whether some rows have values of the paper."""
        return any(row.published for group in self.groups for row in group.rows)

    @property
    def seeded(self) -> bool:
        """Whether a row has several seeds."""
        return any(row.seeds > 1 for group in self.groups for row in group.rows)

    def published_columns(self) -> tuple[Column, ...]:
        """Return the columns with values of the paper."""
        rows = [row for group in self.groups for row in group.rows]
        return tuple(column for column in self.columns if any(column.key in row.published for row in rows))


@dataclass(frozen=True)
class Style:
    """Formatting of cells in a layout.

    Args:
        missing: text of a missing value.
        marks: text before and after a value, by rank.
        plus_minus: separator between a value and its spread.
        seeds: format of the number of seeds, with ``{}``.
        number: formats a number.

    """

    missing: str
    marks: Mapping[int, tuple[str, str]]
    plus_minus: str
    seeds: str
    number: Callable[[str], str] = str

    def text(self, column: Column, cell: Cell | None, seeds: int) -> str:
        """Format a cell; the number of seeds is added if it differs from that of the row."""
        if cell is None:
            return self.missing
        before, after = self.marks[cell.rank]
        text = f"{before}{self.number(column.text(cell.mean))}{after}"
        if cell.spread is not None:
            text += f" {self.plus_minus} {self.number(column.text(cell.spread))}"
        if cell.interval is not None:
            text += " [{}, {}]".format(*map(column.text, cell.interval))
        if cell.seeds not in (0, seeds):
            text += f" ({self.seeds.format(cell.seeds)})"
        return text if cell.complete else f"{text} ({cell.scenes} of {cell.of})"
