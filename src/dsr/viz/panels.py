"""One picture per scene: photo, depth maps in pseudo-colour, renderings under the four lights, errors."""

from __future__ import annotations

import contextlib
import gc
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox
from PIL import Image
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.shading import render
from dsr.geometry.surface import depth_to_normals
from dsr.metrics.formats import Formats, describe_directions, in_tables
from dsr.sample import DepthSample
from dsr.utils.files import replacing
from dsr.utils.ratios import round_ratio
from dsr.viz.canvas import Canvas, fitted

_PANEL, _GAP, _ABOVE, _BETWEEN = 3.2, 0.1, 0.8, 0.95
"""Panel width, space beside panels, for the heading, and between rows for a colour bar and a title, inches."""
_DPI = 160
"""A panel of 3.2 inches has 512 pixels."""
_PNG_LEVEL = 3
"""Compression of PNG files: half the time of the usual level 6, for files that are 7 % larger."""


@contextlib.contextmanager
def without_collections() -> Iterator[None]:
    """Leave garbage alone within the context: Matplotlib makes so many objects that to go through them takes long."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@without_collections()
def save_picture(
    path: Path, sample: DepthSample, depth: Tensor, scores: Mapping[str, float], label: str, formats: Formats
) -> None:
    """Draw a scene's result and write it atomically.

    Args:
        path: PNG file.
        sample: input of the method.
        depth: (1, H, W) result in metres, NaN in holes.
        scores: worst-of-four scores in raw units, by metric; empty without ground truth.
        label: name of the method.
        formats: formats of the metrics.

    """
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
    page.heading(f"{sample.dataset} / {sample.scene}, {label} x{round_ratio(sample.scale)}{holes}")
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
        cosine = (normals_seen_by(self._camera, depth) * normals_seen_by(self._camera, truth)).sum(dim=1)[0]
        degrees = torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).numpy()
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

    def heading(self, text: str) -> None:
        """Write the heading."""
        width, height = self.figure.get_size_inches()
        self.text(width / 2, height - 0.12, text, fontsize=16, ha="center", va="top")

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


def write_figure(path: Path, figure: Figure, dpi: int, metadata: Mapping[str, Any] | None = None) -> None:
    """Write a figure atomically, in the format given by the suffix."""
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a name may have letters that the font lacks
        if path.suffix == ".png":
            _write_png(temporary, figure, dpi)
        else:
            figure.savefig(temporary, dpi=dpi, metadata=metadata)


def _write_png(path: Path, figure: Figure, dpi: int) -> None:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    opaque = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")  # 3 channels are written faster
    opaque.save(path, "PNG", compress_level=_PNG_LEVEL, dpi=(dpi, dpi))


def limits_of(depth: Tensor) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the valid depths, so that outliers do not stretch the colour range."""
    valid = depth[depth.isfinite()].numpy()
    low, high = np.percentile(valid, [1, 99]) if valid.size else (0, 1)
    return float(low), float(max(high, low + 1e-6))


class Window(NamedTuple):
    """A window of a picture: ``height x width`` pixels, the first at (``top``, ``left``)."""

    top: int
    left: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the window."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


def strongest_window(values: np.ndarray, height: int, width: int, taken: Sequence[Window] = ()) -> Window | None:
    """Return the window with the largest mean that does not overlap others.

    Args:
        values: (H, W) non-negative values; NaN counts as 0.
        height: height of the window, pixels.
        width: width of the window, pixels.
        taken: windows that the result must not overlap.

    Returns:
        The first of the best windows in reading order; None if no window fits.

    """
    if height > values.shape[0] or width > values.shape[1]:
        return None
    sums = np.pad(np.nan_to_num(values).astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    totals = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    totals = totals.round(9)  # rounding errors must not decide between equal windows
    for other in taken:
        rows = slice(max(0, other.top - height + 1), other.top + other.height)
        totals[rows, max(0, other.left - width + 1) : other.left + other.width] = -1
    top, left = np.unravel_index(int(totals.argmax()), totals.shape)
    return None if totals[top, left] < 0 else Window(int(top), int(left), height, width)


def reduced(values: Tensor, longest: int) -> Tensor:
    """Reduce (C, H, W) by averaging blocks of pixels until the longer side is at most ``longest`` pixels.

    A block of which less than half is valid becomes NaN.
    """
    factor = math.ceil(max(values.shape[-2:]) / longest)
    if factor == 1:
        return values
    valid = values.isfinite()
    total, weight = (
        functional.avg_pool2d(each.to(values.dtype), factor, ceil_mode=True, count_include_pad=False)
        for each in (torch.where(valid, values, 0), valid)
    )
    return torch.where(weight >= 0.5, total / weight.clamp(min=0.5), torch.nan)


def normals_seen_by(camera: Camera, depth: Tensor) -> Tensor:
    """Compute the normals of a depth map, (1, H, W) in metres, as (1, 3, H, W); NaN where they are undefined."""
    return depth_to_normals(depth.double()[None], camera.rays()[None])
