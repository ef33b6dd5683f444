"""Write the tables of docs/measurements/comparison.md: every method on every data set, from runs of eval.py.

    python benchmarks/comparison.py outputs/eval -o comparison [--crop simgeo statue 4 box 120 180 110]

Writes ``comparison.csv`` (one row per data set, scale, degradation and method, the means over the scenes of all
metrics, worst of four lights, raw units) and ``comparison.md``: for each scale and degradation a table of RMSE_v,
DSSIM_v, LPIPS_v and RMSE_d, and one of all sensors' maps, by the metrics of ``metrics=sensor``. In each column the best
value is bold. A mean over fewer scenes than the other methods have is marked with their number.

With ``--crop DATASET SCENE SCALE DEGRADATION TOP LEFT SIDE`` it draws ``crop.jpg``, too: that window of the photo, the
input and all results, rendered, beside the truth; captions are the scene's DSSIM_v and RMSE_v.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
from panel_grid import Panel, rendering_of_input, save_panels

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.evaluation.run_files import load_results
from dsr.metrics.formats import HEADLINES
from dsr.pictures.depth_views import Window, rendering
from dsr.report.shown_scenes import Shown, shown_scenes

Metrics = tuple[tuple[str, float, int], ...]
SHOWN: Metrics = (("RMSE_v", 1e3, 0), ("DSSIM_v", 1e3, 0), ("LPIPS_v", 1e3, 0), ("RMSE_d", 1e3, 0))
"""Metrics of a cell, their factors and digits."""
SHOWN_OF_SENSORS: Metrics = (
    ("Sensor_RMSE_v", 1e3, 0),
    ("Sensor_DSSIM_v", 1e3, 0),
    ("Sensor_angle_mean", 1, 1),
    ("Sensor_RMSE_d", 1e3, 1),
)
APART = ("folder",)
"""Data sets whose scenes have columns of their own."""
TITLES = {
    "simgeo": "SimGeo", "lucy": "Lucy", "plant": "Plant", "middlebury": "Middlebury", "icl": "ICL",
    "ddrnet": "ddrnet, x1", "rgbdd_real": "rgbdd_real, x2.67",
}  # fmt: skip
"""Data sets in the order of the columns."""
FIRST = ("Facets", "Facets (box)", "MSG-V", "MSG-V (published)", "MSG-V (noisy)", "MSG", "MSG (published)")
"""Labels of the rows that come first, if there are such rows."""
PEERS = ("PGSR", "DCTNet", "DORNet-T", "FDKN", "SVLRM")
"""Labels of the rows that come last."""
PANELS = 5
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


def cell(row: pd.Series, best: pd.Series, most: int, metrics: Metrics) -> str:
    """Return a method's values on a data set as the text of a table's cell."""
    parts = []
    for name, factor, digits in metrics:
        if name not in row or pd.isna(row[name]):
            parts.append("-")
            continue
        text = f"{factor * row[name]:.{digits}f}"
        parts.append(f"**{text}**" if row[name] == best[name] else text)
    fewer = f" ({row['scenes']} of {most})" if row["scenes"] < most else ""
    return " / ".join(parts) + fewer


def markdown(means: pd.DataFrame, methods: list[str]) -> str:
    """Return one Markdown table for each scale and degradation, and one of the sensors' maps."""
    lines: list[str] = []
    for downsampling, of_kind in sorted(means.groupby("downsampling"), key=lambda group: group[0].replace("box", "")):
        if downsampling == "measured":
            lines += ["measured:", "", *table(of_kind, methods, SHOWN_OF_SENSORS)]
            continue
        for scale, part in of_kind.groupby("scale"):
            lines += [f"x{scale:g}, {downsampling}:", "", *table(part, methods, SHOWN)]
    return "\n".join(lines)


def table(means: pd.DataFrame, methods: list[str], metrics: Metrics) -> list[str]:
    """Return the lines of a table with a row for each method and a column for each data set."""
    order = [*TITLES.values(), *means["dataset"]]
    datasets = sorted(set(means["dataset"]), key=order.index)
    lines = [f"| method | {' | '.join(datasets)} |", "| --- |" + " --- |" * len(datasets)]
    for label in methods:
        cells = []
        for dataset in datasets:
            those = means[means["dataset"] == dataset]
            most = those["scenes"].max()
            best = those[those["scenes"] == most].min(numeric_only=True)
            mine = those[those["label"] == label]
            cells.append(cell(mine.iloc[0], best, most, metrics) if len(mine) else "-")
        if any(text != "-" for text in cells):
            lines.append(f"| {label} | {' | '.join(cells)} |")
    return [*lines, ""]


def ordered(methods: list[str]) -> list[str]:
    """Return the labels of methods in the order of the rows."""
    return sorted(methods, key=lambda label: FIRST.index(label) if label in FIRST else len(FIRST) + (label in PEERS))


def picture(shown: Shown, top: int, left: int, side: int) -> list[Panel]:
    """Return a window of the photo, the input, all results and the truth, the surfaces lit by e1."""
    scene, window = shown.scene, Window(top, left, side, side).slices
    panels = [
        Panel("photo", scene.rgb.permute(1, 2, 0).numpy()[window]),
        Panel("input", rendering_of_input(scene)[window]),
    ]
    if scene.depth is not None:
        panels.append(Panel("truth", rendering(scene.depth, scene.camera)[window]))
    for label in ordered(list(shown.depths)):
        depth = shown.depths[label]
        if depth is not None:
            found = shown.scores[label]
            caption = f"{label}\n{1e3 * found['DSSIM_v']:.0f} / {1e3 * found['RMSE_v']:.0f}"
            panels.append(Panel(caption, rendering(depth, scene.camera)[window]))
    return panels


def draw_crop(results: Results, path: Path, words: list[str]) -> None:
    """Write the picture of a crop; see the module for the words."""
    dataset, name, scale, downsampling = words[:4]
    problem = BenchmarkSetting(dataset, float(scale), downsampling)
    notes: list[str] = []
    shown = next((each for each in shown_scenes(results, problem, notes) if each.name == name), None)
    if shown is None:
        raise SystemExit(f"--crop: expected a scene of the runs, got {' '.join(words[:4])}")
    top, left, side = map(int, words[4:])
    save_panels(path, picture(shown, top, left, side), PANELS, width=240)


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
    (options.output / "comparison.md").write_text(markdown(means, ordered(results.methods())), encoding="utf-8")
    if options.crop:
        draw_crop(results, options.output / "crop.jpg", options.crop)
    for note in results.notes:
        print(f"note: {note}")


if __name__ == "__main__":
    main()
