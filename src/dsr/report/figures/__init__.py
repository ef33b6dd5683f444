"""Figures for papers and pages, as PDF and PNG: grids of scenes by methods, and the four lights."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from dsr.evaluation.results import Results
from dsr.report.figures.grids import (
    LIGHT,
    Page,
    pages_of,
    save_depth_grids,
    save_error_grids,
    save_page,
    save_rendering_grids,
)
from dsr.report.figures.lights import save_lights_figure
from dsr.report.work import Work

__all__ = ["Figures", "save_depth_grids", "save_error_grids", "save_figures", "save_lights_figure",
           "save_rendering_grids"]  # fmt: skip
_KINDS = ("renderings", "depth", "errors")


class Figures:
    """All figures, which the workers of ``work`` begin to draw at once.

    Args:
        folder: output directory; existing files are replaced.
        work: runs to draw, and what draws them.
        light: light of the renderings, ``e1`` to ``e4``.

    """

    def __init__(self, folder: Path, work: Work, light: str = LIGHT) -> None:
        self.notes: list[str] = []
        """One line per scene or result that could not be drawn."""
        self._pages = [*pages_of(work.results, _KINDS, light, self.notes), None]
        self._drawn = work.map(functools.partial(_draw, folder), self._pages)

    def save(self, progress: Callable[[int, int, str], None] | None = None) -> list[Path]:
        """Return the paths of the files, a PDF and a PNG of each figure, once they are drawn.

        Args:
            progress: called before each figure with the number done, the number of all, and the name.

        Raises:
            ValueError: there is no such light.

        """
        paths: list[Path] = []
        for done, page in enumerate(self._pages):
            if progress is not None:
                progress(done, len(self._pages), "lights" if page is None else page.name)
            files, notes = next(self._drawn)
            paths += files
            self.notes += [note for note in notes if note not in self.notes]
        return paths


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
        progress: called before each figure with the number done, the number of all, and the name.
        light: light of the renderings, ``e1`` to ``e4``.
        notes: list to which one line is added per scene or result that could not be drawn.

    Returns:
        Paths of the files: a PDF and a PNG of each figure.

    Raises:
        ValueError: there is no such light.

    """
    figures = Figures(folder, Work(results), light)
    paths = figures.save(progress)
    if notes is not None:
        notes += [note for note in figures.notes if note not in notes]
    return paths


def _draw(folder: Path, results: Results, page: Page | None) -> tuple[list[Path], list[str]]:
    """Draw a page, or the figure of the lights for None; return the files and notes on what could not be drawn."""
    notes: list[str] = []
    paths = save_lights_figure(folder, results) if page is None else save_page(folder, results, page, notes)
    return paths, notes
