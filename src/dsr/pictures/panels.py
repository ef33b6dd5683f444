"""One picture per scene: photo, depth maps in pseudo-colour, renderings under the four lights, errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

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
    page.photo(0, 0, sample.rgb, f"photo, {width} x {height}")
    page.depths(0, 1, maps, limits_of(depth if truth is None else truth))
    page.renderings(1, depth, label)
    if truth is not None:
        page.error(0, 4, depth - truth)
        page.renderings(2, truth, "truth")
        page.angles(1, 4, depth, truth)
        page.scores(2, 4, scores, formats)
    holes = "" if all(bool(values.isfinite().all()) for values, _ in maps) else " (pink: holes)"
    heading = f"{sample.dataset} / {sample.scene}, {label} x{round_ratio(sample.scale)}{holes}"
    across, up = page.figure.get_size_inches()
    page.text(across / 2, up - 0.12, heading, fontsize=16, ha="center", va="top")
    write_figure(path, page.figure, _DPI)


class _Page(Canvas):
    """The page of a scene: rows of five panels."""

    def __init__(self, sample: DepthSample, rows: int) -> None:
        self._camera = sample.camera
        self._aspect = sample.camera.height / sample.camera.width
        self._panel_height = _PANEL * min(max(self._aspect, 0.4), 2.5)
        super().__init__(5 * _PANEL + 6 * _GAP, _ABOVE + rows * (self._panel_height + _BETWEEN))

    def photo(self, row: int, column: int, rgb: Tensor, title: str) -> None:
        """Draw a photo, (3, H, W)."""
        self.show(self._place(row, column), rgb.permute(1, 2, 0).numpy())
        self._title(row, column, title)

    def depths(self, row: int, column: int, maps: Sequence[tuple[Tensor, str]], limits: tuple[float, float]) -> None:
        """Draw depth maps beside each other, each (1, H, W) in metres with its title, and their colour bar."""
        for number, (depth, title) in enumerate(maps, column):
            image = self._map(row, number, depth[0].numpy(), title, "viridis", limits)
        self._bar(image, row, column, number, "depth, m")

    def renderings(self, row: int, depth: Tensor, title: str) -> None:
        """Draw the renderings of a depth map, (1, H, W), under the four lights."""
        shaded = render(normals_seen_by(self._camera, depth))[0]
        for column, (name, shades) in enumerate(zip(LIGHT_NAMES, shaded, strict=False)):
            self._map(row, column, shades.numpy(), f"{title} under {name}", "gray", (0, 1))

    def error(self, row: int, column: int, difference: Tensor) -> None:
        """Draw a signed error, (1, H, W) in metres, in centimetres."""
        centimetres = 100 * difference[0].numpy()
        valid = centimetres[np.isfinite(centimetres)]
        limit = max(float(np.percentile(np.abs(valid), 98)), 0.1) if valid.size else 1.0
        image = self._map(row, column, centimetres, "error", "RdBu_r", (-limit, limit))
        self._bar(image, row, column, column, "result - truth, cm", extend="both")

    def angles(self, row: int, column: int, depth: Tensor, truth: Tensor) -> None:
        """Draw the angle between the two normals in degrees."""
        degrees = angles_between(self._camera, depth, truth)[0].numpy()
        image = self._map(row, column, degrees, "error of the normals", "magma", (0, 60))
        self._bar(image, row, column, column, "degrees", extend="max")

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

    def _panel(self, row: int, column: int) -> Bbox:
        """Return the space of a panel."""
        top = self.figure.get_figheight() - _ABOVE - row * (self._panel_height + _BETWEEN)
        left = _GAP + column * (_PANEL + _GAP)
        return Bbox.from_bounds(left, top - self._panel_height, _PANEL, self._panel_height)

    def _place(self, row: int, column: int) -> Bbox:
        """Return where the picture of a panel is, in the middle of its space."""
        return fitted(self._panel(row, column), self._aspect)

    def _map(
        self, row: int, column: int, values: np.ndarray, title: str, colour_map: str, limits: tuple[float, float]
    ) -> AxesImage:
        """Draw a panel of values, (H, W)."""
        self._title(row, column, title)
        place = self._place(row, column)
        return self.show(place, values, colour_map=colour_map, limits=limits, interpolation="nearest")

    def _title(self, row: int, column: int, text: str) -> None:
        """Write the title above a panel."""
        panel = self._panel(row, column)
        self.text((panel.x0 + panel.x1) / 2, self._place(row, column).y1 + 0.08, text, fontsize=12, ha="center")

    def _bar(self, image: AxesImage, row: int, first: int, last: int, label: str, extend: str = "neither") -> None:
        """Draw a colour bar below the panels from one column to another."""
        left, right = self._panel(row, first).x0, self._panel(row, last).x1
        width = min(right - left, 1.6 * _PANEL) - 0.2 * _PANEL
        place = Bbox.from_bounds((left + right - width) / 2, self._place(row, last).y0 - 0.19, width, 0.09)
        self.bar(image, place, extend=extend, orientation="horizontal").set_label(label, labelpad=1)
