"""Figure of the four lights: a sphere and a surface under each."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from dsr.geometry.lights import LIGHTS, Direction
from dsr.geometry.surface import render
from dsr.pictures.canvas import colours, save_both
from dsr.pictures.depth_views import rendering
from dsr.sample import DepthSample

_SPHERE = 401  # diameter of a sphere, pixels
_FONT = 8
_PANEL, _GAP, _AXES, _ABOVE, _MARGIN = 1.42, 0.08, 0.95, 0.4, 0.06
_ARROW = "#d1495b"
_HALF_WIDTH = 1.32  # half the width of a sphere's panel, in radii


def save_lights_figure(folder: Path, scene: DepthSample | None = None) -> list[Path]:
    """Draw a sphere and the true surface of a scene under the four lights, with arrows along them; return files."""
    rows = 1 if scene is None else 2
    aspect = 1.0 if scene is None else min(scene.camera.height / scene.camera.width, 1.5)
    width = _MARGIN + _AXES + len(LIGHTS) * (_PANEL + _GAP)
    height = _ABOVE + _PANEL + (rows - 1) * (_PANEL * aspect + _GAP) + _MARGIN
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)

    def axes(left: float, bottom: float, across: float, down: float, label: str) -> Axes:
        place = figure.add_axes((left / width, bottom / height, across / width, down / height), label=label)
        place.set_axis_off()
        return place

    upper = height - _ABOVE - _PANEL
    _draw_frame(axes(_MARGIN, upper + (_PANEL - _AXES) / 2, _AXES, _AXES, "camera frame"))
    ramp = torch.linspace(-1, 1, _SPHERE, dtype=torch.float64)
    y, x = torch.meshgrid(ramp, ramp, indexing="ij")
    square = 1 - x.square() - y.square()
    normals = torch.where(square >= 0, torch.stack((x, y, -square.clamp(min=0).sqrt())), torch.nan)
    sphere = render(normals[None])[0].numpy()  # in orthographic projection
    for number, (name, light) in enumerate(LIGHTS.items()):
        left = _MARGIN + _AXES + number * (_PANEL + _GAP) + _GAP
        panel = axes(left, upper, _PANEL, _PANEL, f"sphere under {name}")
        _draw_sphere(panel, sphere[number], light.direction)
        for line, text in enumerate((light.formula, name)):
            place = ((left + _PANEL / 2) / width, (upper + _PANEL + 0.08 + 0.16 * line) / height)
            figure.text(*place, text, ha="center", va="baseline", fontsize=_FONT - 0.5)
        if scene is not None and scene.depth is not None:
            surface = axes(left, _MARGIN, _PANEL, _PANEL * aspect, f"{scene.scene} under {name}")
            shades = rendering(scene.depth, scene.camera, name)
            surface.imshow(shades, cmap=colours("gray"), vmin=0, vmax=1, aspect="auto")
    return save_both(folder, "lights", figure)


def _draw_sphere(axes: Axes, shades: np.ndarray, direction: Direction) -> None:
    axes.imshow(np.ma.masked_invalid(shades), cmap="gray", vmin=0, vmax=1, extent=(-1, 1, 1, -1))
    axes.add_patch(Circle((0, 0), 1, facecolor="none", edgecolor="0.6", linewidth=0.5))
    axes.set(xlim=(-_HALF_WIDTH, _HALF_WIDTH), ylim=(_HALF_WIDTH, -_HALF_WIDTH))
    x, y, _ = direction
    if abs(x) + abs(y) > 0:
        style = {"arrowstyle": "-|>", "color": _ARROW, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (0.55 * x, 0.55 * y), (1.58 * x, 1.58 * y), arrowprops=style)
    else:
        _draw_away(axes, 0.13, _ARROW)


def _draw_frame(axes: Axes) -> None:
    axes.set(xlim=(-0.5, 1.35), ylim=(1.35, -0.5))
    style = {"arrowstyle": "-|>", "color": "0.15", "linewidth": 1.2, "shrinkA": 5, "shrinkB": 0}
    for name, end in (("x", (0.8, 0.0)), ("y", (0.0, 0.8))):
        axes.annotate("", end, (0, 0), arrowprops=style)
        axes.text(1.22 * end[0], 1.22 * end[1], name, ha="center", va="center", fontsize=_FONT, style="italic")
    _draw_away(axes, 0.1, "0.15")
    axes.text(-0.24, -0.24, "z", ha="center", va="center", fontsize=_FONT, style="italic")


def _draw_away(axes: Axes, radius: float, colour: str) -> None:
    """Draw the symbol of a vector that points away from the viewer: a crossed circle."""
    axes.add_patch(Circle((0, 0), radius, facecolor="white", edgecolor=colour, linewidth=1.2, zorder=3))
    offset = radius / 2**0.5
    for sign in (1, -1):
        axes.plot((-offset, offset), (-sign * offset, sign * offset), color=colour, linewidth=1.2, zorder=4)
