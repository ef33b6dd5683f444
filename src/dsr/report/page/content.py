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
from dsr.report.paper import Place, SceneSet, average_of, paper_row
from dsr.report.tables import FACTS, Row, in_shown_units
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
    runs = results.of(problem)
    methods = list(dict.fromkeys(run.label for run in runs))
    formats = results.formats
    wide = {id(run): _by_scene(run, formats) for run in runs}
    scenes = list(dict.fromkeys(scene for run in runs for scene in wide[id(run)].index))
    places = [Place(problem.dataset, scene) for scene in scenes]
    of_method = {method: [run for run in runs if run.label == method] for method in methods}
    single = [
        (Row(method, SceneSet(place.scene, (place,), average=False), *problem[1:], len(own), own_runs), own)
        for place in places
        for method, own_runs in of_method.items()
        if (own := [table.loc[place.scene] for run in own_runs if place.scene in (table := wide[id(run)]).index])
    ]
    facts = [fact for fact in FACTS if fact.name != "seeds" and fact.shown([row for row, _ in single])]
    rows = [
        {
            **{fact.name: fact.value(row) for fact in facts},
            "seeds": row.seeds,
            "values": _over_seeds(own),
            "paper": _published(row.about.title, row.runs, [row.about.title], formats),
        }
        for row, own in single
    ]
    means = []
    for method, own_runs in of_method.items():
        mean = Row(method, SceneSet("mean", tuple(places)), *problem[1:], len(own_runs), own_runs)
        words = {fact.name: fact.value(mean) for fact in facts if fact.name != "scene"}
        means.append(words | _mean_row(own_runs, scenes, [wide[id(run)] for run in own_runs], formats))
    return {
        "dataset": problem.dataset,
        "scale": problem.scale,
        "downsampling": problem.downsampling,
        "methods": methods,
        "scenes": scenes,
        "means": means,
        "rows": rows,
        "facts": [{"name": fact.name, "word": not fact.number} for fact in facts],
        "seconds": _seconds(runs, methods),
    }


def _by_scene(run: Run, formats: Formats) -> pd.DataFrame:
    """Return the scores of a run, scene x metric, in the units of tables."""
    table = in_shown_units(run.scores, formats)
    table.index = table.index.map(str)
    return table


def _over_seeds(series: Sequence[pd.Series]) -> dict[str, list[float]]:
    """Return by metric the mean over seeds and, for several seeds, their sample standard deviation."""
    values: dict[str, list[float]] = {}
    together = pd.DataFrame(list(series)).astype(float)
    for name in together:
        valid = together[name].dropna()
        if len(valid):
            mean = float(valid.mean())
            values[str(name)] = [mean] if len(valid) < 2 else [mean, float(valid.std(ddof=1))]
    return {name: numbers for name, numbers in values.items() if all(map(math.isfinite, numbers))}


def _mean_row(runs: Sequence[Run], scenes: list[str], tables: list[pd.DataFrame], formats: Formats) -> dict[str, Any]:
    """Return a method's averages over scenes; ``counts`` has the number of scenes of each incomplete metric."""
    values = _over_seeds([table.mean() for table in tables])
    seen: dict[str, set[str]] = {name: set() for name in values}
    for table in tables:
        for name in values:
            if name in table:
                seen[name] |= set(table.index[table[name].notna()])
    counts = {name: len(found) for name, found in seen.items() if len(found) < len(scenes)}
    paper = {} if counts else _published(average_of(runs[0].dataset, scenes), runs, scenes, formats)
    return {"seeds": len(tables), "values": values, "counts": counts, "paper": paper}


def _published(name: str, runs: Sequence[Run], scenes: Sequence[str], formats: Formats) -> dict[str, float]:
    """Return the paper's values by metric; empty where they do not apply."""
    row = paper_row(name, runs, scenes)
    return {} if row is None else {name: float(row[name]) for name in formats if pd.notna(row.get(name))}


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


def links(folder: Path, tables: Sequence[Path] | None) -> list[dict[str, str]]:
    """Return the existing files beside the page: name and relative address."""
    paths = [
        path
        for name, suffixes in _FOLDERS.items()
        if name != "tables" or tables is None
        for path in sorted((folder / name).glob("*"), key=natural_key)
        if path.suffix in suffixes and path.is_file()
    ]
    named = [path for path in tables or () if path.is_file() and path.resolve().is_relative_to(folder.resolve())]
    relative = [path.resolve().relative_to(folder.resolve()).as_posix() for path in [*named, *paths]]
    return [{"name": name, "address": quote(name)} for name in dict.fromkeys(relative)]
