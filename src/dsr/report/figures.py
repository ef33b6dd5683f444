"""Figures of runs for papers and pages, as PDF and PNG: grids of scenes by methods, and the lights.

Grids show renderings with details, depth in pseudo-colour, and signed errors. A page has one data set, scale and
degradation, and at most five scenes. Of the renderings, details are the windows in which the methods differ most from
the ground truth on average, and the input is rendered at its own resolution. The limits of depth are the 1st and 99th
percentile of the ground truth, those of errors the 98th of all methods' absolute errors, each across a row.
"""

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import ListedColormap

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.geometry.lights import FIGURE_LIGHT
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.pictures.canvas import save_both
from dsr.pictures.depth_views import Window, limits_of, rendering, strongest_window
from dsr.pictures.grids import Cell, Row, draw_grid
from dsr.pictures.lights_figure import save_lights_figure
from dsr.report.shown_scenes import Shown, shown_of, views_of
from dsr.report.tables import unique_name
from dsr.report.worker_pool import WorkerPool
from dsr.sample import DepthSample

ROWS = 5  # maximum number of scenes on a page
_DETAIL = 5  # the side of a detail is 1/5 of the shorter side of the picture
_CENTIMETRE_LIMIT = 0.02  # limit of a row, metres, from which errors are shown in centimetres
_LEAST_ERROR = 1e-5
_PREFERRED = ("statue", "lucy")  # scenes to show under the lights
_CANDIDATES = 8  # maximum number of scenes to choose that one from


class Figures:
    """All figures of the runs of ``workers``, which begin to draw them at once; existing files are replaced."""

    def __init__(self, folder: Path, workers: WorkerPool, light: str = FIGURE_LIGHT) -> None:
        self.notes: list[str] = []  # one line per scene or result that could not be drawn
        self._pages = [*pages_of(workers.results, KINDS, light), None]
        self._drawn = workers.map(functools.partial(draw_page, folder), self._pages)

    def save(self, progress: Callable[[int, int, str], None] | None = None) -> list[Path]:
        """Return the files once they are drawn; ``progress`` is told the number done, of all, and the figure's name."""
        paths: list[Path] = []
        for done, page in enumerate(self._pages):
            if progress is not None:
                progress(done, len(self._pages), "lights" if page is None else page.name)
            files, notes = next(self._drawn)
            paths += files
            self.notes += [note for note in notes if note not in self.notes]
        return paths


@dataclass(frozen=True)
class Page:
    """A page of a grid."""

    kind: str  # renderings, depth or errors
    problem: BenchmarkSetting
    name: str  # of the files, without suffix
    scenes: tuple[str, ...]  # at most :data:`ROWS`
    light: str  # of the renderings


def pages_of(results: Results, kinds: Iterable[str], light: str) -> list[Page]:
    """Return the pages of some kinds of grids."""
    found = []
    for kind in kinds:
        names: set[str] = set()
        for problem in results.problems():
            name = unique_name("{}_x{}_{}".format(*problem), names)
            scenes = [view.scene for view in views_of(results, problem)]
            for number, start in enumerate(range(0, len(scenes), ROWS), start=1):
                rows = tuple(scenes[start : start + ROWS])
                found.append(Page(kind, problem, f"{kind}_{name}_{number}", rows, light))
    return found


def draw_page(folder: Path, results: Results, page: Page | None) -> tuple[list[Path], list[str]]:
    """Draw a page, or the figure of the lights for None; return its PDF and PNG, and notes on what cannot be drawn."""
    notes: list[str] = []
    if page is None:
        return save_lights_figure(folder, _most_varied(results)), notes
    make_row, below = _GRIDS[page.kind]
    methods = list(dict.fromkeys(run.label for run in results.of(page.problem)))
    rows = []
    for view in views_of(results, page.problem):
        shown = shown_of(view, methods, notes) if view.scene in page.scenes else None
        row = None if shown is None else make_row(shown, page.light)
        if row is not None:
            rows.append(row)
    if not rows:
        return [], notes
    columns = ["photo", *methods] if page.kind == "errors" else ["photo", "input", *methods, "truth"]
    title = f"{page.problem.dataset}, x{page.problem.scale}, {page.problem.downsampling}"
    pictures = (cell.picture for row in rows for cell in row.cells if cell.picture is not None)
    holes = "; pink: holes" if any(not np.isfinite(picture).all() for picture in pictures) else ""
    return save_both(folder, page.name, draw_grid(columns, rows, (title, below.format(page.light) + holes))), notes


def rendering_row(shown: Shown, light: str) -> Row:
    """Build the row of a scene's renderings."""
    scene = shown.scene
    drawn = {
        label: None if depth is None else rendering(depth, scene.camera, light) for label, depth in shown.depths.items()
    }
    truth = None if scene.depth is None else rendering(scene.depth, scene.camera, light)
    results = [picture for picture in drawn.values() if picture is not None]
    details = details_of(results, truth, math.ceil(scene.scale))
    around = rendering(scene.depth_lr, scene.camera_lr, light), truth
    return _row(shown, drawn, ("DSSIM_v", "RMSE_v"), around, details=details)


def depth_row(shown: Shown, _: str) -> Row:
    """Build the row of a scene's depth maps."""
    scene = shown.scene
    style = {"colour_map": "viridis", "limits": limits_of(scene.depth_lr if scene.depth is None else scene.depth)}
    pixels = {label: None if depth is None else depth[0].numpy() for label, depth in shown.depths.items()}
    around = scene.depth_lr[0].numpy(), None if scene.depth is None else scene.depth[0].numpy()
    return _row(shown, pixels, ("RMSE_d",), around, style, bar="depth, m", extend="both")


def error_row(shown: Shown, _: str) -> Row | None:
    """Build the row of a scene's errors, None without ground truth or without results."""
    truth = shown.scene.depth
    if truth is None or all(depth is None for depth in shown.depths.values()):
        return None
    errors = {name: None if depth is None else (depth - truth)[0].numpy() for name, depth in shown.depths.items()}
    pooled = np.concatenate([np.abs(error[np.isfinite(error)]) for error in errors.values() if error is not None])
    limit = max(float(np.percentile(pooled, 98)) if pooled.size else 0.0, _LEAST_ERROR)
    factor, unit = (100, "cm") if limit >= _CENTIMETRE_LIMIT else (1000, "mm")
    # From blue over white to red, without the nearly black ends
    colour_map = ListedColormap(mpl.colormaps["RdBu_r"](np.linspace(0.1, 0.9, 255)), "errors")
    style = {"colour_map": colour_map, "limits": (-factor * limit, factor * limit)}
    scaled = {name: None if error is None else factor * error for name, error in errors.items()}
    return _row(shown, scaled, ("RMSE_d",), None, style, bar=f"result - truth, {unit}", extend="both")


# What makes a row, and the text below, of each kind of grid
_GRIDS: dict[str, tuple[Callable[[Shown, str], Row | None], str]] = {
    "renderings": (rendering_row, "surfaces lit by {}; below: DSSIM_v / RMSE_v, 1/1000, lower is better"),
    "depth": (depth_row, "distance to the image plane; below: RMSE_d, mm, lower is better"),
    "errors": (error_row, "result - truth: red is too far, blue too near; below: RMSE_d, mm, lower is better"),
}
KINDS = tuple(_GRIDS)


def _row(
    shown: Shown,
    pictures: Mapping[str, np.ndarray | None],
    metrics: Sequence[str],
    around: tuple[np.ndarray, np.ndarray | None] | None,
    style: Mapping[str, Any] | None = None,
    **more: Any,
) -> Row:
    """Build a row: the photo, and the pictures of the methods above their scores, ``around`` them input and truth.

    The captions have the scores in the paper's units, in bold for the best by the first metric. The name of the scene
    has spaces, at which it can be wrapped.
    """
    camera, style = shown.scene.camera, style or {}
    cells = [Cell(shown.scene.rgb.permute(1, 2, 0).clamp(0, 1).numpy())]
    if around is not None:
        # Pixels are repeated up to the size of a view, so that viewers do not smooth a low-resolution picture.
        rows, columns = (
            ((np.arange(new) + 0.5) * old / new).astype(int)
            for old, new in zip(around[0].shape, (camera.height, camera.width), strict=True)
        )
        cells.append(Cell(around[0][rows[:, None], columns], **style))
    first = {label: scores.get(metrics[0], math.nan) for label, scores in shown.scores.items()}
    valid = [value for value in first.values() if math.isfinite(value)]
    best = min(valid) if len(valid) > 1 else None
    for label, picture in pictures.items():
        texts = []
        for metric in metrics:
            value = KNOWN_FORMATS[metric].factor * shown.scores[label].get(metric, math.nan)
            texts.append(KNOWN_FORMATS[metric].text(value) if math.isfinite(value) else "-")
        caption = " / ".join(texts) if set(texts) != {"-"} else ""
        missing = Cell(None, "no result")
        cells.append(missing if picture is None else Cell(picture, caption, first[label] == best, **style))
    if around is not None:
        cells.append(Cell(None, "no truth") if around[1] is None else Cell(around[1], **style))
    return Row(shown.name.replace("_", " "), camera.height / camera.width, cells, **more)


def details_of(pictures: Sequence[np.ndarray], truth: np.ndarray | None, grain: int, count: int = 2) -> list[Window]:
    """Find square windows in which results differ most, on average, from the ground truth or else from their mean.

    Renderings are (H, W), NaN where undefined. Windows do not overlap, and consist of whole blocks of ``grain`` pixels.
    """
    if not pictures:
        return []
    stack = np.nan_to_num(np.stack(pictures))
    difference = np.abs(stack - (stack.mean(axis=0) if truth is None else truth)).mean(axis=0)
    height, width = (side // grain for side in difference.shape)
    blocks = np.nan_to_num(difference)[: height * grain, : width * grain].reshape(height, grain, width, grain)
    side = max(round(min(height, width) / _DETAIL), 1)
    windows: list[Window] = []
    for _ in range(count):
        window = strongest_window(blocks.mean(axis=(1, 3)), side, side, windows)
        if window is not None:
            windows.append(window)
    return [Window(*(grain * value for value in window)) for window in windows]


def _most_varied(results: Results) -> DepthSample | None:
    """Return a scene with ground truth: the first preferred one, otherwise the one with the most varied normals."""
    found: dict[str, DepthSample] = {}
    for run in results.runs:
        for name in run.scenes:
            if name not in found and len(found) < _CANDIDATES and run.has_sample(name):
                try:
                    scene = run.sample(name)
                except ValueError:
                    continue
                if scene.depth is not None and min(scene.depth.shape[-2:]) > 1:
                    found[name] = scene
    for name in _PREFERRED:
        if name in found:
            return found[name]
    shades = {name: rendering(each.depth, each.camera) for name, each in found.items() if each.depth is not None}
    varied = max(shades, key=lambda name: float(np.nan_to_num(np.nanstd(shades[name]))), default=None)
    return None if varied is None else found[varied]
