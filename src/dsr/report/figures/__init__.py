"""Figures for papers and pages, as PDF and PNG: grids of scenes by methods, and the four lights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dsr.evaluation.results import Results
from dsr.report.figures.grids import LIGHT, figure_count, save_depth_grids, save_error_grids, save_rendering_grids
from dsr.report.figures.lights import save_lights_figure

__all__ = ["save_depth_grids", "save_error_grids", "save_figures", "save_lights_figure", "save_rendering_grids"]


def save_figures(
    folder: Path,
    results: Results,
    progress: Callable[[int, int, str], None] | None = None,
    *,
    light: str = LIGHT,
    notes: list[str] | None = None,
) -> list[Path]:
    """Draw all figures.

    Args:
        folder: output directory; existing files are replaced.
        results: runs to draw.
        progress: called before each figure with the number done, the maximum number, and the name.
        light: light of the renderings, ``e1`` to ``e4``.
        notes: list to which one line is added per scene or result that could not be drawn.

    Returns:
        Paths of the files: a PDF and a PNG of each figure.

    Raises:
        ValueError: there is no such light.

    """
    total, done = figure_count(results) + 1, 0

    def report(name: str) -> None:
        nonlocal done
        if progress is not None:
            progress(done, total, name)
        done += 1

    paths = save_rendering_grids(folder, results, light, progress=report, notes=notes)
    paths += save_depth_grids(folder, results, progress=report, notes=notes)
    paths += save_error_grids(folder, results, progress=report, notes=notes)
    report("lights")
    return paths + save_lights_figure(folder, results)
