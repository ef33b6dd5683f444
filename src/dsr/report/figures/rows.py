"""Rows of the grids: the pictures of one scene in each kind of figure."""

from __future__ import annotations

import math
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Colormap, ListedColormap
from torch import Tensor

from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.report.figures.layout import Cell, Row
from dsr.report.figures.scenes import Shown, details_of, rendering
from dsr.viz.panels import limits_of

_CENTIMETRE_LIMIT = 0.02
"""Limit of a row, metres, from which errors are shown in centimetres."""
_LEAST_ERROR = 1e-5


def rendering_row(shown: Shown, light: str) -> Row:
    """Build the row of a scene's renderings."""
    scene = shown.scene
    results = {
        label: None if depth is None else rendering(depth, scene.camera, light) for label, depth in shown.depths.items()
    }
    truth = None if scene.depth is None else rendering(scene.depth, scene.camera, light)
    size = (scene.camera.height, scene.camera.width)
    scores = _captions(shown, "DSSIM_v", "RMSE_v")
    cells = [
        _photo(shown),
        Cell(_enlarge(rendering(scene.depth_lr, scene.camera_lr, light), size)),
        *(_panel(picture, scores[label]) for label, picture in results.items()),
        _panel(truth, missing="no truth"),
    ]
    details = details_of(
        [picture for picture in results.values() if picture is not None], truth, math.ceil(scene.scale)
    )
    return Row(_label(shown), size[0] / size[1], cells, details, size)


def depth_row(shown: Shown) -> Row:
    """Build the row of a scene's depth maps."""
    scene = shown.scene
    style = _Style("viridis", limits_of(scene.depth_lr if scene.depth is None else scene.depth))
    size = (scene.camera.height, scene.camera.width)
    scores = _captions(shown, "RMSE_d")
    cells = [
        _photo(shown),
        _panel(_enlarge(scene.depth_lr[0].numpy(), size), style=style),
        *(_panel(_pixels(depth), scores[label], style=style) for label, depth in shown.depths.items()),
        _panel(_pixels(scene.depth), missing="no truth", style=style),
    ]
    return Row(_label(shown), size[0] / size[1], cells, bar="depth, m", extend="both")


def error_row(shown: Shown) -> Row | None:
    """Build the row of a scene's errors, None without ground truth or without results."""
    truth = shown.scene.depth
    if truth is None or not shown.existing():
        return None
    errors = {name: None if depth is None else depth.double() - truth for name, depth in shown.depths.items()}
    valid = [error[error.isfinite()].abs().numpy() for error in errors.values() if error is not None]
    pooled = np.concatenate(valid)
    limit = max(float(np.percentile(pooled, 98)) if pooled.size else 0.0, _LEAST_ERROR)
    factor, unit = (100, "cm") if limit >= _CENTIMETRE_LIMIT else (1000, "mm")
    style, scores = _Style(_diverging(), (-factor * limit, factor * limit)), _captions(shown, "RMSE_d")
    cells = [_photo(shown)]
    for label, error in errors.items():
        cells.append(_panel(None if error is None else factor * error[0].numpy(), scores[label], style=style))
    aspect = shown.scene.camera.height / shown.scene.camera.width
    return Row(_label(shown), aspect, cells, bar=f"result - truth, {unit}", extend="both")


def _photo(shown: Shown) -> Cell:
    return Cell(shown.scene.rgb.permute(1, 2, 0).clamp(0, 1).numpy())


class _Style(NamedTuple):
    """Colours of a panel."""

    colour_map: str | Colormap
    limits: tuple[float, float]


_GREY = _Style("gray", (0, 1))


def _panel(
    picture: np.ndarray | None,
    caption: tuple[str, bool] = ("", False),
    *,
    missing: str = "no result",
    style: _Style = _GREY,
) -> Cell:
    """Build a panel of (H, W) values, or a panel with the text ``missing``."""
    return Cell(None, missing) if picture is None else Cell(picture, *caption, *style)


def _pixels(values: Tensor | None) -> np.ndarray | None:
    """Return (1, H, W) as an array, (H, W)."""
    return None if values is None else values[0].numpy()


def _enlarge(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Repeat pixels up to a height and width, so that viewers do not smooth a low-resolution picture."""
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int) for old, new in zip(picture.shape, size, strict=True)
    )
    return picture[rows[:, None], columns]


def _diverging() -> Colormap:
    """Return a colour map from blue over white to red, without its nearly black ends."""
    return ListedColormap(mpl.colormaps["RdBu_r"](np.linspace(0.1, 0.9, 255)), "errors")


def _label(shown: Shown) -> str:
    """Return the name of a scene with spaces, at which it can be wrapped."""
    return shown.name.replace("_", " ")


def _captions(shown: Shown, *metrics: str) -> dict[str, tuple[str, bool]]:
    """Format the scores of each method in the paper's units, and determine whether the first is the best."""
    first = {label: scores[metrics[0]] for label, scores in shown.scores.items() if metrics[0] in scores}
    valid = [value for value in first.values() if np.isfinite(value)]
    best = min(valid) if len(valid) > 1 else None
    return {label: (_score_text(scores, metrics), first.get(label) == best) for label, scores in shown.scores.items()}


def _score_text(scores: dict[str, float], metrics: tuple[str, ...]) -> str:
    """Format scores with a dash for each missing one; empty if all are missing."""
    texts = []
    for name in metrics:
        shown = KNOWN_FORMATS[name]
        value = scores.get(name, np.nan)
        texts.append(shown.text(shown.factor * value) if np.isfinite(value) else "-")
    return "" if all(text == "-" for text in texts) else " / ".join(texts)
