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
from dsr.report.study.percentages import PERCENTAGES, check_study, study_cells


@dataclass(frozen=True)
class Cell:
    """One value of a table, in its column's unit."""

    mean: float  # over seeds, then over scenes; NaN if the methods have no scene in common
    spread: float | None = None  # sample standard deviation over seeds; None for one seed
    seeds: int = 1  # of the spread; 0 for values without seeds
    scenes: int = 1  # averaged ones
    of: int = 1  # all scenes of the row
    interval: tuple[float, float] | None = None  # 95 %, of a percentage of answers or of a mean over scenes
    by_scene: tuple[float, ...] = field(default=(), repr=False)  # value of each averaged scene
    significant: bool = False  # whether it is the best, and better than the second best by a paired test
    rank: int = 0  # 1 for the best displayed value, 2 for the second best; 0 for others

    @property
    def complete(self) -> bool:
        """Whether all scenes of the row are averaged."""
        return self.scenes == self.of


@dataclass(frozen=True)
class Row:
    """The values of a method."""

    label: str
    about: SceneSet
    scale: float
    downsampling: str
    seeds: int = 1  # maximum number of seeds of a cell; 0 for the paper's values alone
    cells: Mapping[str, Cell] = field(default_factory=dict)  # by column; missing values have none
    published: Mapping[str, float] = field(default_factory=dict)  # the paper's values by column

    def against_paper(self, key: str) -> tuple[float | None, float | None]:
        """Return the difference from the paper's value and the ratio to it; None if they are not comparable."""
        cell, paper = self.cells.get(key), self.published.get(key)
        if cell is None or paper is None or not cell.complete:
            return None, None
        return cell.mean - paper, cell.mean / paper if paper else None


@dataclass(frozen=True)
class Group:
    """The rows of all methods for a scene or an average."""

    about: SceneSet
    rows: tuple[Row, ...]
    paper_only: tuple[Row, ...]  # the paper's values of methods that were not run


@dataclass(frozen=True)
class PaperTable:
    """A table like those of the paper."""

    name: str  # file name without suffix: letters, digits, "_", "-" and "." only
    title: str
    notes: tuple[str, ...]  # one sentence each
    columns: Formats  # metrics as in ``scores.csv``, and percentages of the user study
    groups: tuple[Group, ...]  # scenes, then averages

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

    @property
    def published_columns(self) -> Formats:
        """The columns with values of the paper."""
        return {key: each for key, each in self.columns.items() if any(key in row.published for row in self.rows)}


class Fact(NamedTuple):
    """A column that identifies a row, before the columns of values. A CSV file has all of them."""

    name: str
    value: Callable[[Row], str | float | None]
    shown: Callable[[Sequence[Row]], bool] = lambda _: False  # whether tables for readers have it, by their rows
    number: bool = False  # aligned like numbers, and left out beside the paper's values


# All such columns, from the left. Another one here is in every table.
FACTS = (
    Fact("kind", lambda row: "average" if row.about.average else "scene"),
    Fact("scene", lambda row: row.about.title, lambda _: True),
    Fact("dataset", lambda row: " ".join(dict.fromkeys(place.dataset for place in row.about.places))),
    Fact("scale", lambda row: row.scale),
    Fact("downsampling", lambda row: row.downsampling),
    Fact("method", lambda row: row.label, lambda _: True),
    Fact("seeds", lambda row: row.seeds or None, lambda rows: any(row.seeds > 1 for row in rows), number=True),
)
# The columns of the user study
_SHARES = {key: MetricFormat(heading, "%", digits=1, higher_is_better=True) for key, heading in PERCENTAGES.items()}


# Scores by label, scene, metric and seed: worst of four lights, in the units of tables; only finite values
Values = Mapping[str, Mapping[Place, Mapping[str, Mapping[int, float]]]]


def shown(column: MetricFormat, value: float) -> str:
    """Return a value in its column's unit as text, without a sign before zero."""
    text = column.text(value)
    return text.removeprefix("-") if float(text) == 0 else text


def build_tables(results: Results, study: pd.DataFrame | None = None, *, intervals: bool = False) -> list[PaperTable]:
    """Build the tables of all runs: per scale and degradation a summary, then one table per data set.

    ``study`` is a table that ``dsr study collect`` wrote. With ``intervals``, averages have confidence intervals, and
    the best one is tested against the second best, see :mod:`dsr.report.significance`.
    """
    if study is not None:
        check_study(study)
    complete = _truth_is_complete(results)
    every = results.formats
    tables: list[PaperTable] = []
    names: set[str] = set()
    for scale, downsampling in dict.fromkeys((run.scale, run.downsampling) for run in results.runs):
        runs = [run for run in results.runs if (run.scale, run.downsampling) == (scale, downsampling)]
        values = values_of(runs, every)
        places = list(dict.fromkeys(place for scenes in values.values() for place in scenes))
        if not places:
            continue
        apart = {run.dataset for run in runs if run.truth}
        kinds = [("summary", "Averages", sets_of_summary(places, complete, apart))]
        for dataset in dict.fromkeys(place.dataset for place in places):
            sets = sets_of_dataset([place for place in places if place.dataset == dataset])
            kinds.append((dataset, TITLES.get(dataset, dataset), sets))
        for name, title, sets in kinds:
            shown_places = {place for each in sets for place in each.places}
            labels = [label for label in results.methods() if not shown_places.isdisjoint(values.get(label, ()))]
            for family, formats in by_family(every).items():
                paper = family == PAPER
                groups = [_group(each, labels, runs, values, formats, study if paper else None) for each in sets]
                if intervals:
                    groups = [_tested(each) if each.about.average else each for each in groups]
                stem, heading = (name, title) if paper else (f"{name}_{family}", f"{title}, {family}")
                heading = f"{heading}, x{scale}, {downsampling} downsampling"
                table = _table(heading, runs, groups, formats)
                if paper or table.columns:
                    tables.append(replace(table, name=unique_name(f"{stem}_x{scale}_{downsampling}", names)))
    return tables


def unique_name(stem: str, taken: set[str]) -> str:
    """Return a file name that no other one of them equals on any file system, and add it to them."""
    slug = re.sub(r"[^A-Za-z0-9.-]+", "_", stem).strip("._-")
    name, number = slug, 2
    while name.casefold() in taken:
        name, number = f"{slug}_{number}", number + 1
    taken.add(name.casefold())
    return name


def _table(title: str, runs: Sequence[Run], groups: Sequence[Group], formats: Formats) -> PaperTable:
    """Build a table, without its name, of the columns that have values."""
    used = {key for group in groups for row in group.rows for key in row.cells}
    columns = {key: each for key, each in {**formats, **_SHARES}.items() if key in used}
    places = {place for group in groups for place in group.about.places}
    datasets = {place.dataset for place in places}
    here = [run for run in runs if run.dataset in datasets]
    notes = [f"{each.text}." for each in Results(tuple(runs)).warnings if any(run.truth for run in here)]
    notes += [note for note in [alignment_note(here)] if note]
    return PaperTable("", title, (*notes, *_remarks(here, places), *_notes(groups, columns)), columns, tuple(groups))


def _group(
    about: SceneSet,
    labels: Sequence[str],
    runs: Sequence[Run],
    values: Values,
    formats: Formats,
    study: pd.DataFrame | None,
) -> Group:
    """Build the rows of some methods, and those of the paper alone."""
    datasets = {place.dataset for place in about.places}
    here = [run for run in runs if run.dataset in datasets]
    rows = rows_of(about, labels, here, values, formats, study)
    scale, downsampling = runs[0].scale, runs[0].downsampling
    ran = {paper_name(run) for run in here if any(row.cells for row in rows if row.label == run.label)}
    only = []
    if about.published and applies(here, [place.scene for place in about.places]):
        for name in map(str, published()["method"].unique()):
            found = _columns_of(published_row(about.published, name, scale), formats)
            if found and name not in ran:
                only.append(Row(name, about, scale, downsampling, 0, published=found))
    return Group(about, _ranked(rows, {**formats, **_SHARES}), tuple(only))


def rows_of(
    about: SceneSet,
    labels: Sequence[str],
    runs: Sequence[Run],
    values: Values,
    formats: Formats,
    study: pd.DataFrame | None = None,
) -> list[Row]:
    """Build the rows of some methods for a scene or an average, from runs of one scale and degradation."""
    scale, downsampling = runs[0].scale, runs[0].downsampling
    scenes = [place.scene for place in about.places]
    cells = {key: cells_of(values, labels, about.places, key) for key in formats}
    rows = []
    for label in labels:
        own = {key: of[label] for key, of in cells.items() if label in of}
        for key, (mean, count, interval) in study_cells(study, about.places, scale, downsampling, label).items():
            own[key] = Cell(mean, None, 0, count, len(about.places), interval)
        of_method = [run for run in runs if run.label == label]
        paper = _columns_of(paper_row(about.published, of_method, scenes) if own else None, formats)
        seeds = max([1, *(cell.seeds for cell in own.values())])
        rows.append(Row(label, about, scale, downsampling, seeds, own, paper))
    return rows


def _columns_of(row: pd.Series | None, formats: Formats) -> dict[str, float]:
    if row is None:
        return {}
    return {key: float(row[key]) for key in (*formats, *_SHARES) if pd.notna(row.get(key))}


def values_of(runs: Sequence[Run], formats: Formats) -> Values:
    """Collect the scores of the tables."""
    found: dict[str, dict[Place, dict[str, dict[int, float]]]] = {}
    for run in runs:
        for scene, scores in run.headlines.items():
            by_metric = found.setdefault(run.label, {}).setdefault(Place(run.dataset, scene), {})
            for metric, value in scores.items():
                if metric in formats and math.isfinite(value):
                    by_metric.setdefault(metric, {})[run.seed] = formats[metric].factor * value
    return found


def _truth_is_complete(results: Results) -> Callable[[Place], bool]:
    """Return a function that determines whether a scene's ground truth has no holes.

    It has none where the scores of some method cover every pixel. Otherwise the stored scene decides; without it, the
    missing pixels are taken for holes of the truth.
    """
    depth = results.scores.query("metric == 'RMSE_d'")
    shares = depth.groupby(["dataset", "scene"])["valid_share"].max()

    def complete(place: Place) -> bool:
        if shares.get(tuple(place), 0.0) == 1:
            return True
        kept = [run for run in results.runs if run.dataset == place.dataset and run.has_sample(place.scene)]
        truth = kept[0].sample(place.scene).depth if kept else None
        return truth is not None and bool(truth.isfinite().all())

    return complete


def cells_of(values: Values, labels: Sequence[str], places: Sequence[Place], metric: str) -> dict[str, Cell]:
    """Average a metric over seeds, then over the scenes that all methods with the metric there have; cells by label."""
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


def _ranked(rows: Sequence[Row], columns: Formats) -> tuple[Row, ...]:
    """Return the rows of a group with the best and second best values marked.

    Values are compared as displayed, so equal texts share a rank. A single value is not ranked, nor are percentages of
    the user study over fewer scenes than the others'.
    """
    ranked = [dict(row.cells) for row in rows]
    for name, column in columns.items():
        most = max([1, *(cells[name].scenes for cells in ranked if name in cells)])
        compared = [cells for cells in ranked if name in cells and cells[name].scenes == most]
        if len(compared) > 1:
            values = [float(shown(column, cells[name].mean)) for cells in compared]
            order = sorted(set(values), reverse=column.higher_is_better)[:2]
            for cells, value in zip(compared, values, strict=True):
                if value in order:
                    cells[name] = replace(cells[name], rank=order.index(value) + 1)
    return tuple(replace(row, cells=cells) for row, cells in zip(rows, ranked, strict=True))


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
