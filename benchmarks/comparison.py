"""Write the tables of docs/comparison.md: every method on every data set, from runs of eval.py.

    python benchmarks/comparison.py outputs/eval -o comparison [--crop simgeo statue 4 box 96 160 96]

Writes ``comparison.csv`` (one row per data set, scale, degradation and method, the means over the scenes of all
metrics, worst of four lights, raw units) and ``comparison.md``: for each scale and degradation a table of RMSE_v,
DSSIM_v, LPIPS_v and RMSE_d. In each column the best value is bold. A mean over less scenes than the other methods have
is marked with their number. With ``--crop DATASET SCENE SCALE DEGRADATION TOP LEFT SIDE`` it draws ``crop.jpg``, too:
that window of the photo, the input and all results, rendered, beside the truth; captions are the scene's DSSIM_v and
RMSE_v.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dsr.evaluation.results import BenchmarkSetting, Results, load_results
from dsr.metrics.formats import HEADLINES
from dsr.report.figures.scenes import Shown, rendering, shown_scenes

SHOWN = (("RMSE_v", 1e3, 0), ("DSSIM_v", 1e3, 0), ("LPIPS_v", 1e3, 0), ("RMSE_d", 1e3, 1))
"""Metrics of a cell, their factors and digits."""
APART = ("folder",)
"""Data sets whose scenes have columns of their own."""
TITLES = {"simgeo": "SimGeo", "lucy": "Lucy", "plant": "Plant", "middlebury": "Middlebury", "icl": "ICL"}
"""Data sets in the order of the columns."""
COLUMNS = 6
"""Panels of a row of the picture."""


def table_of(results: Results) -> pd.DataFrame:
    """Return the mean of each metric over the scenes, one row per setting and method."""
    scores = results.scores
    scores = scores[scores["variant"].isin(HEADLINES)].copy()
    apart = scores["dataset"].isin(APART)
    scores.loc[apart, "dataset"] = scores.loc[apart, "scene"]
    scores["dataset"] = scores["dataset"].map(lambda name: TITLES.get(name, name))
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
    settings = means[["downsampling", "scale"]].drop_duplicates()
    settings = settings.sort_values(["downsampling", "scale"], key=lambda keys: keys.replace("box", ""))
    for downsampling, scale in settings.itertuples(index=False):
        part = means[(means["downsampling"] == downsampling) & (means["scale"] == scale)]
        order = list(TITLES.values())
        datasets = sorted(
            dict.fromkeys(part["dataset"]), key=lambda name: (name not in order, [*order, name].index(name))
        )
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


def picture(shown: Shown, top: int, left: int, side: int) -> Figure:
    """Draw a window of the photo, the input, all results and the truth, the surfaces lit by e1."""
    scene = shown.scene
    window = (slice(top, top + side), slice(left, left + side))
    scale = math.ceil(scene.scale)
    low = rendering(scene.depth_lr, scene.camera_lr, "e1")
    enlarged = np.repeat(np.repeat(low, scale, axis=0), scale, axis=1)
    panels: list[tuple[str, np.ndarray]] = [
        ("photo", scene.rgb.permute(1, 2, 0).numpy()[window]),
        ("input", enlarged[window]),
    ]
    for label, depth in shown.depths.items():
        if depth is not None:
            found = shown.scores[label]
            caption = f"{label}\n{1e3 * found['DSSIM_v']:.0f} / {1e3 * found['RMSE_v']:.0f}"
            panels.append((caption, rendering(depth, scene.camera, "e1")[window]))
    if scene.depth is not None:
        panels.append(("truth", rendering(scene.depth, scene.camera, "e1")[window]))
    rows = -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(1.6 * COLUMNS, 1.95 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (caption, image) in enumerate(panels, start=1):
        axes = figure.add_subplot(rows, COLUMNS, number)
        axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set_title(caption, fontsize=8)
        axes.set_axis_off()
    return figure


def draw_crop(results: Results, path: Path, words: list[str]) -> None:
    """Write the picture of a crop; see the module for the words."""
    dataset, name, scale, downsampling = words[:4]
    problem = BenchmarkSetting(dataset, float(scale), downsampling)
    notes: list[str] = []
    shown = next((each for each in shown_scenes(results, problem, notes) if each.name == name), None)
    if shown is None:
        raise SystemExit(f"--crop: expected a scene of the runs, got {' '.join(words[:4])}")
    options: dict[str, Any] = {"dpi": 150, "pil_kwargs": {"quality": 88}}
    picture(shown, *map(int, words[4:])).savefig(path, **options)


def main() -> None:
    """Read the runs and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="directories with runs of eval.py below them")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--crop", nargs=7, metavar="WORD")
    options = parser.parse_args()
    results = load_results(options.runs)
    means = table_of(results)
    options.output.mkdir(parents=True, exist_ok=True)
    means.to_csv(options.output / "comparison.csv", index=False, float_format="%.6g")
    (options.output / "comparison.md").write_text(markdown(means, results.methods()), encoding="utf-8")
    if options.crop:
        draw_crop(results, options.output / "crop.jpg", options.crop)
    for note in results.notes:
        print(f"note: {note}")


if __name__ == "__main__":
    main()
