"""Correlation of metrics with each other and with LPIPS_v over all results.

This is the study of metrics of Voynov et al., *Perceptual Deep Depth Super-Resolution* (ICCV 2019): every result of any
method, scene and scale is a point; correlations are Pearson's and Spearman's. Beside them stand those of the values in
the paper's tables.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from dsr.evaluation.results import Results
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.metrics.formats import HEADLINES, LIGHTS_NOTE, in_tables
from dsr.report.paper import published
from dsr.report.table_layouts import MISSING, aligned, escaped
from dsr.utils.files import replacing, write_text

Kind = Literal["pearson", "spearman"]
KINDS: tuple[Kind, ...] = ("pearson", "spearman")
REFERENCE = "LPIPS_v"
DEPTH_LIMIT = 0.5
"""Limit at which RMSE_d is clipped as in the paper, metres, because of a few outliers."""
_ABOUT = ["dataset", "scene", "scale", "downsampling", "label", "seed"]
_LEAST = 3
"""Minimum number of points of a correlation."""


def metric_matrix(results: Results) -> pd.DataFrame:
    """Return a table with one row per result and one column per version of a metric, in raw units, NaN where missing.

    Columns are ``DSSIM_v`` for the worst of the four lights, ``DSSIM_v[e1]`` to ``[e4]`` and ``[avg]``, metrics without
    lights by their name. RMSE_d is clipped at 0.5 m.
    """
    scores = results.scores
    variant = scores["variant"].fillna("")
    name = scores["metric"].where(variant.isin(HEADLINES), scores["metric"] + "[" + variant + "]")
    scores = scores.assign(name=name, value=scores["value"].where(np.isfinite(scores["value"])))
    scores = scores.drop_duplicates([*_ABOUT, "name"], keep="last")
    matrix = scores.pivot(index=_ABOUT, columns="name", values="value")
    matrix = matrix.reindex(columns=list(dict.fromkeys(name))).rename_axis(columns=None)
    if "RMSE_d" in matrix:
        matrix["RMSE_d"] = matrix["RMSE_d"].clip(upper=DEPTH_LIMIT)
    return matrix


def published_matrix() -> pd.DataFrame:
    """Return the values in the paper's tables as :func:`metric_matrix` does: one row per scene, method and scale."""
    table = published()
    table = table[~table["scene"].str.startswith("Average")].set_index(["scene", "method", "scale"])
    matrix = pd.DataFrame({name: table[name] / each.factor for name, each in in_tables(KNOWN_FORMATS).items()
                           if name in table})  # fmt: skip
    matrix["RMSE_d"] = matrix["RMSE_d"].clip(upper=DEPTH_LIMIT)
    return matrix


def correlate(matrix: pd.DataFrame, kind: Kind) -> pd.DataFrame:
    """Return the correlation of each pair of columns; NaN for a constant column or fewer than three rows with both."""
    return matrix.astype(float).corr(method=kind, min_periods=_LEAST)


def pairs(matrix: pd.DataFrame) -> pd.DataFrame:
    """Count for every pair of columns the rows with both values."""
    present = matrix.notna().astype(int)
    return present.T @ present


def with_reference(matrix: pd.DataFrame) -> pd.DataFrame:
    """Correlate every other version of a metric with LPIPS_v: ``metric, pearson, spearman, n``, the largest first."""
    names = [name for name in matrix if not str(name).startswith(REFERENCE)] if REFERENCE in matrix else []
    frame = pd.DataFrame({"metric": pd.Series(names, dtype=str)})
    for kind in KINDS:
        found = correlate(matrix, kind)
        frame[kind] = [float(found.loc[name, REFERENCE]) for name in names]
    counts = pairs(matrix)
    frame["n"] = [int(counts.loc[name, REFERENCE]) for name in names]
    return frame.sort_values("spearman", ascending=False, kind="stable", ignore_index=True)


def write_correlations(folder: Path, results: Results) -> list[Path]:
    """Write the correlations of all versions of all metrics, and return the files.

    They are ``pearson.csv``, ``spearman.csv``, ``pairs.csv`` (number of results per pair), ``with_lpips.csv`` and
    ``with_lpips.md``, both with the correlations in the paper's tables beside ours.
    """
    matrix = metric_matrix(results)
    paper = with_reference(published_matrix()).add_prefix("paper_").rename(columns={"paper_metric": "metric"})
    ranking = with_reference(matrix).merge(paper, "left", "metric").astype({"paper_n": "Int64"})
    tables = {kind: correlate(matrix, kind) for kind in KINDS} | {"pairs": pairs(matrix)}
    paths = []
    for name, table in tables.items():
        paths.append(folder / f"{name}.csv")
        with replacing(paths[-1]) as temporary:
            table.to_csv(temporary, index_label="metric")
    paths.append(folder / "with_lpips.csv")
    with replacing(paths[-1]) as temporary:
        ranking.to_csv(temporary, index=False)
    paths.append(folder / "with_lpips.md")
    write_text(paths[-1], _ranking_text(ranking, len(matrix)))
    return paths


def _ranking_text(ranking: pd.DataFrame, count: int) -> str:
    """Format the table of correlations with LPIPS_v as Markdown."""
    title = f"## Correlation with {REFERENCE}\n\n"
    if ranking.empty:
        return f"{title}There is no {REFERENCE} in these {count} results (metrics.lpips=true computes it).\n"
    rows = [
        [
            escaped(str(row["metric"])),
            *(_coefficient(row[kind]) for kind in KINDS),
            str(row["n"]),
            *(_coefficient(row[f"paper_{kind}"]) for kind in KINDS),
        ]
        for _, row in ranking.iterrows()
    ]
    paper = ranking["paper_n"].max()
    text = (
        f"Over {count} results of all methods, scenes and scales. {LIGHTS_NOTE}, by a name by itself; "
        f"RMSE_d is clipped at {DEPTH_LIMIT:g} m. n: number of results with both metrics."
    )
    if pd.notna(paper):
        text += f" Paper: the same over the {paper} results in the tables of Voynov et al. 2019."
    head = ["metric", "Pearson", "Spearman", "n", "Pearson, paper", "Spearman, paper"]
    return f"{title}{text}\n\n{aligned(head, rows, 1)}\n"


def _coefficient(value: float) -> str:
    return MISSING if np.isnan(value) else f"{value:.3f}"
