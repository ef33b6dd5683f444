"""The pictures and tables of the documentation.

    python benchmarks/pictures.py crops --shared DIR [--only NAME,...] [--methods bilateral,tgv,...] [-o DIR]
    python benchmarks/pictures.py comparison RUNS... -o DIR [--crop simgeo statue 4 box 120 180 110]
    python benchmarks/pictures.py registration --rgb PHOTO --depth MAP [--depth-unit UNIT] -o FILE.jpg
    python benchmarks/pictures.py growth CSV -o growth.svg

Each command has its own ``--help``.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import matplotlib as mpl
import numpy as np
import pandas as pd
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from quality import CAPTURES, Capture, run_method
from torch import Tensor

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.evaluation.run_files import load_results
from dsr.geometry.lights import FIGURE_LIGHT
from dsr.geometry.registration import find_displacement, find_edges, undo
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import Reading, parse_unit
from dsr.methods.recipe import read_recipe
from dsr.metrics.formats import HEADLINES
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.pictures.depth_views import Window, rendering
from dsr.report.shown_scenes import Shown, shown_of, views_of
from dsr.sample import DepthSample
from dsr.utils.files import replacing
from dsr.utils.ratios import round_ratio

SHARED = Path(os.environ.get("DSR_SHARED", "../shared"))
_DPI, _FONT, _LINE = 100, 10, 18
_GAP, _MARGIN = 8, 10


class Panel(NamedTuple):
    """A caption of one line or more, and a picture: (h, w), NaN in holes, or (h, w, 3), both in [0, 1]."""

    caption: str
    picture: np.ndarray


EMPTY = Panel("", np.ones((1, 1)))


def rendering_of_input(sample: DepthSample) -> np.ndarray:
    """Render the low-resolution map at its own resolution, then repeat its pixels: (H, W), NaN in holes."""
    return repeat_pixels(rendering(sample.depth_lr, sample.camera_lr), (sample.camera.height, sample.camera.width))


def repeat_pixels(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Enlarge a picture, (h, w), to a height and width by repeating its pixels."""
    rows, columns = ((np.arange(new) + 0.5) * (old / new) for new, old in zip(size, picture.shape, strict=True))
    return picture[rows.astype(int)][:, columns.astype(int)]


def save_panels(path: Path, panels: Sequence[Panel], columns: int, heading: str = "", width: int = 384) -> None:
    """Write a picture of panels in rows.

    Args:
        path: a JPEG file.
        panels: in reading order, of one size, the first no ``EMPTY`` one.
        columns: panels of a row.
        heading: a text above them, of one line or more; empty for none.
        width: of a panel, pixels. Smaller pictures are enlarged by repeating pixels, larger ones averaged.

    """
    images = [_fit(panel.picture, width) for panel in panels]
    height = images[0].shape[0]
    lines = max(panel.caption.count("\n") + 1 for panel in panels)
    pitch = _LINE * lines + height + _GAP
    above = _MARGIN + (_LINE * (heading.count("\n") + 1) + _GAP if heading else 0)
    page = (2 * _MARGIN + columns * (width + _GAP) - _GAP, above + -(-len(panels) // columns) * pitch + _MARGIN - _GAP)
    figure = Figure(figsize=(page[0] / _DPI, page[1] / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    style: dict[str, Any] = {"fontsize": _FONT, "parse_math": False, "linespacing": 1.2}
    if heading:
        figure.text(_MARGIN / page[0], 1 - _MARGIN / page[1], heading, va="top", **style)
    for number, (panel, image) in enumerate(zip(panels, images, strict=True)):
        if panel is EMPTY:
            continue
        left = _MARGIN + number % columns * (width + _GAP)
        top = page[1] - above - number // columns * pitch - _LINE * lines  # upper edge of the picture, from below
        figure.text((left + width / 2) / page[0], (top + 4) / page[1], panel.caption, ha="center", va="bottom", **style)
        figure.figimage(image, left, top - height)
    figure.savefig(path, dpi=_DPI, pil_kwargs={"quality": 88})


def _fit(picture: np.ndarray, width: int) -> np.ndarray:
    """Return a picture as (h, width, 3) in [0, 1], its holes in the hole colour."""
    coloured = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    holes = np.isnan(coloured).any(axis=2, keepdims=True)
    coloured = np.where(holes, to_rgb(HOLE_COLOUR), coloured).astype(np.float32)
    size = (width, round(width * picture.shape[0] / picture.shape[1]))
    kind = cv2.INTER_AREA if width < picture.shape[1] else cv2.INTER_NEAREST
    return cv2.resize(coloured, size, interpolation=kind).clip(0, 1)


COLUMNS = 4


def describe(capture: Capture, found: dict[str, float] | None) -> str:
    """Return scores as a line of text, with the line break before it; empty without scores."""
    if found is None:
        return ""
    text = f"\n{found['angle']:.1f}° / {1e3 * found['RMSE_v']:.0f}"
    return f"{text} / {100 * found['covered']:.0f} %" if capture.measured else text


def panels_of(capture: Capture, methods: list[str], shared: Path, device: str) -> list[Panel]:
    """Return the pictures of a whole capture: photo, input, results and truth, each (H, W) or (H, W, 3)."""
    sample = capture.sample
    size = (sample.camera.height, sample.camera.width)
    raw = capture.scores(sample.depth_lr) if sample.scale == 1 else None
    panels = [
        Panel("photo", sample.rgb.permute(1, 2, 0).numpy()),
        Panel("input" + describe(capture, raw), rendering_of_input(sample)),
    ]
    for name in methods:
        depth = run_method(capture, name, shared, device)
        caption = f"{read_recipe(name).label}{describe(capture, capture.scores(depth))}"
        panels.append(Panel(caption, rendering(depth, sample.camera)))
        print(f"  {caption}".replace("\n", ": "), flush=True)
    if capture.truth is not None:
        truth = rendering(capture.truth.depth, capture.truth.camera)
        panels.append(Panel("truth", repeat_pixels(truth, size)))
    return panels


def heading_of(name: str, capture: Capture) -> str:
    """Return the text above a picture."""
    sample = capture.sample
    sizes = (f"{camera.height} x {camera.width}" for camera in (sample.camera_lr, sample.camera))
    text = f"{name}: {' to '.join(sizes)} (x{round_ratio(sample.scale)}), surfaces lit by {FIGURE_LIGHT}, pink: holes"
    if capture.truth is None:
        return text
    share = " / share of pixels scored" if capture.measured else ""
    return f"{text}; whole frame: mean angle between normals / RMSE_v, 1/1000{share}"


def crops(words: Sequence[str]) -> None:
    """Draw windows of real and simulated captures: photo, input, results and truth, lit by e1, holes in pink.

    Below a method's name are its scores on the whole frame: the mean angle between normals, RMSE_v in 1/1000 and, for
    real sensors, the share of the pixels that could be scored, see ``dsr.metrics.sensor``.
    """
    parser = argparse.ArgumentParser(prog="pictures.py crops", description=crops.__doc__)
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--only", default=",".join(CAPTURES), help="names of captures; all are the default")
    parser.add_argument("--methods", default="bilateral,tgv,pgsr,msg_v,facets")
    parser.add_argument("-o", "--output", type=Path, default=Path("outputs/crops"))
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(words)
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only.split(","):
        if name not in CAPTURES:
            raise SystemExit(f"--only: expected some of {', '.join(CAPTURES)}, got {name}")
        capture = CAPTURES[name](options.shared)
        print(name, flush=True)
        panels = panels_of(capture, options.methods.split(","), options.shared, options.device)
        cropped: list[Panel] = []
        for window in capture.windows:
            row = [Panel(panel.caption, panel.picture[window.slices]) for panel in panels]
            cropped += row + [EMPTY] * (-len(row) % COLUMNS)
        save_panels(options.output / f"{name}.jpg", cropped, COLUMNS, heading_of(name, capture))


Metrics = tuple[tuple[str, float, int], ...]
SHOWN: Metrics = (("RMSE_v", 1e3, 0), ("DSSIM_v", 1e3, 0), ("LPIPS_v", 1e3, 0), ("RMSE_d", 1e3, 0))
SHOWN_OF_SENSORS: Metrics = (
    ("Sensor_RMSE_v", 1e3, 0),
    ("Sensor_DSSIM_v", 1e3, 0),
    ("Sensor_angle_mean", 1, 1),
    ("Sensor_RMSE_d", 1e3, 1),
)
APART = ("folder",)
TITLES = {
    "simgeo": "SimGeo", "lucy": "Lucy", "plant": "Plant", "middlebury": "Middlebury", "icl": "ICL",
    "ddrnet": "ddrnet, x1", "rgbdd_real": "rgbdd_real, x2.67",
}  # fmt: skip
FIRST = ("Facets", "Facets (box)", "MSG-V", "MSG-V (published)", "MSG-V (noisy)", "MSG", "MSG (published)")
PEERS = ("PGSR", "DCTNet", "DORNet-T", "FDKN", "SVLRM")
PANELS = 5


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


def panels_of_scene(shown: Shown, top: int, left: int, side: int) -> list[Panel]:
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
    """Write the picture of a crop; ``--crop`` has the words."""
    dataset, name, scale, downsampling = words[:4]
    problem = BenchmarkSetting(dataset, float(scale), downsampling)
    notes: list[str] = []
    views = (view for view in views_of(results, problem) if view.scene == name)
    shown = next((shown_of(view, results.methods(), notes) for view in views), None)
    if shown is None:
        raise SystemExit(f"--crop: expected a scene of the runs, got {' '.join(words[:4])}")
    top, left, side = map(int, words[4:])
    save_panels(path, panels_of_scene(shown, top, left, side), PANELS, width=240)


def comparison(words: Sequence[str]) -> None:
    """Write the tables of docs/measurements/comparison.md: every method on every data set, from runs of eval.py.

    comparison.csv has a row for each data set, scale, degradation and method: the means over the scenes of all metrics,
    worst of four lights, raw units. comparison.md has a table of RMSE_v, DSSIM_v, LPIPS_v and RMSE_d for each scale and
    degradation, and one of all sensors' maps, by the metrics of metrics=sensor; the best value of a column is bold, and
    a mean over fewer scenes than the other methods have is marked with their number. With --crop, crop.jpg has a window
    of the photo, the input and all results, rendered, beside the truth; captions are the scene's DSSIM_v and RMSE_v.
    """
    parser = argparse.ArgumentParser(prog="pictures.py comparison", description=comparison.__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="directories with runs of eval.py below them")
    parser.add_argument("-o", "--output", type=Path, required=True)
    crop = ("DATASET", "SCENE", "SCALE", "DEGRADATION", "TOP", "LEFT", "SIDE")
    parser.add_argument("--crop", nargs=7, metavar=crop)
    options = parser.parse_args(words)
    results = load_results(options.runs)
    means = table_of(results)
    options.output.mkdir(parents=True, exist_ok=True)
    means.to_csv(options.output / "comparison.csv", index=False, float_format="%.6g")
    (options.output / "comparison.md").write_text(markdown(means, ordered(results.methods())), encoding="utf-8")
    if options.crop:
        draw_crop(results, options.output / "crop.jpg", options.crop)
    for note in results.notes:
        print(f"note: {note}")


_WIDTH = 560
_HOLE, _EDGE = (160, 60, 160), (0, 0, 255)


def drawn(rgb: Tensor, depth_lr: Tensor, title: str) -> np.ndarray:
    """Return the photo with the holes of a depth map tinted, and its steps drawn, (H, W, 3) uint8."""
    height = round(_WIDTH * rgb.shape[-1] ** -1 * rgb.shape[-2])
    size = (_WIDTH, height)
    photo = cv2.resize((255 * rgb.permute(1, 2, 0).numpy()[..., ::-1]).astype(np.uint8), size)
    depth = cv2.resize(depth_lr[0].double().numpy(), size, interpolation=cv2.INTER_NEAREST)
    holes = np.isnan(depth)
    photo[holes] = photo[holes] // 2 + np.array(_HOLE, np.uint8) // 2
    edges = find_edges(depth, 1, gap=12)
    for rows, columns in (edges.right.astype(int), edges.below.astype(int)):
        photo[rows, columns] = photo[rows, (columns + 1).clip(0, size[0] - 1)] = _EDGE
    bar = np.full((30, size[0], 3), 255, np.uint8)
    cv2.putText(bar, title, (6, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack((bar, photo))


def registration(words: Sequence[str]) -> None:
    """Draw what dsr upsample --register finds on a pair: the photo with the map's edges before and after."""
    parser = argparse.ArgumentParser(prog="pictures.py registration", description=registration.__doc__)
    parser.add_argument("--rgb", type=Path, required=True)
    parser.add_argument("--depth", type=Path, required=True)
    parser.add_argument("--depth-unit", default="mm")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    reading = Reading(unit=parse_unit(options.depth_unit))
    picture = read_picture(Pair("pair", options.rgb, options.depth), reading, {})
    found = find_displacement(picture.depth_lr, picture.rgb)
    print(found)
    if found is None:
        return
    left = drawn(picture.rgb, picture.depth_lr, "steps (red) and holes of the depth map, as it is")
    right = drawn(picture.rgb, undo(picture.depth_lr, found), f"--register: {found}")
    gap = np.full((left.shape[0], 8, 3), 255, np.uint8)
    cv2.imwrite(str(options.output), np.hstack((left, gap, right)), [cv2.IMWRITE_JPEG_QUALITY, 85])


AXES = {
    "pixels": ("million pixels", "dsr upsample"),
    "scenes": ("scenes of 64 x 64", "dsr upsample of a folder"),
    "runs": ("runs of two scenes of 64 x 64", "dsr report"),
}  # Label and title of each kind of points


def growth(words: Sequence[str]) -> None:
    """Draw points of run.py growth --set csv=FILE, and the straight line through the first and the last of each."""
    parser = argparse.ArgumentParser(prog="pictures.py growth", description=growth.__doc__)
    parser.add_argument("csv", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(words)
    rows = list(csv.DictReader(options.csv.read_text().splitlines()))
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(AXES))
    fields = (("seconds", "CPU seconds", "#d1495b"), ("gigabytes", "memory, GB", "#0f6ba8"))
    for column, (what, (label, title)) in enumerate(AXES.items()):
        panels[0, column].set_title(title, fontsize=10)
        panels[1, column].set_xlabel(label)
        amounts = [float(row["amount"]) for row in rows if row["what"] == what]
        for panel, (field, name, colour) in zip(panels[:, column], fields, strict=True):
            values = [float(row[field]) for row in rows if row["what"] == what]
            panel.plot(amounts[:: len(amounts) - 1 or 1], values[:: len(values) - 1 or 1], color="0.7", linewidth=1)
            panel.plot(amounts, values, "o", color=colour, clip_on=False)
            panel.set_xlim(left=0)
            panel.set_ylim(bottom=0)
            panel.spines[["top", "right"]].set_visible(False)
            if column == 0:
                panel.set_ylabel(name)
    with mpl.rc_context({"svg.hashsalt": "growth", "svg.fonttype": "none"}), replacing(options.output) as temporary:
        figure.savefig(temporary, metadata={"Date": None} if options.output.suffix == ".svg" else None)


def main() -> None:
    """Draw what the first word names."""
    programs = {each.__name__: each for each in (crops, comparison, registration, growth)}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=programs)
    parser.add_argument("words", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    programs[options.what](options.words)


if __name__ == "__main__":
    main()
