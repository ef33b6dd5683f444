"""Comparison picture of a depth map before and after upsampling, as a surface lit from above."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.image import AxesImage
from matplotlib.transforms import Bbox
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.surface import render_for_viewing
from dsr.io.exports import normal_strips
from dsr.pictures.canvas import Canvas, colours, without_collections, write_figure
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


class _Part(NamedTuple):
    """A rectangle of the picture in relative coordinates: 0 is the left or upper edge, 1 the right or lower edge."""

    left: float
    right: float
    top: float
    bottom: float


_WHOLE = _Part(0, 1, 0, 1)


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
    sheet = _Sheet(camera.height / camera.width, title)
    pictures = ((rgb.float(), f"photo, {size}"), (before, f"before, {size_lr}"), (after, f"after, {size}"))
    for column, (picture, heading) in enumerate(pictures):
        place = sheet.place(0, column)
        sheet.text((place.x0 + place.x1) / 2, place.y1 + 0.08, heading, fontsize=13, ha="center")
        sheet.panel(0, column, reduced(picture, _LONGEST))
        sheet.frame(_part_of(place, part), facecolor="none", edgecolor=_FRAME, linewidth=1.8)
        sheet.panel(1, column, picture, part)
        sheet.frame(sheet.place(1, column), facecolor="none", edgecolor=_FRAME, linewidth=2.5)
    sheet.panel(2, 0, (1 + torch.tensor([1, -1, -1])[:, None, None] * reduced(normals, _LONGEST)) / 2)
    limits = limits_of(depth_lr)
    for column, values in ((1, depth_lr), (2, depth)):
        image = sheet.panel(2, column, reduced(values.float(), _LONGEST), depth=limits)
    sheet.colour_bar(image)
    if not (depth_lr.isfinite().all() and depth.isfinite().all()):
        sheet.text(0.99 * sheet.figure.get_figwidth(), 0.3, "pink: holes", ha="right", va="center", fontsize=11)
    dpi = round(0.75 * max(camera.width, camera.height) / max(sheet.size))
    write_figure(path, sheet.figure, min(max(dpi, _FEWEST_DPI), _DPI))


def _normals(depth: Tensor, camera: Camera) -> Tensor:
    """Compute the normals of a depth map, (3, H, W) float32."""
    normals = torch.empty((3, camera.height, camera.width))
    for rows, part in normal_strips(depth, camera):
        normals[:, rows] = part
    return normals


def _detail(before: Tensor, after: Tensor) -> _Part:
    """Find the window in which two renderings, of any sizes, differ most."""
    enlarged = functional.interpolate(before[None], tuple(after.shape[-2:]), mode="nearest-exact")[0]
    difference = reduced((enlarged - after).abs(), _LONGEST)[0].numpy()
    height, width = difference.shape
    window = strongest_window(difference, math.ceil(height / _DETAIL), math.ceil(width / _DETAIL))
    if window is None:  # the window is never larger than the picture
        return _WHOLE
    right, bottom = window.left + window.width, window.top + window.height
    return _Part(window.left / width, right / width, window.top / height, bottom / height)


class _Sheet(Canvas):
    """Three by three panels under a heading."""

    def __init__(self, aspect: float, title: str) -> None:
        width = min(_PANEL, _TALLEST / aspect)
        self.size = (width, width * aspect)
        self._pitch = max(width, _NARROWEST) + _GAP
        height = _HEADING + 3 * (self.size[1] + _BETWEEN) + _BELOW
        super().__init__(_LEFT + 3 * self._pitch, height)
        self.text(_LEFT, height - 0.3, title, fontsize=16, va="center", weight="bold")
        for row, label in enumerate(_ROWS if self.size[1] > 1 else ()):
            place = self.place(row, 0)
            middle = (place.y0 + place.y1) / 2
            self.text(0.5 * _LEFT, middle, label, rotation=90, ha="center", va="center", fontsize=12)

    def place(self, row: int, column: int) -> Bbox:
        """Return where a panel is."""
        width, height = self.size
        left = _LEFT + column * self._pitch + (self._pitch - _GAP - width) / 2
        top = self.figure.get_figheight() - _HEADING - row * (height + _BETWEEN)
        return Bbox.from_bounds(left, top - height, width, height)

    def panel(
        self, row: int, column: int, values: Tensor, part: _Part = _WHOLE, depth: tuple[float, float] | None = None
    ) -> AxesImage:
        """Draw a picture (3, H, W), a rendering (1, H, W) or depth (1, H, W) within two limits, or a part of it."""
        shown, covered = _cut(values, part)
        place = self.place(row, column)
        picture = _with_holes(shown) if len(shown) == 3 else shown[0].numpy()
        colour_map = "gray" if depth is None else "viridis"
        width, height = place.width / (part.right - part.left), place.height / (part.bottom - part.top)
        whole = Bbox.from_bounds(place.x0 - part.left * width, place.y1 + (part.top - 1) * height, width, height)
        return self.show(
            _part_of(whole, covered), picture, colour_map=colour_map, limits=depth or (0.0, 1.0), within=place
        )

    def colour_bar(self, image: AxesImage) -> None:
        """Draw the colour bar of the depth in the last row."""
        place = Bbox.from_bounds(_LEFT + 1.25 * self._pitch, 0.42, 1.5 * self._pitch - _GAP, 0.1)
        self.bar(image, place, most=6, orientation="horizontal").set_label("depth, m", fontsize=11, labelpad=1)


def _cut(values: Tensor, part: _Part) -> tuple[Tensor, _Part]:
    """Return the pixels of a (C, H, W) picture that overlap a part of it, and which part they are."""
    height, width = values.shape[-2:]
    top, bottom = math.floor(part.top * height), math.ceil(part.bottom * height)
    left, right = math.floor(part.left * width), math.ceil(part.right * width)
    return values[:, top:bottom, left:right], _Part(left / width, right / width, top / height, bottom / height)


def _part_of(place: Bbox, part: _Part) -> Bbox:
    """Return where a part of a picture is that is drawn at a place."""
    x0, x1 = (place.x0 + at * place.width for at in (part.left, part.right))
    y1, y0 = (place.y1 - at * place.height for at in (part.top, part.bottom))
    return Bbox.from_extents(x0, y0, x1, y1)


def _with_holes(picture: Tensor) -> np.ndarray:
    """Convert a (3, H, W) picture to (H, W, 3) with holes in the hole colour."""
    valid = picture.isfinite().all(dim=0)
    hole_colour = torch.tensor(colours("gray").get_bad()[:3], dtype=picture.dtype)
    return torch.where(valid[..., None], picture.permute(1, 2, 0), hole_colour).clamp(0, 1).numpy()
