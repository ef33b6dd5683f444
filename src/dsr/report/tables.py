"""Tables like those of the paper for any number of runs: methods x metrics per scene and averaged over scenes.

The model is Voynov et al., *Perceptual Deep Depth Super-Resolution* (ICCV 2019): its summary table and those of its
supplement. A table has no layout; :mod:`dsr.report.table_layouts` writes it.

Scores are averaged over the seeds within each scene, then over the scenes that all methods with the metric have. A
spread is the sample standard deviation over seeds; for an average over scenes, over the averages of the seeds that have
all of its scenes.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import pandas as pd

from dsr.evaluation.results import Results, Run, alignment_note
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import (
    AFTER_THE_PAPER,
    HEADLINES,
    LIGHTS_NOTE,
    PAPER,
    Formats,
    MetricFormat,
    by_family,
    describe_directions,
    in_tables,
)  # fmt: skip
from dsr.report.paper import (
    TITLES,
    Place,
    SceneSet,
    applies,
    implementation_note,
    paper_name,
    paper_row,
    published,
    published_row,
    sets_of_dataset,
    sets_of_summary,
)  # fmt: skip
from dsr.report.significance import LEAST, LEVEL, interval_of_mean, p_of_difference
from dsr.report.study.study_table import PERCENTAGES, check_study, study_cells


@dataclass(frozen=True)
class Cell:
    """One value of a table, in its column's unit.

    Args:
        mean: mean over seeds, then over scenes; NaN if the methods have no scene in common.
        spread: sample standard deviation over seeds; None for one seed.
        seeds: number of seeds of the spread; 0 for values without seeds.
        scenes, of: number of averaged scenes, and of all scenes of the row.
        interval: 95 % confidence interval of a percentage of answers, or of a mean over scenes.
        by_scene: value of each averaged scene.
        significant: whether it is the best, and better than the second best, by a paired test over the scenes.
        rank: 1 for the best displayed value, 2 for the second best; 0 for others.

    """

    mean: float
    spread: float | None = None
    seeds: int = 1
    scenes: int = 1
    of: int = 1
    interval: tuple[float, float] | None = None
    by_scene: tuple[float, ...] = field(default=(), repr=False)
    significant: bool = False
    rank: int = 0

    def against(self, paper: float | None) -> tuple[float, float | None] | None:
        """Return the difference from the paper's value and the ratio to it; None if they are not comparable."""
        if paper is None or not self.complete:
            return None
        return self.mean - paper, self.mean / paper if paper else None

    @property
    def complete(self) -> bool:
        """Whether all scenes of the row are averaged."""
        return self.scenes == self.of


@dataclass(frozen=True)
class Row:
    """The values of a method.

    Args:
        label: name of the method.
        about: scenes.
        scale, downsampling: degradation of the runs.
        seeds: maximum number of seeds of a cell; 0 for the paper's values alone.
        runs: runs of the method; none for the paper's values alone.
        cells: cells by column; missing values have none.
        published: the paper's values by column, if any.

    """

    label: str
    about: SceneSet
    scale: float
    downsampling: str
    seeds: int = 1
    runs: Sequence[Run] = ()
    cells: Mapping[str, Cell] = field(default_factory=dict)
    published: Mapping[str, float] = field(default_factory=dict)


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
    paper_only: tuple[Row, ...]


@dataclass(frozen=True)
class PaperTable:
    """A table like those of the paper.

    Args:
        name: file name without suffix: letters, digits, "_", "-" and "." only.
        title: one line.
        notes: remarks, one sentence each.
        columns: columns with values, in order: metrics as in ``scores.csv``, and percentages of the user study.
        groups: scenes, then averages.

    """

    name: str
    title: str
    notes: tuple[str, ...]
    columns: Formats
    groups: tuple[Group, ...]

    @property
    def rows(self) -> list[Row]:
        """The rows of all groups."""
        return [row for group in self.groups for row in group.rows]

    @property
    def has_published(self) -> bool:
        """Whether some rows have values of the paper."""
        return any(row.published for row in self.rows)

    @property
    def facts(self) -> list[Fact]:
        """The columns before those of values, in layouts for readers."""
        return [fact for fact in FACTS if fact.shown(self.rows)]

    def published_columns(self) -> Formats:
        """Return the columns with values of the paper."""
        return {key: each for key, each in self.columns.items() if any(key in row.published for row in self.rows)}


class Fact(NamedTuple):
    """A column that identifies a row, before the columns of values. A CSV file has all of them.

    Args:
        name: of the column.
        value: of a row; None for a missing one.
        shown: whether tables for readers have it, by their rows; the page asks with all rows of a benchmark setting.
        number: whether it is aligned like numbers; these are left out beside the paper's values.

    """

    name: str
    value: Callable[[Row], str | float | None]
    shown: Callable[[Sequence[Row]], bool] = lambda _: False
    number: bool = False


FACTS = (
    Fact("kind", lambda row: "average" if row.about.average else "scene"),
    Fact("scene", lambda row: row.about.title, lambda _: True),
    Fact("dataset", lambda row: " ".join(dict.fromkeys(place.dataset for place in row.about.places))),
    Fact("scale", lambda row: row.scale),
    Fact("downsampling", lambda row: row.downsampling),
    Fact("method", lambda row: row.label, lambda _: True),
    Fact("seeds", lambda row: row.seeds or None, lambda rows: any(row.seeds > 1 for row in rows), number=True),
)
"""All such columns, from the left. Another one here is in every table."""
_SHARES = {key: MetricFormat(heading, "%", digits=1, higher_is_better=True) for key, heading in PERCENTAGES.items()}
"""The columns of the user study."""


def shown(column: MetricFormat, value: float) -> str:
    """Return a value in its column's unit as text, without a sign before zero."""
    text = column.text(value)
    return text.removeprefix("-") if float(text) == 0 else text


def build_tables(results: Results, study: pd.DataFrame | None = None, *, intervals: bool = False) -> list[PaperTable]:
    """Build the tables of all runs: per scale and degradation a summary, then one table per data set.

    Args:
        results: runs.
        study: table written by ``dsr study collect``: columns ``dataset, scene, scale, downsampling, label``, and
            ``user_first, user_second, user_top2`` in percent with ``_low`` and ``_high`` of each.
        intervals: whether averages have confidence intervals, and the best one is tested against the second best, see
            :mod:`dsr.report.significance`.

    Raises:
        ValueError: the study lacks a column.

    """
    if study is not None:
        check_study(study)
    complete = _truth_is_complete(results)
    tables: list[PaperTable] = []
    for scale, downsampling in dict.fromkeys((run.scale, run.downsampling) for run in results.runs):
        runs = [run for run in results.runs if (run.scale, run.downsampling) == (scale, downsampling)]
        formats = results.formats
        values = values_of(runs, formats)
        make = _Maker(scale, downsampling, results.methods(), values, runs, study, formats, intervals)
        places = list(dict.fromkeys(place for scenes in make.values.values() for place in scenes))
        if not places:
            continue
        apart = {run.dataset for run in runs if run.truth}
        tables += make.tables("summary", "Averages", sets_of_summary(places, complete, apart))
        for dataset in dict.fromkeys(place.dataset for place in places):
            sets = sets_of_dataset([place for place in places if place.dataset == dataset])
            tables += make.tables(dataset, TITLES.get(dataset, dataset), sets)
    return _with_unique_names(tables)


Values = Mapping[str, Mapping[Place, Mapping[str, Mapping[int, float]]]]
"""Scores by label, scene, metric and seed: worst of four lights, in the units of tables; only finite values."""


@dataclass(frozen=True)
class _Maker:
    """Builder of the tables of one scale and degradation.

    Args:
        scale, downsampling: degradation of the runs.
        methods: all labels, in order.
        values: scores.
        runs: runs.
        study: table of the user study.
        formats: formats of the metrics, in column order.
        intervals: whether averages are tested.

    """

    scale: float
    downsampling: str
    methods: Sequence[str]
    values: Values
    runs: Sequence[Run]
    study: pd.DataFrame | None
    formats: Formats
    intervals: bool = False

    @property
    def columns(self) -> Formats:
        """All columns: the metrics, then those of the user study."""
        return {**self.formats, **_SHARES}

    def tables(self, name: str, title: str, sets: Sequence[SceneSet]) -> Iterator[PaperTable]:
        """Yield a table of some sets of scenes for each family of metrics that has a value there."""
        for family, formats in by_family(self.formats).items():
            make = replace(self, formats=formats, study=self.study if family == PAPER else None)
            about = (name, title) if family == PAPER else (f"{name}_{family}", f"{title}, {family}")
            table = make.table(*about, sets)
            if family == PAPER or table.columns:
                yield table

    def table(self, name: str, title: str, sets: Sequence[SceneSet]) -> PaperTable:
        """Build a table of some sets of scenes."""
        places = {place for each in sets for place in each.places}
        labels = [label for label in self.methods if not places.isdisjoint(self.values.get(label, ()))]
        groups = tuple(_ranked(self._group(each, labels), self.columns) for each in sets)
        if self.intervals:
            groups = tuple(_tested(each) if each.about.average else each for each in groups)
        used = {key for group in groups for row in group.rows for key in row.cells}
        columns = {key: each for key, each in self.columns.items() if key in used}
        slug = re.sub(r"[^A-Za-z0-9.-]+", "_", f"{name}_x{self.scale}_{self.downsampling}").strip("._-")
        title = f"{title}, x{self.scale}, {self.downsampling} downsampling"
        apart = any(run.truth and run.dataset in {place.dataset for place in places} for run in self.runs)
        notes = [f"{each.text}." for each in Results(tuple(self.runs)).warnings if apart]
        if note := alignment_note([run for run in self.runs if run.dataset in {place.dataset for place in places}]):
            notes.append(note)
        notes += _remarks([run for run in self.runs if run.dataset in {place.dataset for place in places}], places)
        return PaperTable(slug, title, (*notes, *_notes(groups, columns)), columns, groups)

    def _group(self, about: SceneSet, labels: Sequence[str]) -> Group:
        """Build the rows of some methods; a method without values has an empty row."""
        here = [run for run in self.runs if run.dataset in {place.dataset for place in about.places}]
        scenes = [place.scene for place in about.places]
        rows = []
        degradation = (about, self.scale, self.downsampling)
        cells = {key: cells_of(self.values, labels, about.places, key) for key in self.formats}
        for label in labels:
            runs = [run for run in here if run.label == label]
            valid = {key: of[label] for key, of in cells.items() if label in of}
            found = study_cells(self.study, about.places, self.scale, self.downsampling, label)
            for key, (mean, count, interval) in found.items():
                valid[key] = Cell(mean, None, 0, count, len(about.places), interval)
            row = paper_row(about.published, runs, scenes) if valid else None
            seeds = max([1, *(cell.seeds for cell in valid.values())])
            rows.append(Row(label, *degradation, seeds, runs, valid, self._columns_of(row)))
        ran = {paper_name(run) for run in here if any(row.cells for row in rows if row.label == run.label)}
        others = published()["method"].unique() if about.published and applies(here, scenes) else []
        only = {
            str(name): self._columns_of(published_row(about.published, str(name), self.scale))
            for name in others
            if name not in ran
        }
        paper_only = [Row(name, *degradation, 0, published=values) for name, values in only.items() if values]
        return Group(about, tuple(rows), tuple(paper_only))

    def _columns_of(self, row: pd.Series | None) -> dict[str, float]:
        """Return the paper's values by column."""
        return {} if row is None else {key: float(row[key]) for key in self.columns if pd.notna(row.get(key))}


def values_of(runs: Sequence[Run], formats: Formats) -> Values:
    """Collect the scores of the tables."""
    found: dict[str, dict[Place, dict[str, dict[int, float]]]] = {}
    for run in runs:
        scores = run.scores
        worst = scores[scores["variant"].fillna("").isin(HEADLINES) & scores["metric"].isin(list(formats))]
        for scene, metric, value in zip(worst["scene"], worst["metric"], worst["value"], strict=True):
            by_metric = found.setdefault(run.label, {}).setdefault(Place(run.dataset, scene), {})
            if math.isfinite(value):
                by_metric.setdefault(metric, {})[run.seed] = formats[metric].factor * value
    return found


def _truth_is_complete(results: Results) -> Callable[[Place], bool]:
    """Return a function that determines whether a scene's ground truth has no holes.

    It has none where the scores of some method cover every pixel. Otherwise the stored scene decides; without it, the
    missing pixels are taken for holes of the truth.
    """
    scores = pd.concat([run.scores.assign(dataset=run.dataset) for run in results.runs])
    depth = scores[scores["metric"] == "RMSE_d"]
    shares = depth.groupby(["dataset", "scene"])["valid_share"].max()

    def complete(place: Place) -> bool:
        if shares.get(tuple(place), 0.0) == 1:
            return True
        kept = [run for run in results.runs if run.dataset == place.dataset and run.has_sample(place.scene)]
        truth = kept[0].sample(place.scene).depth if kept else None
        return truth is not None and bool(truth.isfinite().all())

    return complete


def cells_of(values: Values, labels: Sequence[str], places: Sequence[Place], metric: str) -> dict[str, Cell]:
    """Average a metric over seeds, then over the scenes of ``places`` that all methods with the metric there have.

    Returns:
        Cells by label, without the methods that have no value there.

    """
    found = {label: [values.get(label, {}).get(place, {}).get(metric, {}) for place in places] for label in labels}
    found = {label: scenes for label, scenes in found.items() if any(scenes)}
    shared = [number for number, scene in enumerate(zip(*found.values(), strict=True)) if all(scene)]
    if not shared:
        return dict.fromkeys(found, Cell(math.nan, scenes=0, of=len(places)))
    cells = {}
    for label, scenes in found.items():
        valid = [scenes[number] for number in shared]
        by_scene = tuple(statistics.fmean(by_seed.values()) for by_seed in valid)
        seeds = set.intersection(*map(set, valid))  # seeds that have all of these scenes
        averages = [statistics.fmean(by_seed[seed] for by_seed in valid) for seed in sorted(seeds)]
        spread = statistics.stdev(averages) if len(averages) > 1 else None
        counts = max(len(averages), 1), len(valid), len(places)
        cells[label] = Cell(statistics.fmean(by_scene), spread, *counts, by_scene=by_scene)
    return cells


def _ranked(group: Group, columns: Formats) -> Group:
    """Return the group with the best and second best marked.

    Values are compared as displayed, so equal texts share a rank. A single value is not ranked, nor are percentages of
    the user study over fewer scenes than the others'.
    """
    ranks: dict[tuple[str, str], int] = {}
    for name, column in columns.items():
        cells = {row.label: row.cells[name] for row in group.rows if name in row.cells}
        most = max([1, *(cell.scenes for cell in cells.values())])
        values = {label: float(shown(column, cell.mean)) for label, cell in cells.items() if cell.scenes == most}
        order = sorted(set(values.values()), reverse=column.higher_is_better)[:2] if len(values) > 1 else []
        ranks |= {(label, name): order.index(value) + 1 for label, value in values.items() if value in order}
    rows = [
        replace(row, cells={key: replace(cell, rank=ranks.get((row.label, key), 0)) for key, cell in row.cells.items()})
        for row in group.rows
    ]
    return replace(group, rows=tuple(rows))


def _tested(group: Group) -> Group:
    """Return the group of an average with intervals, and the best values that are better than all others marked."""
    rows = []
    for row in group.rows:
        cells = dict(row.cells)
        for key, cell in row.cells.items():
            if not cell.by_scene:
                continue
            others = [other.cells[key] for other in group.rows if other is not row and key in other.cells]
            second = [other.by_scene for other in others if other.rank == 2 and other.by_scene]
            alone = cell.rank == 1 and not any(other.rank == 1 for other in others)
            beats = alone and bool(second) and all(p_of_difference(cell.by_scene, each) < LEVEL for each in second)
            cells[key] = replace(cell, interval=interval_of_mean(cell.by_scene), significant=beats)
        rows.append(replace(row, cells=cells))
    return replace(group, rows=tuple(rows))


def _remarks(runs: Sequence[Run], places: Collection[Place]) -> Iterator[str]:
    """Yield what runs say of the scenes of a table, each with the methods that it holds for, unless it is for all."""
    labels: dict[str, dict[str, None]] = {}
    scenes: dict[str, dict[str, None]] = {}
    for run in runs:
        for scene, texts in run.notes.items():
            for text in texts if Place(run.dataset, scene) in places else ():
                labels.setdefault(text, {})[run.label] = None
                scenes.setdefault(text, {})[scene] = None
    everyone = {run.label for run in runs}
    for text, having in labels.items():
        whose = [] if set(having) == everyone else [", ".join(having)]
        where = [] if len(scenes[text]) == len(places) or whose else [", ".join(scenes[text])]
        yield f"{': '.join((*whose, *where, text))}."


def _notes(groups: Sequence[Group], columns: Formats) -> Iterator[str]:
    """Yield the notes of a table."""
    rows = [row for group in groups for row in group.rows]
    cells = [cell for row in rows for cell in row.cells.values()]
    metrics = {key: each for key, each in columns.items() if key not in _SHARES}
    user = len(metrics) < len(columns)
    direction = describe_directions(metrics)
    if user:
        direction += " and User columns higher" if " of " in direction else ", of User columns higher"
    yield f"{direction[0].upper()}{direction[1:]}."
    if any(each.family == PAPER for each in metrics.values()):
        yield f"{LIGHTS_NOTE}."
    yield "In each group our best displayed value is bold, the second best underlined; equal values share the mark."
    of_paper = [name for name, each in in_tables(KNOWN_FORMATS).items() if each.position != AFTER_THE_PAPER]
    missing = [name for name in of_paper if name not in metrics]
    if 0 < len(missing) < len(of_paper):
        yield f"Not computed: {', '.join(missing)}."
    if any(cell.spread is not None for cell in cells):
        yield "Mean ± sample standard deviation over seeds; seeds are averaged within each scene, then scenes."
    if any(cell.by_scene and cell.interval for cell in cells):
        yield f"[low, high]: 95 % interval of the average, by a bootstrap over the scenes (of {LEAST} or more)."
        yield "*: better than the second best, p < .05 by a paired permutation test; not corrected for many tests."
    if any(not cell.complete for cell in cells):
        yield "(k of n): an average over k of the n scenes, those that all methods with this metric have."
    if not all(cell.scenes for cell in cells):
        yield "(0 of n): no average, because the methods have no scene in common."
    note = implementation_note(row.label for row in rows if row.published)
    if note:
        yield note
    if user:
        yield "User: percentage of answers with the method as most similar (1st), second most similar (2nd), or either."


def _with_unique_names(tables: Sequence[PaperTable]) -> list[PaperTable]:
    """Return the tables with names that are unique on any file system."""
    taken: set[str] = set()
    named = []
    for table in tables:
        name, number = table.name, 2
        while name.casefold() in taken:
            name, number = f"{table.name}_{number}", number + 1
        taken.add(name.casefold())
        named.append(replace(table, name=name))
    return named


def in_shown_units(scores: pd.DataFrame, formats: Formats) -> pd.DataFrame:
    """Return one run's scores as scene x metric, in the units of tables, worst of four lights.

    Args:
        scores: content of one ``scores.csv``.
        formats: formats of its metrics.

    """
    worst = scores[scores["variant"].fillna("").isin(HEADLINES)]
    wide = worst.pivot_table(index="scene", columns="metric", values="value", sort=False)
    columns = {name: each for name, each in in_tables(formats).items() if name in wide}
    return wide[list(columns)].mul(pd.Series({name: each.factor for name, each in columns.items()}, dtype=float))
