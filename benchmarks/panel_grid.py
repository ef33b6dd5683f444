"""A grid of equally wide pictures with captions, for benchmarks that draw crops; not a benchmark itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from dsr.pictures.canvas import HOLE_COLOUR
from dsr.pictures.depth_views import rendering
from dsr.sample import DepthSample

_DPI, _FONT, _LINE = 100, 10, 18
"""Dots per inch, size of letters in points, and height of a line of text in pixels."""
_GAP, _MARGIN = 8, 10
"""Space between panels and around the page, pixels."""


class Panel(NamedTuple):
    """A caption of one line or more, and a picture: (h, w), NaN in holes, or (h, w, 3), both in [0, 1]."""

    caption: str
    picture: np.ndarray


EMPTY = Panel("", np.ones((1, 1)))
"""A place without a panel."""


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
