"""The pictures of a result: photo, depth, renderings and errors, and the errors that a method expects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import render
from dsr.metrics.formats import Formats, describe_directions, in_tables
from dsr.pictures.canvas import Panels, without_collections, write_figure
from dsr.pictures.depth_views import angles_between, limits_of, normals_seen_by, reduced
from dsr.sample import DepthSample
from dsr.utils.ratios import round_ratio

_DPI = 160
_LONGEST = 1472
"""Maximum longer side of a drawn map of errors, pixels: twice a panel."""
_DEGREES = (1.0, 60.0)
"""Limits of the colours of normals' errors."""


@without_collections()
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
