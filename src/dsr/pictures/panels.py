"""The pictures of a result: depth, renderings and errors of an evaluation, expected errors, and before and after."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import render, render_for_viewing
from dsr.io.exports import whole_normals
from dsr.metrics.formats import Formats, describe_directions, in_tables
from dsr.pictures.canvas import Canvas, Panels, Part, with_holes, write_figure
from dsr.pictures.depth_views import angles_between, limits_of, normals_seen_by, reduced, strongest_window
from dsr.sample import DepthSample
from dsr.utils.ratios import round_ratio

_DPI = 160
_LONGEST = 1472  # maximum longer side of a drawn map of errors, pixels: twice a panel
_DEGREES = (1.0, 60.0)  # limits of the colours of normals' errors
_FEWEST_DPI, _MOST_DPI = 120, 200
"""Least and most pixels per inch; between them, a panel has 3 pixels for 4 of the picture."""
_PANEL, _TALLEST, _NARROWEST = 3.78, 4.6, 2.2  # largest width and height of a panel, least of a column, inches
_LEFT, _GAP, _HEADING, _BETWEEN, _BELOW = 0.3, 0.1, 0.92, 0.1, 0.62
"""Space left of the panels, between columns, above the first row, between rows and below the last row, inches."""
_SIDE = 1536  # maximum longer side of a drawn picture, pixels: twice the side of a panel
_DETAIL = 4  # the detail is 1/4 of the picture wide and high
_FRAME = "#ff8c00"
_ROWS = ("lit from above", "detail", "normals | depth")
_WHOLE = Part(0, 1, 0, 1)


def save_picture(
    path: Path, sample: DepthSample, depth: Tensor, scores: Mapping[str, float], label: str, formats: Formats
) -> None:
    """Draw a scene's result, (1, H, W) in metres, with its worst-of-four scores in raw units; write it atomically."""
    truth = sample.depth
    height, width = depth.shape[-2:]
    panel = 3.2, 3.2 * min(max(height / width, 0.4), 2.5)
    page = Panels((2 if truth is None else 3, 5), height / width, panel, (0.1, 0.1), (0.8, 0.95, 0.95))
    maps = [(sample.depth_lr, f"input, {sample.camera_lr.width} x {sample.camera_lr.height}"), (depth, label)]
    if truth is not None:
        maps.append((truth, "truth"))
    page.panel(0, 0, sample.rgb.permute(1, 2, 0).numpy(), f"photo, {width} x {height}", interpolation=None)
    limits = limits_of(depth if truth is None else truth)
    for column, (values, title) in enumerate(maps, 1):
        image = page.panel(0, column, values[0].numpy(), title, colour_map="viridis", limits=limits)
    page.bar_below(image, 0, (1, len(maps)), "depth, m", "neither")
    for row, (values, title) in enumerate(maps[1:], 1):
        shaded = render(normals_seen_by(sample.camera, values))[0].numpy()
        for column, (light, shades) in enumerate(zip(LIGHT_NAMES, shaded, strict=False)):
            page.panel(row, column, shades, f"{title} under {light}")
    if truth is not None:
        error = 100 * (depth - truth)[0].numpy()
        known = np.abs(error[np.isfinite(error)])
        limit = max(float(np.percentile(known, 98)), 0.1) if known.size else 1.0
        image = page.panel(0, 4, error, "error", colour_map="RdBu_r", limits=(-limit, limit))
        page.bar_below(image, 0, (4, 4), "result - truth, cm", "both")
        degrees = angles_between(sample.camera, depth, truth)[0].numpy()
        image = page.panel(1, 4, degrees, "error of the normals", colour_map="magma", limits=(0, 60))
        page.bar_below(image, 1, (4, 4), "degrees", "max")
        shown = {name: each for name, each in in_tables(formats).items() if name in scores}
        lines = [f"scores, {describe_directions(shown)}"]
        for name, each in shown.items():
            lines.append(f"{each.heading:<9}{each.unit:<8}{each.text(scores[name] * each.factor):>9}")
        space = page.space(2, 4)
        style = {"family": "monospace", "fontsize": 11, "va": "top", "linespacing": 1.6}
        page.text(space.x0, space.y1 - 0.05 * space.height, "\n".join(lines), **style)
    holes = "" if all(bool(values.isfinite().all()) for values, _ in maps) else " (pink: holes)"
    heading = f"{sample.dataset} / {sample.scene}, {label} x{round_ratio(sample.scale)}{holes}"
    across, up = page.figure.get_size_inches()
    page.text(across / 2, up - 0.12, heading, fontsize=16, ha="center", va="top")
    write_figure(path, page.figure, _DPI)


def write_confidence(
    path: Path,
    depth: Tensor,
    depth_error: Tensor,
    angle_error: Tensor,
    truth: Tensor | None = None,
    camera: Camera | None = None,
) -> None:
    """Draw the expected errors of depth and normals, in metres and degrees; with a truth, the measured ones below them.

    All maps are (1, H, W), NaN in holes; the camera of these pixels is needed with a truth.
    """
    rows = [[1e3 * depth_error, angle_error]]
    if truth is not None and camera is not None:
        rows.append([1e3 * (depth - truth).abs(), angles_between(camera, depth, truth)])
    valid = depth[depth.isfinite()]
    middle = 1e3 * float(valid.median()) if valid.numel() else 1e3
    limits = ((1e-3 * middle, 0.1 * middle), _DEGREES)
    aspect = depth.shape[-2] / depth.shape[-1]
    page = Panels((len(rows), 2), aspect, (4.6, 4.6 * min(max(aspect, 0.4), 2.5)), (0.4, 0.4), (0.4, 1.15, 0.75))
    for row, (kind, maps) in enumerate(zip(("expected", "measured"), rows, strict=False)):
        for column, (what, unit) in enumerate((("depth", "mm"), ("normal", "degrees"))):
            low, high = limits[column]
            shown = np.clip(reduced(maps[column].float(), _LONGEST)[0].numpy(), low, None)
            title = f"{kind} error of the {what}"
            image = page.panel(row, column, shown, title, colour_map="magma", limits=LogNorm(low, high))
            page.bar_below(image, row, (column, column), unit, "both", height=0.1)
    write_figure(path, page.figure, _DPI, few_colours=True)


def write_before_after(path: Path, rgb: Tensor, depth_lr: Tensor, depth: Tensor, camera: Camera, title: str) -> None:
    """Draw the photo, the input and the result, both as a surface lit from above and as depth.

    The input, (1, h, w) of any size and the same field of view, is rendered at its own resolution, without
    interpolation, and both by :func:`dsr.geometry.surface.render_for_viewing`. The detail is the window in which both
    renderings differ most. The PNG is at most 2400 pixels wide and written atomically.
    """
    normals, view = whole_normals(depth, camera), camera.rescale(depth_lr.shape[-1], depth_lr.shape[-2])
    before = render_for_viewing(whole_normals(depth_lr, view)[None])[0]
    after = render_for_viewing(normals[None])[0]
    part = _detail(before, after)
    size, size_lr = (f"{each.shape[-1]} x {each.shape[-2]}" for each in (depth, depth_lr))
    aspect = camera.height / camera.width
    width = min(_PANEL, _TALLEST / aspect)
    column_width = max(width, _NARROWEST)
    across, down = (_LEFT, _GAP), (_HEADING, _BETWEEN, _BETWEEN + _BELOW)
    sheet = Panels((3, 3), aspect, (column_width, width * aspect), across, down)
    sheet.text(_LEFT, sheet.figure.get_figheight() - 0.3, title, fontsize=16, va="center", weight="bold")
    for row, label in enumerate(_ROWS if width * aspect > 1 else ()):
        place = sheet.place(row, 0)
        middle = (place.y0 + place.y1) / 2
        sheet.text(0.5 * _LEFT, middle, label, rotation=90, ha="center", va="center", fontsize=12)
    pictures = ((rgb.float(), f"photo, {size}"), (before, f"before, {size_lr}"), (after, f"after, {size}"))
    for column, (picture, heading) in enumerate(pictures):
        place = sheet.place(0, column)
        sheet.text((place.x0 + place.x1) / 2, place.y1 + 0.08, heading, fontsize=13, ha="center")
        _show(sheet, place, reduced(picture, _SIDE))
        sheet.frame(part.of(place), facecolor="none", edgecolor=_FRAME, linewidth=1.8)
        _show(sheet, sheet.place(1, column), picture, part)
        sheet.frame(sheet.place(1, column), facecolor="none", edgecolor=_FRAME, linewidth=2.5)
    _show(sheet, sheet.place(2, 0), (1 + torch.tensor([1, -1, -1])[:, None, None] * reduced(normals, _SIDE)) / 2)
    limits = limits_of(depth_lr)
    for column, values in ((1, depth_lr), (2, depth)):
        image = _show(sheet, sheet.place(2, column), reduced(values.float(), _SIDE), depth=limits)
    pitch = column_width + _GAP
    below = Bbox.from_bounds(_LEFT + 1.25 * pitch, 0.42, 1.5 * pitch - _GAP, 0.1)
    sheet.bar(image, below, most=6, orientation="horizontal").set_label("depth, m", fontsize=11, labelpad=1)
    if not (depth_lr.isfinite().all() and depth.isfinite().all()):
        sheet.text(0.99 * sheet.figure.get_figwidth(), 0.3, "pink: holes", ha="right", va="center", fontsize=11)
    dpi = round(0.75 * max(camera.width, camera.height) / max(width, width * aspect))
    write_figure(path, sheet.figure, min(max(dpi, _FEWEST_DPI), _MOST_DPI))


def _detail(before: Tensor, after: Tensor) -> Part:
    """Find the window in which two renderings, of any sizes, differ most."""
    enlarged = functional.interpolate(before[None], tuple(after.shape[-2:]), mode="nearest-exact")[0]
    difference = reduced((enlarged - after).abs(), _SIDE)[0].numpy()
    height, width = difference.shape
    window = strongest_window(difference, math.ceil(height / _DETAIL), math.ceil(width / _DETAIL))
    if window is None:  # the window is never larger than the picture
        return _WHOLE
    right, bottom = window.left + window.width, window.top + window.height
    return Part(window.left / width, right / width, window.top / height, bottom / height)


def _show(
    sheet: Canvas, place: Bbox, values: Tensor, part: Part = _WHOLE, depth: tuple[float, float] | None = None
) -> AxesImage:
    """Draw a picture (3, H, W), a rendering (1, H, W) or depth (1, H, W) within two limits, or a part of it."""
    height, width = values.shape[-2:]
    top, bottom = math.floor(part.top * height), math.ceil(part.bottom * height)
    left, right = math.floor(part.left * width), math.ceil(part.right * width)
    shown = values[:, top:bottom, left:right]  # the pixels that overlap the part
    picture = with_holes(shown.permute(1, 2, 0).numpy()).clip(0, 1) if len(shown) == 3 else shown[0].numpy()
    across, down = place.width / (part.right - part.left), place.height / (part.bottom - part.top)
    whole = Bbox.from_bounds(place.x0 - part.left * across, place.y1 + (part.top - 1) * down, across, down)
    covered = Part(left / width, right / width, top / height, bottom / height).of(whole)
    colour_map = "gray" if depth is None else "viridis"
    return sheet.show(covered, picture, colour_map=colour_map, limits=depth or (0.0, 1.0), within=place)
