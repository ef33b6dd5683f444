"""Picture of the expected errors of a result, beside the measured ones where there is a truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.transforms import Bbox
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.pictures.canvas import Canvas, fitted, without_collections, write_figure
from dsr.pictures.depth_views import angles_between, reduced

_PANEL, _ABOVE, _BELOW, _LEFT = 4.6, 0.4, 0.75, 0.4
"""Width of a panel, space above and below it, and left of all panels, inches."""
_DPI, _LONGEST = 160, 1472
"""Pixels per inch, and of the longer side of a drawn map: twice a panel."""
_DEGREES = (1.0, 60.0)


@without_collections()
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
    height, width = depth.shape[-2:]
    panel = _PANEL * min(max(height / width, 0.4), 2.5)
    row = panel + _ABOVE + _BELOW
    page = Canvas(2 * _PANEL + 3 * _LEFT, len(rows) * row)
    valid = depth[depth.isfinite()]
    middle = 1e3 * float(valid.median()) if valid.numel() else 1e3
    limits = ((1e-3 * middle, 0.1 * middle), _DEGREES)
    for i, (kind, maps) in enumerate(zip(("expected", "measured"), rows, strict=False)):
        for j, (values, (low, high), what, unit) in enumerate(
            zip(maps, limits, ("depth", "normal"), ("mm", "degrees"), strict=True)
        ):
            left, bottom = _LEFT + j * (_PANEL + _LEFT), (len(rows) - 1 - i) * row + _BELOW
            place = fitted(Bbox.from_bounds(left, bottom, _PANEL, panel), height / width)
            shown = np.clip(reduced(values.float(), _LONGEST)[0].numpy(), low, None)
            image = page.show(place, shown, colour_map="magma", limits=LogNorm(low, high), interpolation="nearest")
            page.text(left + _PANEL / 2, place.y1 + 0.08, f"{kind} error of the {what}", fontsize=12, ha="center")
            below = Bbox.from_bounds(left + 0.1 * _PANEL, place.y0 - 0.2, 0.8 * _PANEL, 0.1)
            page.bar(image, below, orientation="horizontal", extend="both").set_label(unit, labelpad=1)
    write_figure(path, page.figure, _DPI, few_colours=True)
