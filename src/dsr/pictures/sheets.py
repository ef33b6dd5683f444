"""Contact sheets: one row per scene of a data set, to check that it was read correctly."""

import itertools
import math
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.transforms import Bbox
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.surface import render
from dsr.pictures.canvas import HOLE_COLOUR, Canvas, write_figure
from dsr.pictures.depth_views import limits_of, normals_seen_by, reduced
from dsr.sample import Scene
from dsr.utils.ratios import round_ratio

_ROWS = 6
_DPI = 100
_PANEL = 2.56  # longer side of a panel, inches: 256 pixels
_LONGEST = 512  # maximum longer side of a picture, pixels
_LEAST_PANEL = 0.3  # minimum shorter side of a panel, inches
_TEXT, _MARGIN, _GAP, _ABOVE, _BELOW = 2.6, 0.15, 0.14, 0.8, 0.5
"""Width of the text column, margin, and space between panels, above the first row and below each row, inches."""
_LEFT = tuple(_MARGIN + _TEXT + column * (_PANEL + _GAP) for column in range(4))
"""Left edges of the columns of panels, inches."""
_SEAM, _LEAST_LABELLED = 0.04, 0.35
"""Space between the renderings, and minimum shorter side of a rendering with a label, inches."""
_LABEL = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.2}
_VALID_COLOUR = "#e4e4e4"
_LETTERS, _LINE = 27, 0.165  # maximum letters of a line of text, and its height in inches


@dataclass(frozen=True)
class _Row:
    """What a sheet shows of a scene: pictures (H, W), (H, W, 3) or (4, H, W), reduced to the size drawn."""

    text: str
    shape: tuple[int, int]
    photo: np.ndarray
    depth: np.ndarray
    limits: tuple[float, float]
    missing: np.ndarray
    missing_fraction: float
    renderings: np.ndarray


def save_contact_sheet(path: Path, scenes: Iterable[Scene], title: str) -> list[Path]:
    """Draw the photo, depth, holes and renderings of scenes, a row each, write the pages atomically and return files.

    Scenes are read one by one, so they need not fit into memory together. A scene without high-resolution depth shows
    its measured map of the lowest resolution. More than six scenes are written to ``NAME-1.png``, ``NAME-2.png``, ...
    """
    rows = map(_row, scenes)
    page, following = list(itertools.islice(rows, _ROWS)), next(rows, None)
    if not page:
        raise ValueError(f"{path}: expected a scene or more for a contact sheet, got none")
    if following is None:
        _save_page(path, page, title)
        return [path]
    paths: list[Path] = []
    while page:
        paths.append(path.with_name(f"{path.stem}-{len(paths) + 1}{path.suffix}"))
        first = _ROWS * (len(paths) - 1) + 1
        _save_page(paths[-1], page, f"{title}, scenes {first} to {first + len(page) - 1}")
        page = [] if following is None else [following, *itertools.islice(rows, _ROWS - 1)]
        following = next(rows, None)
    return paths


def _row(scene: Scene) -> _Row:
    depth, camera, what = _shown_map(scene)
    view = scene.camera
    axes = ((view.width, view.fx, view.cx), (view.height, view.fy, view.cy))
    angles = (math.atan((at + 0.5) / f) + math.atan((size - 0.5 - at) / f) for size, f, at in axes)  # to the edges
    valid = depth[depth.isfinite()]
    missing_fraction = 1 - valid.numel() / depth.numel()
    lines = [
        *textwrap.wrap(scene.name, _LETTERS, break_on_hyphens=False),
        "",
        *textwrap.wrap(scene.dataset, _LETTERS, break_on_hyphens=False),
        f"{view.width} x {view.height} pixels",
        "field of view {:.0f} x {:.0f} degrees".format(*map(math.degrees, angles)),
        *what,
        f"depth {float(valid.min()):.3g} to {float(valid.max()):.3g} m",
        f"holes: {100 * missing_fraction:.3g} %" if missing_fraction else "holes: none",
    ]
    large_enough = min(depth.shape[-2:]) >= 2
    shades = render(normals_seen_by(camera, depth))[0] if large_enough else torch.full((4, 2, 2), torch.nan)
    maps = (scene.rgb, depth, (~depth.isfinite()).float(), shades)
    photo, shown, missing, renderings = (reduced(each.double(), _LONGEST).numpy() for each in maps)
    return _Row(
        "\n".join(lines),
        (view.height, view.width),
        photo.transpose(1, 2, 0).clip(0, 1),
        shown[0],
        limits_of(depth),
        missing[0],
        missing_fraction,
        renderings,
    )


def _shown_map(scene: Scene) -> tuple[Tensor, Camera, list[str]]:
    """Return the depth map to show, its camera, and lines of text about the maps measured by a sensor."""
    measured = ", ".join(f"x{round_ratio(ratio)}" for ratio in sorted(scene.measured))
    if scene.depth is not None:
        return scene.depth, scene.camera, [f"also measured: {measured}"] if measured else []
    ratio = max(scene.measured)
    depth_lr = scene.measured[ratio]
    width, height = depth_lr.shape[-1], depth_lr.shape[-2]
    return (
        depth_lr,
        scene.camera.reduce(width, height),
        [f"measured: {measured}; no high-resolution depth", f"shown: x{round_ratio(ratio)}, {width} x {height}"],
    )


def _save_page(path: Path, rows: list[_Row], title: str) -> None:
    sides = [[_PANEL * side / max(row.shape) for side in row.shape] for row in rows]
    sizes = [(max(width, _LEAST_PANEL), max(height, _LEAST_PANEL)) for height, width in sides]  # inches
    heights = [max(size[1] + _BELOW, (row.text.count("\n") + 2) * _LINE) for row, size in zip(rows, sizes, strict=True)]
    total = _ABOVE + sum(heights)
    page = Canvas(_MARGIN + _TEXT + 4 * (_PANEL + _GAP), total)
    page.text(_MARGIN, total - 0.12, f"{title} (pink: holes)", fontsize=14, va="top")
    for column, heading in enumerate(("photo", "depth, m", "holes", f"under {LIGHT_NAMES[0]} to {LIGHT_NAMES[-1]}")):
        page.text(_LEFT[column] + _PANEL / 2, total - _ABOVE + 0.08, heading, ha="center", fontsize=11)
    top = total - _ABOVE
    for row, size, height in zip(rows, sizes, heights, strict=True):
        _draw_row(page, row, top, size)
        top -= height
    write_figure(path, page.figure, _DPI)


def _draw_row(page: Canvas, row: _Row, top: float, size: tuple[float, float]) -> None:
    """Draw the text and panels of a scene with their upper edge ``top`` inches above the lower edge of the page."""
    name, _, rest = row.text.partition("\n\n")
    lines = name.count("\n") + 1
    style = {"va": "top", "fontsize": 9, "linespacing": 1.25}
    page.text(_MARGIN, top, name, weight="bold", **style)
    page.text(_MARGIN, top - 0.05 - _LINE * lines, rest, **style)
    width, height = size
    photo, depth, holes, lit = (
        Bbox.from_bounds(_LEFT[column] + (_PANEL - width) / 2, top - height, width, height) for column in range(4)
    )
    page.show(photo, row.photo)
    low, high = row.limits
    limits = (low, max(high, 1.01 * low))  # so that the ticks of a constant depth differ
    image = page.show(depth, row.depth, colour_map="viridis", limits=limits)
    below = Bbox.from_bounds(_LEFT[1] + 0.1 * _PANEL, top - height - 0.14, 0.8 * _PANEL, 0.07)
    bar = page.bar(image, below, most=4, orientation="horizontal")
    bar.ax.tick_params(labelsize=8, pad=1.5, length=2)
    known, hole = (np.array(to_rgb(colour)) for colour in (_VALID_COLOUR, HOLE_COLOUR))
    page.show(holes, known + row.missing[..., None] * (hole - known))
    caption = f"{100 * row.missing_fraction:.3g} % missing" if row.missing_fraction else "complete"
    page.text((holes.x0 + holes.x1) / 2, holes.y0 - 0.06, caption, ha="center", va="top", fontsize=9)
    across, down = (width - _SEAM) / 2, (height - _SEAM) / 2
    for number, (light, shades) in enumerate(zip(LIGHT_NAMES, row.renderings, strict=True)):
        line, right = divmod(number, 2)
        left, bottom = lit.x0 + right * (across + _SEAM), top - down - line * (down + _SEAM)
        page.show(Bbox.from_bounds(left, bottom, across, down), shades)
        if min(across, down) > _LEAST_LABELLED:
            page.text(left + 0.05, bottom + 0.05, light, fontsize=7, bbox=_LABEL)
