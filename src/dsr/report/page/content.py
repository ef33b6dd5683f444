"""Texts and numbers of a report page: scores, published values, times, settings, links."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd

from dsr.evaluation.results import BenchmarkSetting, Results, Run
from dsr.metrics.formats import Formats
from dsr.report.tables import average_of, in_shown_units, paper_row
from dsr.utils.guards import natural_key

_FOLDERS = {"tables": (".csv", ".md", ".tex"), "metrics": (".csv",), "figures": (".pdf",)}
"""Folders beside the page with files to link to, and their suffixes."""


def metrics_data(results: Results) -> list[dict[str, Any]]:
    """Return the metrics of all runs: heading, unit, digits, and whether higher is better."""
    return [
        {"id": name, "name": each.heading, "unit": each.unit, "digits": each.digits, "higher": each.higher_is_better}
        for name, each in results.formats.items()
    ]


def problem_data(results: Results, problem: BenchmarkSetting) -> dict[str, Any]:
    """Return the scores of a setting in the paper's units, per scene and on average, with the published values."""
    runs = results.of(problem)
    methods = list(dict.fromkeys(run.label for run in runs))
    formats = results.formats
    wide = {id(run): _by_scene(run, formats) for run in runs}
    scenes = list(dict.fromkeys(scene for run in runs for scene in wide[id(run)].index))
    places = {scene: place for place, scene in enumerate(scenes)}
    rows: list[dict[str, Any]] = []
    means: list[dict[str, Any]] = []
    for method in methods:
        own_runs = [run for run in runs if run.label == method]
        tables = [wide[id(run)] for run in own_runs]
        for scene in scenes:
            own = [table.loc[scene] for table in tables if scene in table.index]
            if own:
                paper = _published(scene, own_runs, [scene], formats)
                values = _over_seeds(own)
                rows.append({"scene": scene, "method": method, "seeds": len(own), "values": values, "paper": paper})
        means.append(_mean_row(own_runs, scenes, tables, formats))
    return {
        "dataset": problem.dataset,
        "scale": problem.scale,
        "downsampling": problem.downsampling,
        "methods": methods,
        "scenes": scenes,
        "means": means,
        "rows": sorted(rows, key=lambda row: places[row["scene"]]),
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
    return {"method": runs[0].label, "seeds": len(tables), "values": values, "counts": counts, "paper": paper}


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
