"""Grids of scenes by methods: renderings with details, depth in pseudo-colour, signed errors."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dsr.evaluation.results import BenchmarkSetting, Results
from dsr.report.figures.layout import Row, draw_grid, save_both
from dsr.report.figures.rows import depth_row, error_row, rendering_row
from dsr.report.figures.scenes import Shown, drawable_scenes, first_runs, shown_scenes

LIGHT = "e1"
ROWS = 5
"""Maximum number of scenes on a page."""
Progress = Callable[[str], None]
"""Called with the name of a figure before it is drawn."""


@dataclass(frozen=True)
class Page:
    """A page of a grid.

    Args:
        kind: ``renderings``, ``depth`` or ``errors``.
        problem: benchmark setting.
        name: name of the files, without suffix.
        scenes: names of the scenes, at most :data:`ROWS`.
        light: light of the renderings, ``e1`` to ``e4``.

    """

    kind: str
    problem: BenchmarkSetting
    name: str
    scenes: tuple[str, ...]
    light: str = LIGHT


class _Kind(NamedTuple):
    """What a kind of grid shows: the columns before and after the methods, and the text below."""

    before: tuple[str, ...]
    after: tuple[str, ...]
    below: str


_KINDS = {
    "renderings": _Kind(
        ("photo", "input"), ("truth",), "surfaces lit by {light}; below: DSSIM_v / RMSE_v, 1/1000, lower is better"
    ),
    "depth": _Kind(("photo", "input"), ("truth",), "distance to the image plane; below: RMSE_d, mm, lower is better"),
    "errors": _Kind(
        ("photo",), (), "result - truth: red is too far, blue too near; below: RMSE_d, mm, lower is better"
    ),
}


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
    for the worst of four lights and RMSE_v, in 1/1000, the best in bold. The input is rendered at its own resolution.

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
    return _save(folder, "renderings", results, light, progress, notes)


def save_depth_grids(
    folder: Path, results: Results, *, progress: Progress | None = None, notes: list[str] | None = None
) -> list[Path]:
    """Draw photo, and depth of input, results and ground truth in pseudo-colour, with the same limits across a row.

    Files are ``depth_DATASET_xSCALE_DOWNSAMPLING_PAGE``; otherwise like :func:`save_rendering_grids`. Limits are the
    1st and 99th percentile of the ground truth, or of the input if there is none.
    """
    return _save(folder, "depth", results, LIGHT, progress, notes)


def save_error_grids(
    folder: Path, results: Results, *, progress: Progress | None = None, notes: list[str] | None = None
) -> list[Path]:
    """Draw photo and signed error (result - truth) of each method, with the same limits across a row.

    Files are ``errors_DATASET_xSCALE_DOWNSAMPLING_PAGE``; otherwise like :func:`save_rendering_grids`. Limits are
    +-98th percentile of the absolute errors of all methods. Scenes without ground truth are left out.
    """
    return _save(folder, "errors", results, LIGHT, progress, notes)


def pages_of(results: Results, kinds: Iterable[str], light: str = LIGHT, notes: list[str] | None = None) -> list[Page]:
    """Return the pages of some kinds of grids, from the names of the files alone.

    Args:
        results: runs to draw.
        kinds: some of renderings, depth, errors.
        light: light of the renderings, ``e1`` to ``e4``.
        notes: list to which one line is added per scene that no run has stored.

    """
    found = []
    notes = [] if notes is None else notes
    for kind in kinds:
        for problem, name in zip(results.problems(), _names(results.problems()), strict=True):
            scenes = drawable_scenes(results, problem, notes, with_truth=kind == "errors")
            for number, start in enumerate(range(0, len(scenes), ROWS), start=1):
                rows = tuple(scenes[start : start + ROWS])
                found.append(Page(kind, problem, f"{kind}_{name}_{number}", rows, light))
    return found


def save_page(folder: Path, results: Results, page: Page, notes: list[str]) -> list[Path]:
    """Draw a page, unless none of its scenes can be drawn.

    Args:
        folder: directory of the files.
        results: runs to draw.
        page: one of :func:`pages_of`.
        notes: list to which one line is added per scene or result that could not be drawn.

    Returns:
        Paths of the PDF and the PNG.

    Raises:
        ValueError: there is no such light.

    """
    kind = _KINDS[page.kind]
    draw: dict[str, Callable[[Shown], Row | None]] = {
        "renderings": functools.partial(rendering_row, light=page.light), "depth": depth_row, "errors": error_row,
    }  # fmt: skip
    rows = [row for row in map(draw[page.kind], shown_scenes(results, page.problem, notes, page.scenes)) if row]
    if not rows:
        return []
    columns = (*kind.before, *first_runs(results, page.problem), *kind.after)
    title = f"{page.problem.dataset}, x{page.problem.scale}, {page.problem.downsampling}"
    holes = "; pink: holes" if any(_has_holes(row) for row in rows) else ""
    below = kind.below.format(light=page.light) + holes
    return save_both(folder, page.name, draw_grid(columns, rows, (title, below)))


def _save(
    folder: Path, kind: str, results: Results, light: str, progress: Progress | None, notes: list[str] | None
) -> list[Path]:
    """Draw the pages of one kind for each benchmark setting."""
    notes = [] if notes is None else notes
    paths: list[Path] = []
    for page in pages_of(results, [kind], light, notes):
        if progress is not None:
            progress(page.name)
        paths += save_page(folder, results, page, notes)
    return paths


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
