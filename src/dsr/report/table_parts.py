"""What a table of the paper's kind is made of, without a layout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dsr.report.scene_sets import SceneSet

STAR_NOTE = "*: the paper's values are of its own files; the scenes here are others of the same description."


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Args:
        key: the metric as in ``scores.csv``, or a column of the user study.
        heading, unit: for readers; the unit may be empty.
        digits: how many after the point are shown.
        higher_is_better: whether the largest value is the best one.

    """

    key: str
    heading: str
    unit: str
    digits: int
    higher_is_better: bool = False

    def text(self, value: float) -> str:
        """Return a value as it is shown, without a sign before zero."""
        text = f"{value:.{self.digits}f}"
        return text.removeprefix("-") if float(text) == 0 else text


@dataclass(frozen=True)
class Cell:
    """One value of a table, in its column's unit.

    Args:
        mean: over seeds, then over scenes.
        spread: sample standard deviation over seeds; None for one seed.
        seeds: how many the spread is of; 0 for what has nothing to do with seeds.
        scenes, of: how many scenes it rests on, and how many it should.
        interval: 95 % confidence interval of a share of answers.
        rank: 1 for the best shown value, 2 for the second; 0 for others and for averages over fewer scenes.

    """

    mean: float
    spread: float | None = None
    seeds: int = 1
    scenes: int = 1
    of: int = 1
    interval: tuple[float, float] | None = None
    rank: int = 0

    def against(self, paper: float | None) -> tuple[float, float | None] | None:
        """Return its difference from the paper's value and its ratio to it; None where they don't compare."""
        if paper is None or not self.complete:
            return None
        return self.mean - paper, self.mean / paper if paper else None

    @property
    def complete(self) -> bool:
        """Whether it rests on all scenes that it should."""
        return self.scenes == self.of


@dataclass(frozen=True)
class Row:
    """A method's values.

    Args:
        label: its name.
        cells: by column; what is missing has none.
        published: the paper's values by column, where it has any.
        seeds: the most seeds of a cell.

    """

    label: str
    cells: Mapping[str, Cell]
    published: Mapping[str, float]
    seeds: int = 1


@dataclass(frozen=True)
class Group:
    """The methods' rows for a scene or an average.

    Args:
        about: the scenes.
        rows: methods in order.
        paper_only: the paper's values of methods that were not run here; only where the scenes are the paper's own.

    """

    about: SceneSet
    rows: tuple[Row, ...]
    paper_only: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper's kind.

    Args:
        name: of its files; letters, digits, "_", "-" and "." alone.
        title: one line.
        notes: what a reader should know, one sentence each.
        scale, downsampling: of the problem.
        columns: those that have a value, in order.
        groups: scenes, then averages.

    """

    name: str
    title: str
    notes: tuple[str, ...]
    scale: int
    downsampling: str
    columns: tuple[Column, ...]
    groups: tuple[Group, ...]

    @property
    def has_published(self) -> bool:
        """Whether the paper's values stand beside some of ours."""
        return any(row.published for group in self.groups for row in group.rows)

    @property
    def starred(self) -> bool:
        """Whether some of them are of other files of the same description."""
        return any(row.published for group in self.groups if group.about.recreated for row in group.rows)

    @property
    def seeded(self) -> bool:
        """Whether a row is of several seeds."""
        return any(row.seeds > 1 for group in self.groups for row in group.rows)

    def published_columns(self) -> tuple[Column, ...]:
        """Return the columns in which the paper's values stand beside ours."""
        rows = [row for group in self.groups for row in group.rows]
        return tuple(column for column in self.columns if any(column.key in row.published for row in rows))


@dataclass(frozen=True)
class Style:
    """How a layout writes a cell.

    Args:
        missing: for a value that there is not.
        marks: what stands before and after a value, by rank.
        number: writes a number.
        plus_minus: between a value and its spread.
        seeds: says how many seeds there were, ``{}``.

    """

    missing: str
    marks: Mapping[int, tuple[str, str]]
    plus_minus: str
    seeds: str
    number: Callable[[str], str] = str

    def text(self, column: Column, cell: Cell | None, seeds: int) -> str:
        """Return a value with all that belongs to it; a number of seeds that is not the row's is said."""
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
