"""Tables like those of the paper for any number of runs: methods x metrics per scene and averaged over scenes.

The model is Voynov et al., *Perceptual Deep Depth Super-Resolution* (ICCV 2019): its summary table and those of its
supplement. A table has no layout; :mod:`dsr.report.markup` writes it.

Scores are averaged over the seeds within each scene, then over scenes. A spread is the sample standard deviation over
seeds; for an average over scenes, over the averages of the seeds that have all of its scenes.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd

from dsr.evaluation.results import Results, Run
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import AFTER_THE_PAPER, HEADLINES, LIGHTS_NOTE, Formats, describe_directions, in_tables
from dsr.report.scene_sets import TITLES, Place, SceneSet, sets_of_dataset, sets_of_summary
from dsr.report.table_parts import Cell, Column, Group, PaperTable, Row
from dsr.report.tables import applies, implementation_note, paper_name, paper_row, published, published_row
from dsr.report.user_study import USER_COLUMNS, check_study, user_cells

_USER = tuple(Column(key, heading, "%", 1, higher_is_better=True) for key, heading in USER_COLUMNS.items())


def build_tables(results: Results, study: pd.DataFrame | None = None) -> list[PaperTable]:
    """Build the tables of all runs: per scale and degradation a summary, then one table per data set.

    Args:
        results: runs.
        study: table written by ``dsr study collect``: columns ``dataset, scene, scale, downsampling, label``, and
            ``user_first, user_second, user_top2`` in percent with ``_low`` and ``_high`` of each.

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
        values = _values(runs, formats)
        make = _Maker(scale, downsampling, results.methods(), values, runs, study, formats)
        places = list(dict.fromkeys(place for scenes in make.values.values() for place in scenes))
        if not places:
            continue
        tables.append(make.table("summary", "Averages", sets_of_summary(places, complete)))
        for dataset in dict.fromkeys(place.dataset for place in places):
            sets = sets_of_dataset([place for place in places if place.dataset == dataset])
            tables.append(make.table(dataset, TITLES.get(dataset, dataset), sets))
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

    """

    scale: float
    downsampling: str
    methods: Sequence[str]
    values: Values
    runs: Sequence[Run]
    study: pd.DataFrame | None
    formats: Formats

    @property
    def columns(self) -> tuple[Column, ...]:
        """All columns: the metrics, then those of the user study."""
        metrics = (
            Column(name, each.heading, each.unit, each.digits, higher_is_better=each.higher_is_better)
            for name, each in self.formats.items()
        )
        return (*metrics, *_USER)

    def table(self, name: str, title: str, sets: Sequence[SceneSet]) -> PaperTable:
        """Build a table of some sets of scenes."""
        places = {place for each in sets for place in each.places}
        labels = [label for label in self.methods if not places.isdisjoint(self.values.get(label, ()))]
        groups = tuple(_ranked(self._group(each, labels), self.columns) for each in sets)
        used = {key for group in groups for row in group.rows for key in row.cells}
        columns = tuple(column for column in self.columns if column.key in used)
        slug = re.sub(r"[^A-Za-z0-9.-]+", "_", f"{name}_x{self.scale}_{self.downsampling}").strip("._-")
        title = f"{title}, x{self.scale}, {self.downsampling} downsampling"
        return PaperTable(
            slug, title, tuple(_notes(groups, columns, self.formats)), self.scale, self.downsampling, columns, groups
        )

    def _group(self, about: SceneSet, labels: Sequence[str]) -> Group:
        """Build the rows of some methods; a method without values has an empty row."""
        here = [run for run in self.runs if run.dataset in {place.dataset for place in about.places}]
        scenes = [place.scene for place in about.places]
        rows = []
        for label in labels:
            own = [self.values[label].get(place, {}) for place in about.places]
            cells = {key: _cell([scene.get(key, {}) for scene in own]) for key in self.formats}
            valid = {key: cell for key, cell in cells.items() if cell is not None} | self._user_cells(about, label)
            row = paper_row(about.published, [run for run in here if run.label == label], scenes) if valid else None
            rows.append(Row(label, valid, self._columns_of(row), max([1, *(cell.seeds for cell in valid.values())])))
        ran = {paper_name(run) for run in here if any(row.cells for row in rows if row.label == run.label)}
        others = published()["method"].unique() if about.published and applies(here, scenes) else []
        only = {
            str(name): self._columns_of(published_row(about.published, str(name), self.scale))
            for name in others
            if name not in ran
        }
        return Group(about, tuple(rows), {name: values for name, values in only.items() if values})

    def _columns_of(self, row: pd.Series | None) -> dict[str, float]:
        """Return the paper's values by column."""
        keys = [column.key for column in self.columns]
        return {} if row is None else {key: float(row[key]) for key in keys if pd.notna(row.get(key))}

    def _user_cells(self, about: SceneSet, label: str) -> dict[str, Cell]:
        """Return the study's cells of a method."""
        found = user_cells(self.study, about.places, self.scale, self.downsampling, label)
        return {key: Cell(mean, None, 0, count, len(about.places), ci) for key, (mean, count, ci) in found.items()}


def _values(runs: Sequence[Run], formats: Formats) -> Values:
    """Collect the scores of the tables."""
    found: dict[str, dict[Place, dict[str, dict[int, float]]]] = {}
    for run in runs:
        scores = run.scores
        shown = scores[scores["variant"].fillna("").isin(HEADLINES) & scores["metric"].isin(list(formats))]
        for scene, metric, value in zip(shown["scene"], shown["metric"], shown["value"], strict=True):
            by_metric = found.setdefault(run.label, {}).setdefault(Place(run.dataset, scene), {})
            if math.isfinite(value):
                by_metric.setdefault(metric, {})[run.seed] = formats[metric].factor * value
    return found


def _truth_is_complete(results: Results) -> Callable[[Place], bool]:
    """Return what tells whether a scene's truth has no hole.

    Where some method's scores rest on every pixel it has none. Otherwise the stored scene decides; without it the holes
    are taken for the truth's.
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


def _cell(scenes: Sequence[Mapping[int, float]]) -> Cell | None:
    """Average one method's values of a metric over seeds, then over scenes; None without values."""
    valid = [by_seed for by_seed in scenes if by_seed]
    if not valid:
        return None
    mean = statistics.fmean(statistics.fmean(by_seed.values()) for by_seed in valid)
    seeds = set.intersection(*map(set, valid))  # seeds that have all of these scenes
    averages = [statistics.fmean(by_seed[seed] for by_seed in valid) for seed in sorted(seeds)]
    spread = statistics.stdev(averages) if len(averages) > 1 else None
    return Cell(mean, spread, max(len(averages), 1), len(valid), len(scenes))


def _ranked(group: Group, columns: Sequence[Column]) -> Group:
    """Return the group with the best and second best marked.

    Values are compared as displayed, so equal texts share a rank. Averages over a subset of the scenes are not ranked,
    and a single value is not ranked.
    """
    ranks: dict[tuple[str, str], int] = {}
    for column in columns:
        cells = {row.label: row.cells[column.key] for row in group.rows if column.key in row.cells}
        shown = {label: float(column.text(cell.mean)) for label, cell in cells.items() if cell.complete}
        order = sorted(set(shown.values()), reverse=column.higher_is_better)[:2] if len(shown) > 1 else []
        ranks |= {(label, column.key): order.index(value) + 1 for label, value in shown.items() if value in order}
    rows = [
        replace(row, cells={key: replace(cell, rank=ranks.get((row.label, key), 0)) for key, cell in row.cells.items()})
        for row in group.rows
    ]
    return replace(group, rows=tuple(rows))


def _notes(groups: Sequence[Group], columns: Sequence[Column], formats: Formats) -> Iterator[str]:
    """Yield the notes of a table."""
    rows = [row for group in groups for row in group.rows]
    cells = [cell for row in rows for cell in row.cells.values()]
    user = any(column.key in USER_COLUMNS for column in columns)
    shown = {column.key: formats[column.key] for column in columns if column.key in formats}
    direction = describe_directions(shown)
    if user:
        direction += " and User columns higher" if " of " in direction else ", of User columns higher"
    yield f"{direction[0].upper()}{direction[1:]}."
    yield f"{LIGHTS_NOTE}."
    yield "In each group our best displayed value is bold, the second best underlined; equal values share the mark."
    of_paper = [name for name, each in in_tables(KNOWN_FORMATS).items() if each.position != AFTER_THE_PAPER]
    missing = [name for name in of_paper if name not in shown]
    if 0 < len(missing) < len(of_paper):
        yield f"Not computed: {', '.join(missing)}."
    if any(cell.spread is not None for cell in cells):
        yield "Mean ± sample standard deviation over seeds; seeds are averaged within each scene, then scenes."
    if any(not cell.complete for cell in cells):
        yield "(k of n): an average over k of the n scenes; it is not compared with the others."
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
