"""The standings of a leaderboard: one row a method, over all settings and all families of metrics."""

from __future__ import annotations

from typing import Any

import pandas as pd

from dsr.evaluation.results import Results
from dsr.metrics.formats import by_family
from dsr.report.tables import cells_of, values_of


def standings(results: Results) -> list[dict[str, Any]]:
    """Return the methods by mean rank, the best first.

    In each setting (data set, scale, degradation) the methods are ranked by the mean of each metric that all of them
    have, over the scenes that all of them have; equal displayed values share the mean of their places. Ranks are
    averaged within each family of metrics, then over the families, then over settings, so that neither many metrics of
    one kind nor a data set with many scenes decides.

    Returns:
        For each method ``method``, ``rank``, the number of ``settings`` that it has, and ``values``: the mean over all
        settings of each metric, in the unit of tables, for a method that has all of them.

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
