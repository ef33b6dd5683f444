"""Comparison picture of a depth map before and after upsampling, as a surface lit from above."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.surface import render_for_viewing
from dsr.io.exports import normal_strips
from dsr.pictures.canvas import Canvas, Panels, Part, with_holes, without_collections, write_figure
from dsr.pictures.depth_views import limits_of, reduced, strongest_window

_FEWEST_DPI, _DPI = 120, 200
"""Least and most pixels per inch; between them, a panel has 3 pixels for 4 of the picture."""
_PANEL, _TALLEST, _NARROWEST = 3.78, 4.6, 2.2
"""Maximum panel width, maximum panel height and minimum column width, inches."""
_LEFT, _GAP, _HEADING, _BETWEEN, _BELOW = 0.3, 0.1, 0.92, 0.1, 0.62
"""Space left of the panels, between columns, above the first row, between rows and below the last row, inches."""
_LONGEST = 1536
"""Maximum longer side of a drawn picture, pixels: twice the side of a panel."""
_DETAIL = 4
"""The detail is 1/4 of the picture wide and high."""
_FRAME = "#ff8c00"
_ROWS = ("lit from above", "detail", "normals | depth")


_WHOLE = Part(0, 1, 0, 1)


@without_collections()
def write_before_after(path: Path, rgb: Tensor, depth_lr: Tensor, depth: Tensor, camera: Camera, title: str) -> None:
    """Draw the photo, the input and the result, both as a surface lit from above and as depth.

    The input, (1, h, w) of any size and the same field of view, is rendered at its own resolution, without
    interpolation, and both by :func:`dsr.geometry.surface.render_for_viewing`. The detail is the window in which both
    renderings differ most. The PNG is at most 2400 pixels wide and written atomically.
    """
    normals = _normals(depth, camera)
    before = render_for_viewing(_normals(depth_lr, camera.rescale(depth_lr.shape[-1], depth_lr.shape[-2]))[None])[0]
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
        _show(sheet, place, reduced(picture, _LONGEST))
        sheet.frame(part.of(place), facecolor="none", edgecolor=_FRAME, linewidth=1.8)
        _show(sheet, sheet.place(1, column), picture, part)
        sheet.frame(sheet.place(1, column), facecolor="none", edgecolor=_FRAME, linewidth=2.5)
    _show(sheet, sheet.place(2, 0), (1 + torch.tensor([1, -1, -1])[:, None, None] * reduced(normals, _LONGEST)) / 2)
    limits = limits_of(depth_lr)
    for column, values in ((1, depth_lr), (2, depth)):
        image = _show(sheet, sheet.place(2, column), reduced(values.float(), _LONGEST), depth=limits)
    pitch = column_width + _GAP
    below = Bbox.from_bounds(_LEFT + 1.25 * pitch, 0.42, 1.5 * pitch - _GAP, 0.1)
    sheet.bar(image, below, most=6, orientation="horizontal").set_label("depth, m", fontsize=11, labelpad=1)
    if not (depth_lr.isfinite().all() and depth.isfinite().all()):
        sheet.text(0.99 * sheet.figure.get_figwidth(), 0.3, "pink: holes", ha="right", va="center", fontsize=11)
    dpi = round(0.75 * max(camera.width, camera.height) / max(width, width * aspect))
    write_figure(path, sheet.figure, min(max(dpi, _FEWEST_DPI), _DPI))


def _normals(depth: Tensor, camera: Camera) -> Tensor:
    """Compute the normals of a depth map, (3, H, W) float32."""
    normals = torch.empty((3, camera.height, camera.width))
    for rows, part in normal_strips(depth, camera):
        normals[:, rows] = part
    return normals


def _detail(before: Tensor, after: Tensor) -> Part:
    """Find the window in which two renderings, of any sizes, differ most."""
    enlarged = functional.interpolate(before[None], tuple(after.shape[-2:]), mode="nearest-exact")[0]
    difference = reduced((enlarged - after).abs(), _LONGEST)[0].numpy()
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
