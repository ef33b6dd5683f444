"""The page of ``dsr view``: results of ``dsr upsample`` as surfaces to turn and to light, in one HTML file."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.lights import VIEWING_LIGHT
from dsr.geometry.surface import VIEWING_TONES, render_for_viewing
from dsr.io.exports import normal_strips
from dsr.io.photos import data_url, to_jpeg
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.pictures.depth_views import reduced
from dsr.report.html_page import asset, fill, json_text, palette, policy
from dsr.report.surface_packing import (
    Grid,
    error_levels,
    factor_for,
    find_joints,
    pack_grid,
    reduce_depth,
    reduce_errors,
    reduce_mask,
)
from dsr.utils.files import write_text
from dsr.utils.guards import opened

MARK = '<meta name="generator" content="dsr view">'
"""What a page begins with that a new one may replace."""
_SCRIPTS = ("core.js", "decode.js", "mesh.js", "webgl.js", "pose.js", "view.js")
_COLOURS = "magma"
ANGLES = (1.0, 60.0)
"""Ends of the colours of the normals' expected errors in degrees, those of ``confidence.png``."""
DEPTHS = (1e-3, 1e-1)
"""Ends of the colours of the depths' expected errors as fractions of the median depth, those of ``confidence.png``."""
_STATIC, _THUMB = 640, 160
"""Longer sides of the pictures for browsers without WebGL and of those to choose from, pixels."""
_QUALITY = 85


@dataclass(frozen=True)
class ViewedResult:
    """A result of `dsr upsample` to look at."""

    name: str  # among those of the page
    depth: np.ndarray  # (H, W) orthogonal depth in metres, NaN in holes
    camera: Camera  # of these pixels
    photo: np.ndarray | None = None  # (h, w, 3) uint8 of the same view and any size
    depth_lr: np.ndarray | None = None  # (h, w) the input's depth in metres, NaN in holes
    depth_error: np.ndarray | None = None  # (H, W) expected error in metres, with that of the normal or not at all
    angle_error: np.ndarray | None = None  # (H, W) expected error of the normal in degrees
    filled: np.ndarray | None = None  # (H, W) bool, where depth was not measured; None where that is not known
    max_error: float = math.inf  # expected error, as a fraction of the depth, from which the mesh leaves out a pixel
    facts: Mapping[str, str] | None = None  # texts below the surface, by heading
    notes: Sequence[str] = ()  # assumptions and remarks


@dataclass(frozen=True)
class Packed:
    """A result as the page stores it."""

    about: dict[str, Any]  # what fits into JSON
    data: dict[str, str]  # base64 texts by name: after, before, photo
    pictures: dict[str, bytes]  # JPEGs by name: before, after, thumb
    vertices: int  # of the larger surface


def pack_result(result: ViewedResult, vertices: int, photo_side: int) -> Packed:
    """Pack a result; maps of more ``vertices`` are reduced by a whole factor, the photo to ``photo_side`` pixels."""
    known = result.depth[np.isfinite(result.depth)]
    middle = float(np.median(known)) if known.size else 1.0
    limits = {"depth": tuple(share * middle for share in DEPTHS), "angle": ANGLES}
    grids = {"after": _after(result, vertices, limits)}
    if result.depth_lr is not None:
        grids["before"] = _reduce(result.depth_lr, result.camera, vertices)
    about: dict[str, Any] = {"name": result.name, "facts": result.facts or {}, "notes": list(result.notes)}
    data = {}
    for name, grid in grids.items():
        about[name], data[name] = pack_grid(grid)
        holes = result.depth if name == "after" else result.depth_lr
        about[name]["size"] = [holes.shape[1], holes.shape[0]] if holes is not None else []
        about[name]["holes"] = float(np.mean(~np.isfinite(grid.depth)))
    about["doubtful"] = float(grids["after"].doubtful.mean())
    filled = grids["after"].filled
    about["filled"] = 0.0 if filled is None else float(filled.mean())
    if result.depth_error is not None:
        about["errors"] = {name: {"low": low, "high": high} for name, (low, high) in limits.items()}
    about["pivot"] = _pivot(result.depth, result.camera, middle)
    if result.photo is not None:
        data["photo"] = base64.b64encode(to_jpeg(result.photo, photo_side, _QUALITY)).decode()
    return Packed(about, data, _pictures(result, grids), max(grid.depth.size for grid in grids.values()))


def save_view(path: Path, results: Sequence[Packed], *, title: str, notes: Sequence[str] = ()) -> None:
    """Write the page of some results, at least one, atomically.

    A content security policy allows the page's own script, style and pictures alone, so that it cannot ask any server.
    All names are escaped, or shown as text by the script.
    """
    style, script = asset("view.css"), f'"use strict";\n{asset(*_SCRIPTS)}'
    content = {
        "title": title,
        "notes": list(notes),
        "light": VIEWING_LIGHT,
        "tones": VIEWING_TONES,
        "colours": palette(_COLOURS),
        "results": [{**result.about, "thumb": data_url(result.pictures["thumb"])} for result in results],
    }
    parts = {
        "MARK": MARK,
        "POLICY": policy(style, script, "data: blob:"),
        "TITLE": title,
        "STYLE": style,
        "SCRIPT": script,
        "RESULTS": results,
        "CONTENT": json_text(content),
        "DATA": {f"{name}-{k}": data for k, result in enumerate(results) for name, data in result.data.items()},
    }
    write_text(path, fill("view.html", parts))


def is_view(path: Path) -> bool:
    """Return whether a file is a page of this command."""
    with opened(path) as file:
        return MARK.encode() in file.read(1024)


def _after(result: ViewedResult, vertices: int, limits: Mapping[str, tuple[float, ...]]) -> Grid:
    """Return the surface of the result, with the errors where there are any."""
    grid = _reduce(result.depth, result.camera, vertices)
    if result.filled is not None:
        grid = replace(grid, filled=reduce_mask(result.filled, grid.factor) & np.isfinite(grid.depth))
    if result.depth_error is None or result.angle_error is None:
        return grid
    with np.errstate(invalid="ignore"):
        left_out = result.depth_error > result.max_error * result.depth
    certain = find_joints(np.where(left_out, np.nan, result.depth), grid.factor) if left_out.any() else grid.joints
    known = np.isfinite(grid.depth)
    errors = {}
    for name, values in (("depth", result.depth_error), ("angle", result.angle_error)):
        fitted = np.where(known, reduce_errors(values, grid.factor), np.nan)
        errors[name] = error_levels(fitted, *limits[name])
    doubtful = reduce_mask(left_out, grid.factor) & known
    return replace(grid, doubtful=doubtful, certain=certain, errors=errors)


def _reduce(depth: np.ndarray, camera: Camera, vertices: int) -> Grid:
    """Return the surface of a map, (h, w), of the view of a camera, without errors."""
    height, width = depth.shape
    factor = factor_for(height, width, vertices)
    fitted = reduce_depth(depth, factor)
    own = camera if (camera.height, camera.width) == (height, width) else camera.rescale(width, height)
    joints = find_joints(depth, factor)
    return Grid(fitted, own.downscale(factor), factor, joints, np.zeros(fitted.shape, bool), joints, {})


def _pivot(depth: np.ndarray, camera: Camera, middle: float) -> list[float]:
    """Return the point about which the page turns the surface: in the middle of the view, at its median depth."""
    height, width = depth.shape
    centre = depth[height // 4 : height - height // 4, width // 4 : width - width // 4]
    known = centre[np.isfinite(centre)]
    z = float(np.median(known)) if known.size else middle
    x, y = (width - 1) / 2, (height - 1) / 2
    return [(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z]


def _pictures(result: ViewedResult, grids: Mapping[str, Grid]) -> dict[str, bytes]:
    """Return the surfaces as pictures, and a small picture to choose the result by."""
    pixels = {name: _rendering(grid) for name, grid in grids.items()}
    small = {name: to_jpeg(picture, _STATIC, _QUALITY) for name, picture in pixels.items()}
    return {**small, "thumb": to_jpeg(pixels["after"] if result.photo is None else result.photo, _THUMB, _QUALITY)}


def _rendering(grid: Grid) -> np.ndarray:
    """Render a surface for viewing, (h, w, 3) uint8, holes in the hole colour."""
    depth = torch.from_numpy(grid.depth)[None]
    shades = torch.empty(depth.shape)
    for rows, normals in normal_strips(depth, grid.camera):
        shades[:, rows] = render_for_viewing(normals[None])[0]
    values = reduced(shades, _STATIC)[0]
    hole = torch.tensor([int(HOLE_COLOUR[at : at + 2], 16) for at in (1, 3, 5)], dtype=torch.uint8)
    grey = (255 * values).nan_to_num(0).round().byte()[..., None].expand(-1, -1, 3)
    return torch.where(values.isfinite()[..., None], grey, hole).numpy()
