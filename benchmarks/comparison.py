"""Write the tables of docs/comparison.md: every method on every data set, from runs of eval.py.

    python benchmarks/comparison.py outputs/eval -o comparison

Writes ``comparison.csv`` (one row per data set, scale, degradation and method, the means over the scenes of all
metrics, worst of four lights, raw units) and ``comparison.md``: for each scale and degradation a table of RMSE_v,
DSSIM_v, LPIPS_v and RMSE_d. In each column the best value is bold. A mean over less scenes than the other methods have
is marked with their number.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from dsr.evaluation.results import Results, load_results
from dsr.metrics.formats import HEADLINES

SHOWN = (("RMSE_v", 1e3, 0), ("DSSIM_v", 1e3, 0), ("LPIPS_v", 1e3, 0), ("RMSE_d", 1e3, 1))
"""Metrics of a cell, their factors and digits."""
APART = ("folder",)
"""Data sets whose scenes have columns of their own."""


def table_of(results: Results) -> pd.DataFrame:
    """Return the mean of each metric over the scenes, one row per setting and method."""
    scores = results.scores
    scores = scores[scores["variant"].isin(HEADLINES)].copy()
    apart = scores["dataset"].isin(APART)
    scores.loc[apart, "dataset"] = scores.loc[apart, "scene"]
    keys = ["downsampling", "scale", "dataset", "label"]
    means = scores.pivot_table(index=keys, columns="metric", values="value", aggfunc="mean", sort=False)
    means.insert(0, "scenes", scores.groupby(keys)["scene"].nunique())
    return means.reset_index()


def cell(row: pd.Series, best: pd.Series, most: int) -> str:
    """Return a method's values on a data set as the text of a table's cell."""
    parts = []
    for name, factor, digits in SHOWN:
        if name not in row or pd.isna(row[name]):
            parts.append("-")
            continue
        text = f"{factor * row[name]:.{digits}f}"
        parts.append(f"**{text}**" if row[name] == best[name] else text)
    fewer = f" ({row['scenes']} of {most})" if row["scenes"] < most else ""
    return " / ".join(parts) + fewer


def markdown(means: pd.DataFrame, methods: list[str]) -> str:
    """Return one Markdown table for each scale and degradation."""
    lines: list[str] = []
    for (downsampling, scale), part in means.groupby(["downsampling", "scale"], sort=False):
        datasets = list(dict.fromkeys(part["dataset"]))
        lines += [f"x{scale:g}, {downsampling}:", "", f"| method | {' | '.join(datasets)} |"]
        lines += ["| --- |" + " --- |" * len(datasets)]
        for label in methods:
            cells = []
            for dataset in datasets:
                those = part[part["dataset"] == dataset]
                complete = those[those["scenes"] == those["scenes"].max()]
                mine = those[those["label"] == label]
                best = complete.min(numeric_only=True)
                cells.append(cell(mine.iloc[0], best, those["scenes"].max()) if len(mine) else "-")
            if any(text != "-" for text in cells):
                lines.append(f"| {label} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Read the runs and write both files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="directories with runs of eval.py below them")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    results = load_results(options.runs)
    means = table_of(results)
    options.output.mkdir(parents=True, exist_ok=True)
    means.to_csv(options.output / "comparison.csv", index=False, float_format="%.6g")
    (options.output / "comparison.md").write_text(markdown(means, results.methods()), encoding="utf-8")
    for note in results.notes:
        print(f"note: {note}")


if __name__ == "__main__":
    main()
