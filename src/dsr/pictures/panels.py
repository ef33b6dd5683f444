"""One picture per scene: photo, depth maps in pseudo-colour, renderings under the four lights, errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox
from torch import Tensor

from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import render
from dsr.metrics.formats import Formats, describe_directions, in_tables
from dsr.pictures.canvas import Canvas, fitted, without_collections, write_figure
from dsr.pictures.depth_views import angles_between, limits_of, normals_seen_by
from dsr.sample import DepthSample
from dsr.utils.ratios import round_ratio

_PANEL, _GAP, _ABOVE, _BETWEEN = 3.2, 0.1, 0.8, 0.95
"""Panel width, space beside panels, for the heading, and between rows for a colour bar and a title, inches."""
_DPI = 160
"""A panel of 3.2 inches has 512 pixels."""


@without_collections()
def save_picture(
    path: Path, sample: DepthSample, depth: Tensor, scores: Mapping[str, float], label: str, formats: Formats
) -> None:
    """Draw a scene's result, (1, H, W) in metres, with its worst-of-four scores in raw units; write it atomically."""
    truth = sample.depth
    page = _Page(sample, 2 if truth is None else 3)
    height, width = depth.shape[-2:]
    maps = [(sample.depth_lr, f"input, {sample.camera_lr.width} x {sample.camera_lr.height}"), (depth, label)]
    if truth is not None:
        maps.append((truth, "truth"))
    page.panel(0, 0, sample.rgb.permute(1, 2, 0).numpy(), f"photo, {width} x {height}", interpolation=None)
    limits = limits_of(depth if truth is None else truth)
    for column, (values, title) in enumerate(maps, 1):
        image = page.panel(0, column, values[0].numpy(), title, colour_map="viridis", limits=limits)
    page.bar_below(image, 0, 1, len(maps), "depth, m")
    for row, (values, title) in enumerate(maps[1:], 1):
        shaded = render(normals_seen_by(sample.camera, values))[0].numpy()
        for column, (light, shades) in enumerate(zip(LIGHT_NAMES, shaded, strict=False)):
            page.panel(row, column, shades, f"{title} under {light}")
    if truth is not None:
        error = 100 * (depth - truth)[0].numpy()
        known = np.abs(error[np.isfinite(error)])
        limit = max(float(np.percentile(known, 98)), 0.1) if known.size else 1.0
        image = page.panel(0, 4, error, "error", colour_map="RdBu_r", limits=(-limit, limit))
        page.bar_below(image, 0, 4, 4, "result - truth, cm", extend="both")
        degrees = angles_between(sample.camera, depth, truth)[0].numpy()
        image = page.panel(1, 4, degrees, "error of the normals", colour_map="magma", limits=(0, 60))
        page.bar_below(image, 1, 4, 4, "degrees", extend="max")
        page.scores(2, 4, scores, formats)
    holes = "" if all(bool(values.isfinite().all()) for values, _ in maps) else " (pink: holes)"
    heading = f"{sample.dataset} / {sample.scene}, {label} x{round_ratio(sample.scale)}{holes}"
    across, up = page.figure.get_size_inches()
    page.text(across / 2, up - 0.12, heading, fontsize=16, ha="center", va="top")
    write_figure(path, page.figure, _DPI)


class _Page(Canvas):
    """The page of a scene: rows of five panels."""

    def __init__(self, sample: DepthSample, rows: int) -> None:
        self._aspect = sample.camera.height / sample.camera.width
        self._panel_height = _PANEL * min(max(self._aspect, 0.4), 2.5)
        super().__init__(5 * _PANEL + 6 * _GAP, _ABOVE + rows * (self._panel_height + _BETWEEN))

    def scores(self, row: int, column: int, scores: Mapping[str, float], formats: Formats) -> None:
        """Write the scores in the units of tables."""
        shown = {name: each for name, each in in_tables(formats).items() if name in scores}
        lines = [
            f"{each.heading:<9}{each.unit:<8}{each.text(scores[name] * each.factor):>9}" for name, each in shown.items()
        ]
        text = "\n".join([f"scores, {describe_directions(shown)}", *lines])
        panel = self._panel(row, column)
        top = panel.y1 - 0.05 * panel.height
        self.text(panel.x0, top, text, family="monospace", fontsize=11, va="top", linespacing=1.6)

    def panel(self, row: int, column: int, picture: np.ndarray, title: str, **style: Any) -> AxesImage:
        """Draw a picture in the middle of its panel, below its title."""
        panel = self._panel(row, column)
        place = fitted(panel, self._aspect)
        self.text((panel.x0 + panel.x1) / 2, place.y1 + 0.08, title, fontsize=12, ha="center")
        return self.show(place, picture, **{"interpolation": "nearest", **style})

    def bar_below(self, image: AxesImage, row: int, first: int, last: int, label: str, extend: str = "neither") -> None:
        """Draw a colour bar below the panels from one column to another."""
        left, right = self._panel(row, first).x0, self._panel(row, last).x1
        width = min(right - left, 1.6 * _PANEL) - 0.2 * _PANEL
        below = fitted(self._panel(row, last), self._aspect).y0
        place = Bbox.from_bounds((left + right - width) / 2, below - 0.19, width, 0.09)
        self.bar(image, place, extend=extend, orientation="horizontal").set_label(label, labelpad=1)

    def _panel(self, row: int, column: int) -> Bbox:
        """Return the space of a panel."""
        top = self.figure.get_figheight() - _ABOVE - row * (self._panel_height + _BETWEEN)
        left = _GAP + column * (_PANEL + _GAP)
        return Bbox.from_bounds(left, top - self._panel_height, _PANEL, self._panel_height)
