"""Layout of the grids: rows of panels of one width, details below them, and one colour bar per row."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from dsr.pictures.canvas import Canvas, Part
from dsr.pictures.depth_views import Window

FRAMES = ("#ff8c00", "#00a5e3")  # colours, of the first and second detail
_WIDTH, _LEAST_PANEL, _MOST_PANEL = 7.0, 0.95, 1.6  # inches, of the page unless a panel would exceed its limits
_TALLEST = 1.5  # maximum ratio of height to width of a panel; taller pictures become narrower
_GAP, _SEAM, _MARGIN, _LINE = 0.05, 0.04, 0.06, 0.125
"""Space between panels, between details and around the page, and height of a line of text, inches."""
_BAR, _BAR_TEXT = 0.09, 0.42
_FONT = 7.0
_LETTER_WIDTH = 0.062  # upper estimate of the width of a letter, inches
_EMPTY = "#f2f2f2"


@dataclass(frozen=True)
class Cell:
    """A panel."""

    picture: np.ndarray | None  # (H, W), NaN in holes, or (H, W, 3) in [0, 1]; None for an empty panel
    caption: str = ""  # below the panel, or inside an empty one
    bold: bool = False
    colour_map: str | Colormap = "gray"
    limits: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Row:
    """The row of a scene."""

    label: str
    aspect: float  # ratio of height to width of its pictures
    cells: Sequence[Cell]  # one per column
    details: Sequence[Window] = ()  # square windows shown enlarged
    bar: str = ""  # label of the colour bar, which is that of the last (H, W) picture; empty for no bar
    extend: str = "neither"  # Matplotlib's ``extend`` of colour bars


def draw_grid(columns: Sequence[str], rows: Sequence[Row], texts: tuple[str, str]) -> Figure:
    """Draw a page of rows, each with one cell per column heading, between a text above and one below."""
    right = _MARGIN + (_BAR + _BAR_TEXT if any(row.bar for row in rows) else 0)
    panel = min(max((_WIDTH - 0.3 - right) / len(columns) - _GAP, _LEAST_PANEL), _MOST_PANEL)
    boxes = []  # of each row: width and height of a picture, and heights of details and caption, inches
    for row in rows:
        width = panel * min(1.0, _TALLEST / row.aspect)
        details = (panel - _SEAM * (len(row.details) - 1)) / len(row.details) + _SEAM if row.details else 0.0
        caption = _LINE if any(cell.caption and cell.picture is not None for cell in row.cells) else 0.0
        boxes.append((width, max(width * row.aspect, 0.15), details, caption))
    labels = [_wrap(row.label, sum(heights)) for row, (_, *heights) in zip(rows, boxes, strict=True)]
    left = _MARGIN + _LINE * max(label.count("\n") + 1 for label in labels) + 0.03
    heads = [_wrap(column, panel) for column in columns]
    head = _LINE * max(text.count("\n") + 1 for text in heads)
    top = _MARGIN + _LINE * 1.5 + head
    total = top + sum(sum(heights) + _GAP for _, *heights in boxes) + _LINE * 1.3 + _MARGIN
    page = _Page(left + len(columns) * (panel + _GAP) + right, total)
    page.text(_MARGIN, total - _MARGIN, texts[0], va="top", weight="bold")
    page.text(_MARGIN, _MARGIN, texts[1], va="bottom")
    for column, text in enumerate(heads):
        page.text(left + column * (panel + _GAP) + panel / 2, total - top + 0.06, text, ha="center", va="baseline")
    level = total - top
    for row, label, box in zip(rows, labels, boxes, strict=True):
        middle = level - sum(box[1:]) / 2
        page.text(left - 0.04, middle, label, ha="right", va="center", rotation=90, multialignment="center")
        for column, cell in enumerate(row.cells):
            page.cell(row, cell, left + column * (panel + _GAP), level, panel, box)
        if row.bar:
            page.bar_of(row, left + len(columns) * (panel + _GAP), level, box[1])
        level -= sum(box[1:]) + _GAP
    return page.figure


def _wrap(text: str, length: float) -> str:
    return "\n".join(textwrap.wrap(text, max(int(length / _LETTER_WIDTH), 4), break_on_hyphens=False)) or text


class _Page(Canvas):
    """A page of panels; labels are ``ROW: panel``, also of the frame of an empty one, and ``ROW: detail``."""

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Write a text."""
        super().text(x, y, text, **{"fontsize": _FONT, "linespacing": 1.1, **style})

    def cell(
        self, row: Row, cell: Cell, left: float, top: float, panel: float, box: tuple[float, float, float, float]
    ) -> None:
        """Draw a panel, its details and its caption; ``top`` is the upper edge of the picture."""
        width, height, below, _ = box
        place = Bbox.from_bounds(left + (panel - width) / 2, top - height, width, height)
        if cell.picture is None:
            self.frame(place, f"{row.label}: panel", facecolor=_EMPTY)
            middle = ((place.x0 + place.x1) / 2, (place.y0 + place.y1) / 2)
            self.text(*middle, cell.caption, ha="center", va="center", color="0.45")
            return
        style: dict[str, Any] = {"colour_map": cell.colour_map, "limits": cell.limits}
        self.show(place, cell.picture, f"{row.label}: panel", **style)
        size = below - _SEAM
        for number, (window, colour) in enumerate(zip(row.details, FRAMES, strict=False)):
            down, across = cell.picture.shape[:2]
            right, bottom = (window.left + window.width) / across, (window.top + window.height) / down
            part = Part(window.left / across, right, window.top / down, bottom)
            self.frame(part.of(place), f"{row.label}: frame", facecolor="none", edgecolor=colour, linewidth=0.9)
            inset = Bbox.from_bounds(left + number * (size + _SEAM), top - height - below, size, size)
            self.show(inset, cell.picture[window.slices], f"{row.label}: detail", **style)
            self.frame(inset, f"{row.label}: edge", facecolor="none", edgecolor=colour, linewidth=1.0)
        self.text(left + panel / 2, top - height - below - 0.02, cell.caption, ha="center", va="top",
                  weight="bold" if cell.bold else "normal")  # fmt: skip

    def bar_of(self, row: Row, left: float, top: float, height: float) -> None:
        """Draw a row's colour bar, beside its panels."""
        panels = [image for image in self._pictures.images if image.get_label() == f"{row.label}: panel"]
        mapped = [image for image in panels if np.asarray(image.get_array()).ndim == 2]
        if not mapped:
            return
        place = Bbox.from_bounds(left, top - height, _BAR, height)
        bar = self.bar(mapped[-1], place, f"{row.label}: bar", most=5, extend=row.extend)
        bar.outline.set_linewidth(0.4)
        bar.ax.tick_params(labelsize=_FONT - 1, length=2, width=0.4, pad=1.5)
        bar.set_label(row.bar, fontsize=_FONT, labelpad=1.5)
