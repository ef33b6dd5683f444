"""How metrics agree on real methods: which ones rank the methods of a scene alike.

    python benchmarks/how_metrics_agree.py outputs/eval -o how_metrics_agree

Reads the runs of ``eval.py``, best of ``metrics=suite``, of several methods over several data sets. For each scene and
factor, the methods are ranked by each metric; Kendall's tau-b of two rankings is 1 where they are the same and 0 where
they have nothing in common. Writes ``agreement.csv`` (mean tau over scenes, every metric with every other),
``table.md`` (with a few that stand for the families) and ``agreement.png``. Scenes with fewer than five methods
that have both metrics do not count, nor do metrics without values of 10 scenes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.cluster.hierarchy import leaves_list, linkage
from scipy.spatial.distance import squareform

from dsr.evaluation.run_files import load_results
from dsr.report.correlations import metric_matrix

BESIDE = (
    "RMSE_d", "Depth_AbsRel", "Points_chamfer", "RMSE_v", "Normal_mean", "LPIPS_v", "EvalMDE_RelNormal",
    "EvalMDE_SAWA_H", "DepthPro_F1",
)  # fmt: skip
"""Metrics that the table sets beside all others, of those that are there."""
SUITE = ("paper", "depth", "normals", "points", "boundaries", "evalmde")
"""Families of metrics of an image with a dense truth."""
LEAST_METHODS, LEAST_SCENES = 5, 10
HIGH = 0.7
"""Tau from which on a figure is bold."""


def agreement(matrix: pd.DataFrame) -> pd.DataFrame:
    """Return Kendall's tau of the rankings of the methods by every two metrics, mean over scenes.

    Args:
        matrix: of :func:`dsr.report.correlations.metric_matrix`, each column such that lower is better.

    """
    total = pd.DataFrame(0.0, matrix.columns, matrix.columns)
    count = total.copy()
    for _, scene in matrix.groupby(level=["dataset", "scene", "scale", "downsampling"]):
        tau = scene.corr(method="kendall", min_periods=LEAST_METHODS)
        total += tau.fillna(0)
        count += tau.notna()
    return (total / count).where(count >= LEAST_SCENES)


def write(folder: Path, tau: pd.DataFrame, heads: dict[str, str]) -> None:
    """Write the table, the numbers and the picture."""
    folder.mkdir(parents=True, exist_ok=True)
    tau.to_csv(folder / "agreement.csv", float_format="%.3f")
    beside = [name for name in BESIDE if name in tau]
    short = [heads[name].partition(": ")[2].partition(" (")[0] for name in beside]
    lines = [f"| metric | {' | '.join(short)} |", "| --- " + "| ---: " * len(beside) + "|"]
    for name, row in tau[beside].iterrows():
        values = [f"**{value:.2f}**" if value >= HIGH else f"{value:.2f}" for value in row]
        cells = ["" if name == other else value for other, value in zip(beside, values, strict=True)]
        lines.append(f"| {heads[str(name)]} | {' | '.join(cells)} |")
    (folder / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    order = leaves_list(linkage(squareform(1 - tau.fillna(0).to_numpy().clip(-1, 1), checks=False), "average"))
    names = tau.columns[order]
    figure = Figure(figsize=(11, 9.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = axes.imshow(tau.loc[names, names].to_numpy(), cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_yticks(range(len(names)), [heads[name] for name in names], fontsize=7)
    axes.set_xticks(range(len(names)), [heads[name] for name in names], fontsize=7, rotation=90)
    figure.colorbar(image, label="Kendall's tau of two rankings of the methods, mean over scenes", shrink=0.6)
    figure.savefig(folder / "agreement.png")


def main(arguments: list[str]) -> None:
    """Read the runs, and write what they say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="runs of eval.py, or folders of them")
    parser.add_argument("-o", "--output", type=Path, required=True)
    asked = parser.parse_args(arguments)
    results = load_results(asked.runs)
    matrix = metric_matrix(results)
    shown = {name: each for name, each in results.formats.items() if name in matrix and each.family in SUITE}
    better = pd.Series({name: -1 if each.higher_is_better else 1 for name, each in shown.items()})
    tau = agreement(matrix[list(shown)] * better)
    alone = np.eye(len(tau), dtype=bool)
    kept = [name for name in tau if tau.loc[name].where(~alone[tau.columns.get_loc(name)]).notna().any()]
    write(asked.output, tau.loc[kept, kept], {name: f"{shown[name].family}: {shown[name].title}" for name in kept})
    scenes = matrix.groupby(level=["dataset", "scene", "scale", "downsampling"]).size()
    methods = matrix.index.get_level_values("label").nunique()
    print(f"{len(scenes)} scenes, {methods} methods, {len(matrix)} results, {len(kept)} metrics")


if __name__ == "__main__":
    main(sys.argv[1:])
