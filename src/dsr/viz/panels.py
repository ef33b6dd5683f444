"""One picture per scene: photo, depth maps in pseudo-colour, renderings under the four lights, errors."""

from __future__ import annotations

import contextlib
import gc
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.shading import LIGHT_NAMES, render
from dsr.geometry.surface import depth_to_normals
from dsr.metrics.formats import Formats, describe_directions, in_tables
from dsr.sample import DepthSample
from dsr.utils.files import replacing
from dsr.utils.ratios import round_ratio

HOLE_COLOUR = "#d684b4"
_PANEL = 3.2
_ABOVE = 0.8
_BETWEEN = 0.95
"""Panel width, space for the heading, and space between rows for a colour bar and a title, inches."""
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
    rows = 2 if truth is None else 3
    height, width = depth.shape[-2:]
    panel = _PANEL * min(max(height / width, 0.4), 2.5)
    figure_height = _ABOVE + rows * (panel + _BETWEEN)
    figure = Figure(figsize=(5 * _PANEL + 0.6, figure_height))
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 5, squeeze=False)
    bottom, top = _BETWEEN / figure_height, 1 - _ABOVE / figure_height
    figure.subplots_adjust(left=0.01, right=0.99, bottom=bottom, top=top, wspace=0.04, hspace=_BETWEEN / panel)
    for axis in axes.flat:
        axis.set_axis_off()
    limits = limits_of(depth if truth is None else truth)
    axes[0, 0].imshow(sample.rgb.permute(1, 2, 0).numpy())
    _title(axes[0, 0], f"photo, {width} x {height}")
    _show_depth(axes[0, 1], sample.depth_lr, limits, f"input, {sample.camera_lr.width} x {sample.camera_lr.height}")
    _show_depth(axes[0, 2], depth, limits, label)
    _show_renderings(axes[1], sample, depth, label)
    if truth is not None:
        _show_depth(axes[0, 3], truth, limits, "truth")
        _show_error(axes[0, 4], depth - truth)
        _show_renderings(axes[2], sample, truth, "truth")
        _show_angles(axes[1, 4], sample, depth, truth)
        _write_scores(axes[2, 4], scores, formats)
    maps = (depth, sample.depth_lr) if truth is None else (depth, sample.depth_lr, truth)
    holes = "" if all(bool(values.isfinite().all()) for values in maps) else " (pink: holes)"
    heading = f"{sample.dataset} / {sample.scene}, {label} x{round_ratio(sample.scale)}{holes}"
    figure.suptitle(heading, fontsize=16, y=1 - 0.12 / figure_height, parse_math=False)
    write_figure(path, figure, _DPI)


def write_figure(path: Path, figure: Figure, dpi: int, metadata: Mapping[str, Any] | None = None) -> None:
    """Write a figure atomically, in the format given by the suffix."""
    options: dict[str, Any] = {"pil_kwargs": {"compress_level": _PNG_LEVEL}} if path.suffix == ".png" else {}
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a name may have letters that the font lacks
        figure.savefig(temporary, dpi=dpi, metadata=metadata, **options)


def limits_of(depth: Tensor) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the valid depths, so that outliers do not stretch the colour range."""
    valid = depth[depth.isfinite()].numpy()
    low, high = np.percentile(valid, [1, 99]) if valid.size else (0, 1)
    return float(low), float(max(high, low + 1e-6))


def colours(name: str | Colormap) -> Any:
    """Return a colour map that shows NaN in the hole colour."""
    return mpl.colormaps.get_cmap(name).with_extremes(bad=HOLE_COLOUR)


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


def _show_depth(axis: Axes, depth: Tensor, limits: tuple[float, float], title: str) -> None:
    """Draw depth in metres, (1, H, W)."""
    low, high = limits
    image = axis.imshow(depth[0].numpy(), cmap=colours("viridis"), vmin=low, vmax=high, interpolation="nearest")
    _title(axis, title)
    _colour_bar(axis, image, "depth, m")


def _show_error(axis: Axes, difference: Tensor) -> None:
    """Draw a signed error, (1, H, W) in metres, in centimetres."""
    centimetres = 100 * difference[0].numpy()
    valid = centimetres[np.isfinite(centimetres)]
    limit = max(float(np.percentile(np.abs(valid), 98)), 0.1) if valid.size else 1.0
    image = axis.imshow(centimetres, cmap=colours("RdBu_r"), vmin=-limit, vmax=limit, interpolation="nearest")
    _title(axis, "error")
    _colour_bar(axis, image, "result - truth, cm", extend="both")


def _show_renderings(axes: np.ndarray, sample: DepthSample, depth: Tensor, title: str) -> None:
    """Draw the renderings of a depth map, (1, H, W), under the four lights."""
    normals = normals_seen_by(sample.camera, depth)
    for axis, name, shades in zip(axes, LIGHT_NAMES, render(normals)[0], strict=False):
        axis.imshow(shades.numpy(), cmap=colours("gray"), vmin=0, vmax=1, interpolation="nearest")
        _title(axis, f"{title} under {name}")


def _show_angles(axis: Axes, sample: DepthSample, depth: Tensor, truth: Tensor) -> None:
    """Draw the angle between the two normals in degrees."""
    cosine = (normals_seen_by(sample.camera, depth) * normals_seen_by(sample.camera, truth)).sum(dim=1)[0]
    degrees = torch.rad2deg(torch.arccos(cosine.clamp(-1, 1))).numpy()
    image = axis.imshow(degrees, cmap=colours("magma"), vmin=0, vmax=60, interpolation="nearest")
    _title(axis, "error of the normals")
    _colour_bar(axis, image, "degrees", extend="max")


def _title(axis: Axes, text: str) -> None:
    """Write a title at the upper edge of a panel; Matplotlib would look for a place above ticks, which takes longer."""
    axis.set_title(text, y=1.0, parse_math=False)


def _colour_bar(axis: Axes, image: Any, label: str, extend: str = "neither") -> None:
    """Put a colour bar under a panel without moving it."""
    height = axis.get_window_extent().height / axis.figure.dpi
    place = axis.inset_axes((0.1, -0.19 / height, 0.8, 0.09 / height))
    bar = axis.figure.colorbar(image, cax=place, orientation="horizontal", extend=extend)
    bar.set_label(label, labelpad=1)


def normals_seen_by(camera: Camera, depth: Tensor) -> Tensor:
    """Compute the normals of a depth map, (1, H, W) in metres, as (1, 3, H, W); NaN where they are undefined."""
    return depth_to_normals(depth.double()[None], camera.rays()[None])


def _write_scores(axis: Axes, scores: Mapping[str, float], formats: Formats) -> None:
    """Write the scores in the units of tables."""
    shown = {name: each for name, each in in_tables(formats).items() if name in scores}
    lines = [
        f"{each.heading:<9}{each.unit:<8}{each.text(scores[name] * each.factor):>9}" for name, each in shown.items()
    ]
    text = "\n".join([f"scores, {describe_directions(shown)}", *lines])
    axis.text(
        0,
        0.95,
        text,
        family="monospace",
        fontsize=11,
        parse_math=False,
        va="top",
        linespacing=1.6,
        transform=axis.transAxes,
    )
