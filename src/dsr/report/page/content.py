"""Texts and numbers of a report page: scores, published values, times, settings, links."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from dsr.evaluation.results import BenchmarkSetting, Results, Run
from dsr.metrics.formats import Formats, by_family
from dsr.report.paper import SceneSet, average_of
from dsr.report.tables import FACTS, Fact, Row, cells_of, rows_of, values_of
from dsr.utils.guards import natural_key

_FOLDERS = {"tables": (".csv", ".md", ".tex"), "metrics": (".csv",), "figures": (".pdf",)}
"""Folders beside the page with files to link to, and their suffixes."""


def metrics_data(results: Results) -> list[dict[str, Any]]:
    """Return the metrics of all runs: heading, unit, digits, whether higher is better, and their family."""
    return [
        {"id": name, "name": each.heading, "unit": each.unit, "digits": each.digits, "higher": each.higher_is_better,
         "family": family}
        for family, members in by_family(results.formats).items() for name, each in members.items()
    ]  # fmt: skip


def problem_data(results: Results, problem: BenchmarkSetting) -> dict[str, Any]:
    """Return the scores of a setting in the paper's units, per scene and on average, with the published values."""
    runs, formats = results.of(problem), results.formats
    methods = list(dict.fromkeys(run.label for run in runs))
    scores = values_of(runs, formats)
    places = tuple(dict.fromkeys(place for method in methods for place in scores.get(method, ())))
    scenes = [place.scene for place in places]
    rows: list[Row] = []
    for place in places:
        about = SceneSet(place.scene, (place,), place.scene, average=False)
        having = [method for method in methods if place in scores.get(method, ())]
        rows += rows_of(about, having, runs, scores, formats)
    facts = [fact for fact in FACTS if fact.name != "seeds" and fact.shown(rows)]
    mean = SceneSet("mean", places, average_of(problem.dataset, scenes))
    return {
        "dataset": problem.dataset,
        "scale": problem.scale,
        "downsampling": problem.downsampling,
        "methods": methods,
        "scenes": scenes,
        "means": [_row(row, facts, formats) for row in rows_of(mean, methods, runs, scores, formats)],
        "rows": [_row(row, facts, formats) for row in rows],
        "facts": [{"name": fact.name, "word": not fact.number} for fact in facts],
        "seconds": _seconds(runs, methods),
    }


def _row(row: Row, facts: Sequence[Fact], formats: Formats) -> dict[str, Any]:
    """Return a row; ``values`` are means with spreads, ``counts`` the numbers of scenes of incomplete averages."""
    cells = {key: cell for key, cell in row.cells.items() if cell.scenes}
    counts = {key: cell.scenes for key, cell in row.cells.items() if not cell.complete}
    return {
        **{fact.name: fact.value(row) for fact in facts},
        "seeds": row.seeds,
        "values": {key: [each for each in (cell.mean, cell.spread) if each is not None] for key, cell in cells.items()},
        "counts": counts,
        "paper": {} if counts else {key: value for key, value in row.published.items() if key in formats},
    }


def _seconds(runs: Iterable[Run], methods: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return the computing time in seconds by method and scene, averaged over seeds."""
    found: dict[str, dict[str, list[float]]] = {method: {} for method in methods}
    for run in runs:
        for scene, seconds in run.seconds.items():
            if math.isfinite(seconds):
                found[run.label].setdefault(str(scene), []).append(float(seconds))
    return {
        method: {scene: sum(values) / len(values) for scene, values in scenes.items()}
        for method, scenes in found.items()
    }


def run_data(run: Run) -> dict[str, Any]:
    """Return the settings and versions of a run as text by key."""
    return {
        "folder": run.folder.name,
        "label": run.label,
        "dataset": run.dataset,
        "scale": run.scale,
        "downsampling": run.downsampling,
        "seed": run.seed,
        "settings": flat(run.settings),
        "versions": flat(run.versions),
    }


def flat(values: Mapping[str, Any], above: str = "") -> dict[str, str]:
    """Flatten nested values to text by dotted key."""
    found: dict[str, str] = {}
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{name}.")
        else:
            found[name] = "none" if value is None else str(value)
    return found


def links(folder: Path) -> list[dict[str, str]]:
    """Return the existing files beside the page: name and relative address."""
    names = [
        f"{name}/{path.name}"
        for name, suffixes in _FOLDERS.items()
        for path in sorted((folder / name).glob("*"), key=natural_key)
        if path.suffix in suffixes and path.is_file()
    ]
    return [{"name": name, "address": quote(name)} for name in names]


def standings(results: Results) -> list[dict[str, Any]]:
    """Return the methods by mean rank, the best first, with the means of metrics over all settings, in table units.

    In each setting (data set, scale, degradation) the methods are ranked by the mean of each metric that all of them
    have, over the scenes that all of them have; equal displayed values share the mean of their places. Ranks are
    averaged within each family of metrics, then over the families, then over settings, so that neither many metrics of
    one kind nor a data set with many scenes decides. A method without all settings has no means and stands last.
    """
    formats = results.formats
    ranks: dict[str, list[float]] = {label: [] for label in results.methods()}
    means: dict[str, dict[str, list[float]]] = {label: {} for label in ranks}
    for problem in results.problems():
        values = values_of(results.of(problem), formats)
        places = list(dict.fromkeys(place for scenes in values.values() for place in scenes))
        averages = {name: cells_of(values, list(values), places, name) for name in formats}
        table = pd.DataFrame({name: {label: cell.mean for label, cell in of.items()} for name, of in averages.items()})
        if table.empty:
            continue
        for label, row in table.iterrows():
            for name, value in row.dropna().items():
                means[str(label)].setdefault(str(name), []).append(float(value))
        shared = table.dropna(axis=1)
        places = pd.DataFrame(
            {
                name: shared[name].round(formats[name].digits).rank(ascending=not formats[name].higher_is_better)
                for name in shared
            }
        )
        families = [places[[name for name in members if name in places]] for members in by_family(formats).values()]
        parts = [each.mean(axis=1) for each in families if not each.empty]
        overall = pd.concat(parts, axis=1).mean(axis=1) if parts else pd.Series(dtype=float)
        for label, rank in overall.dropna().items():
            ranks[str(label)].append(float(rank))
    total = len(results.problems())
    rows = [
        {
            "method": label,
            "rank": sum(own) / len(own),
            "settings": len(own),
            "values": {name: [sum(values) / total] for name, values in means[label].items() if len(values) == total},
        }
        for label, own in ranks.items()
        if own
    ]
    return sorted(rows, key=lambda row: (row["settings"] < total, row["rank"]))
