"""Grids of scenes by methods: renderings with details, depth in pseudo-colour, signed errors."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.report.figures.layout import Row, draw_grid, save_both
from dsr.report.figures.rows import depth_row, error_row, rendering_row
from dsr.report.figures.scenes import Shown, first_runs, scene_names, shown_scenes

LIGHT = "e1"
ROWS = 5
"""Maximum number of scenes on a page."""
Progress = Callable[[str], None]
"""Called with the name of a figure before it is drawn."""


def save_rendering_grids(
    folder: Path,
    results: Results,
    light: str = LIGHT,
    *,
    progress: Progress | None = None,
    notes: list[str] | None = None,
) -> list[Path]:
    """Draw photo and renderings of input, results and ground truth, with two details per scene.

    Details are the windows in which the methods differ most from the ground truth on average. The captions are DSSIM_v
    and RMSE_v in 1/1000, worst of four lights, the best in bold. The input is rendered at its own resolution.

    Args:
        folder: directory for ``renderings_DATASET_xSCALE_DOWNSAMPLING_PAGE.pdf`` and ``.png``, five scenes per page.
        results: runs to draw; a page has one data set, scale and degradation.
        light: light of the renderings, ``e1`` to ``e4``.
        progress: called with the name of each figure.
        notes: list to which one line is added per scene or result that could not be drawn.

    Returns:
        Paths of the files.

    Raises:
        ValueError: there is no such light.

    """
    below = f"surfaces lit by {light}; below: DSSIM_v / RMSE_v, 1/1000, lower is better"
    heads = ("photo", "input")

    def row(shown: Shown) -> Row:
        return rendering_row(shown, light)

    return _save(folder, "renderings", results, row, (heads, ("truth",), below), progress, notes)


def save_depth_grids(
    folder: Path, results: Results, *, progress: Progress | None = None, notes: list[str] | None = None
) -> list[Path]:
    """Draw photo, and depth of input, results and ground truth in pseudo-colour, with the same limits across a row.

    Files are ``depth_DATASET_xSCALE_DOWNSAMPLING_PAGE``; otherwise like :func:`save_rendering_grids`. Limits are the
    1st and 99th percentile of the ground truth, or of the input if there is none.
    """
    texts = (("photo", "input"), ("truth",), "distance to the image plane; below: RMSE_d, mm, lower is better")
    return _save(folder, "depth", results, depth_row, texts, progress, notes)


def save_error_grids(
    folder: Path, results: Results, *, progress: Progress | None = None, notes: list[str] | None = None
) -> list[Path]:
    """Draw photo and signed error (result - truth) of each method, with the same limits across a row.

    Files are ``errors_DATASET_xSCALE_DOWNSAMPLING_PAGE``; otherwise like :func:`save_rendering_grids`. Limits are
    +-98th percentile of the absolute errors of all methods. Scenes without ground truth are left out.
    """
    texts = (("photo",), (), "result - truth: red is too far, blue too near; below: RMSE_d, mm, lower is better")
    return _save(folder, "errors", results, error_row, texts, progress, notes)


def figure_count(results: Results) -> int:
    """Return the maximum number of pages of the three kinds of grids."""
    scenes = (len(scene_names(first_runs(results, problem))) for problem in results.problems())
    return 3 * sum(-(-count // ROWS) for count in scenes)


def _save(
    folder: Path,
    kind: str,
    results: Results,
    draw: Callable[[Shown], Row | None],
    texts: tuple[tuple[str, ...], tuple[str, ...], str],
    progress: Progress | None,
    notes: list[str] | None,
) -> list[Path]:
    """Draw the pages of one kind for each benchmark setting."""
    before, after, below = texts
    paths: list[Path] = []
    notes = [] if notes is None else notes
    for problem, name in zip(results.problems(), _names(results.problems()), strict=True):
        columns = (*before, *first_runs(results, problem), *after)
        rows = filter(None, map(draw, shown_scenes(results, problem, notes)))
        for number, page in enumerate(_pages(rows), start=1):
            if progress is not None:
                progress(f"{kind}_{name}_{number}")
            title = f"{problem.dataset}, x{problem.scale}, {problem.downsampling}"
            holes = "; pink: holes" if any(_has_holes(row) for row in page) else ""
            paths += save_both(folder, f"{kind}_{name}_{number}", draw_grid(columns, page, (title, below + holes)))
    return paths


def _pages(rows: Iterator[Row]) -> Iterator[list[Row]]:
    """Yield the rows of each page."""
    while page := list(itertools.islice(rows, ROWS)):
        yield page


def _names(problems: list[BenchmarkSetting]) -> list[str]:
    """Return a unique part of a file name for each benchmark setting."""
    names: list[str] = []
    for dataset, scale, downsampling in problems:
        name = re.sub(r"[^\w.-]+", "_", f"{dataset}_x{scale}_{downsampling}").strip("_")
        while name in names:
            name += "_"
        names.append(name)
    return names


def _has_holes(row: Row) -> bool:
    """Return whether a picture of the row has holes."""
    return any(cell.picture is not None and not np.isfinite(cell.picture).all() for cell in row.cells)
