# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How metrics agree on real methods: which ones rank the methods of a scene alike.

    python docs/measurements/scripts/how_metrics_agree.py outputs/eval -o how_metrics_agree

Reads the runs of ``eval.py``, best of ``metrics=suite``, of several methods over several data sets. For each scene and
factor, the methods are ranked by each metric; Kendall's tau-b of two rankings is 1 where they are the same and 0 where
they have nothing in common. Writes ``agreement.csv`` (mean tau over scenes, every metric with every other),
``table.md`` (with a few that stand for the families) and ``agreement.png``. A metric counts if 10 scenes or more have
its values for five methods or more, and a scene if it has all metrics that count.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

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
SCENE = ["dataset", "scene", "scale", "downsampling"]
LEAST_METHODS, LEAST_SCENES = 5, 10
HIGH = 0.7
"""Tau from which on a figure is bold."""


def agreement(matrix: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Return Kendall's tau of the rankings of methods by every two metrics, and of how many scenes it is the mean.

    All of it is of the same scenes: those that have all metrics that enough scenes have.

    Args:
        matrix: of :func:`dsr.report.correlations.metric_matrix`, each column such that lower is better.

    """
    by_scene = matrix.groupby(level=SCENE)
    there = by_scene.count() >= LEAST_METHODS
    kept = there.columns[there.sum() >= LEAST_SCENES]
    scenes = there.index[there[kept].all(axis=1)]
    taus = [by_scene.get_group(scene)[kept].corr(method="kendall") for scene in scenes]
    by_metric = pd.concat(taus).groupby(level=0, sort=False)
    tau = by_metric.mean().where(by_metric.count() >= LEAST_SCENES)  # one that does not vary in a scene has none there
    varying = tau.index[tau.notna().sum() > 1]
    return tau.loc[varying, varying], len(scenes)


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
    tau, scenes = agreement(matrix[list(shown)] * better)
    write(asked.output, tau, {name: f"{shown[name].family}: {shown[name].title}" for name in tau})
    methods = matrix.index.get_level_values("label").nunique()
    print(f"{scenes} scenes, {methods} methods, {len(tau)} metrics")


if __name__ == "__main__":
    main(sys.argv[1:])
