"""The page of ``dsr view``: results of ``dsr upsample`` as surfaces to turn and to light, in one HTML file.

A surface is inverse depth in 24 bits, connectivity of pixels, and expected errors. Inverse depth is linear in the pixel
on every plane, so the upper left, upper and left neighbours predict a pixel of a plane exactly. Only the deviation from
this prediction is stored, compressed in zlib's format (RFC 1950), which browsers can read. 24 bits are the precision of
the 32-bit floats that graphics cards compute with. 16 bits would not be enough: for a range of 0.3 to 10 m they mean
steps of 5 mm at the far end, which are visible as terraces.
"""

import base64
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.lights import VIEWING_LIGHT
from dsr.geometry.mesh import LARGEST_STEP, find_connections
from dsr.geometry.surface import VIEWING_TONES, render_for_viewing
from dsr.io.exports import normal_strips
from dsr.io.photos import data_url, to_jpeg
from dsr.pictures.canvas import HOLE_COLOUR
from dsr.pictures.depth_views import reduced
from dsr.report.html_page import asset, fill, json_text, palette, policy
from dsr.utils.files import write_text
from dsr.utils.guards import opened
from dsr.utils.progress import show_length

MARK = '<meta name="generator" content="dsr view">'  # what a page begins with that a new one may replace
_SCRIPTS = ("core.js", "decode.js", "mesh.js", "webgl.js", "pose.js", "view.js")
_COLOURS = "magma"
ANGLES = (1.0, 60.0)  # ends of the colours of the normals' expected errors in degrees, those of ``confidence.png``
# Ends of the colours of the depths' expected errors as fractions of the median depth, those of ``confidence.png``
DEPTHS = (1e-3, 1e-1)
# Longer sides of the pictures for browsers without WebGL and of those to choose from, pixels
_STATIC, _THUMB = 640, 160
_QUALITY = 85
# Which pixels of an (h, w) map are joined: with their right neighbours, (h, w - 1), and those below, (h - 1, w)
Joints = tuple[np.ndarray, np.ndarray]

LEVELS = 2**24 - 1  # highest level of inverse depth; 1 is the lowest, 0 is a hole
ERROR_LEVELS = 255  # highest level of an error; 1 is the lowest, 0 is unknown
# Flags of a pixel: joined to its right neighbour and to the one below, without and with doubtful pixels; doubtful; not
# measured
RIGHT, BELOW, RIGHT_WITH_DOUBTFUL, BELOW_WITH_DOUBTFUL, DOUBTFUL, FILLED = 1, 2, 4, 8, 16, 32
_STRIP = 1 << 20  # pixels whose joints are looked for at a time


@dataclass(frozen=True)
class Grid:
    """A surface as a map, perhaps with fewer pixels than the one that it shows."""

    depth: np.ndarray  # (h, w) orthogonal depth in metres, NaN in holes
    camera: Camera  # of these pixels
    factor: int  # pixels of the whole map side by side in one of these
    joints: Joints  # of these pixels
    doubtful: np.ndarray  # (h, w) bool, pixels that the mesh leaves out
    certain: Joints  # joints without doubtful pixels
    errors: Mapping[str, np.ndarray]  # levels of the expected errors by name, (h, w) uint8 each
    filled: np.ndarray | None = None  # (h, w) bool, pixels whose depth was not measured; None where that is not known


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
    maps, grids = {"after": result.depth}, {"after": _after(result, vertices, limits)}
    if result.depth_lr is not None:
        maps["before"] = result.depth_lr
        grids["before"] = _reduce(result.depth_lr, result.camera, vertices)
    facts = dict(result.facts or {})
    if result.depth_error is not None and result.angle_error is not None:
        depth, angle = (np.nanpercentile(each, (50, 90)) for each in (result.depth_error, result.angle_error))
        facts["expected error of the depth"] = f"{show_length(depth[0], 2)}, 90 % below {show_length(depth[1], 2)}"
        facts["expected error of the normals"] = f"{angle[0]:.1f} degrees, 90 % below {angle[1]:.1f}"
    about: dict[str, Any] = {"name": result.name, "facts": facts, "notes": list(result.notes)}
    data = {}
    for name, grid in grids.items():
        about[name], data[name] = pack_grid(grid)
        about[name]["size"] = list(maps[name].shape[::-1])
        about[name]["holes"] = float(np.mean(~np.isfinite(grid.depth)))
    about["doubtful"] = float(grids["after"].doubtful.mean())
    filled = grids["after"].filled
    about["filled"] = 0.0 if filled is None else float(filled.mean())
    if result.depth_error is not None:
        about["errors"] = {name: {"low": low, "high": high} for name, (low, high) in limits.items()}
    height, width = result.depth.shape
    centre = result.depth[height // 4 : height - height // 4, width // 4 : width - width // 4]
    known, camera = centre[np.isfinite(centre)], result.camera
    z = float(np.median(known)) if known.size else middle
    x, y = (width - 1) / 2, (height - 1) / 2  # the page turns the surface about the middle of the view
    about["pivot"] = [(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z]
    if result.photo is not None:
        data["photo"] = base64.b64encode(to_jpeg(result.photo, photo_side, _QUALITY)).decode()
    pixels = {name: _rendering(grid) for name, grid in grids.items()}
    pictures = {name: to_jpeg(picture, _STATIC, _QUALITY) for name, picture in pixels.items()}
    pictures["thumb"] = to_jpeg(pixels["after"] if result.photo is None else result.photo, _THUMB, _QUALITY)
    return Packed(about, data, pictures, max(grid.depth.size for grid in grids.values()))


def save_view(path: Path, results: Sequence[Packed], *, title: str, notes: Sequence[str] = ()) -> None:
    """Write the page of some results, at least one, atomically; all names are escaped, or shown as text."""
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
        errors[name] = _error_levels(values, known, grid.factor, *limits[name])
    doubtful = reduce_mask(left_out, grid.factor) & known
    return replace(grid, doubtful=doubtful, certain=certain, errors=errors)


def _reduce(depth: np.ndarray, camera: Camera, vertices: int) -> Grid:
    """Return the surface of a map, (h, w), of the view of a camera, without errors."""
    height, width = depth.shape
    factor = 1  # the smallest with at most so many pixels
    while factor < min(height, width) // 2 and (height // factor) * (width // factor) > vertices:
        factor += 1
    fitted = reduce_depth(depth, factor)
    own = camera if (camera.height, camera.width) == (height, width) else camera.rescale(width, height)
    joints = find_joints(depth, factor)
    return Grid(fitted, own.downscale(factor), factor, joints, np.zeros(fitted.shape, bool), joints, {})


def _rendering(grid: Grid) -> np.ndarray:
    """Render a surface for viewing, (h, w, 3) uint8, holes in the hole colour."""
    depth = torch.from_numpy(grid.depth)[None]
    shades = torch.empty(depth.shape)
    for rows, normals in normal_strips(depth, grid.camera):
        shades[:, rows] = render_for_viewing(normals[None])[0]
    values = reduced(shades, _STATIC)[0]
    hole = torch.tensor(list(bytes.fromhex(HOLE_COLOUR[1:])), dtype=torch.uint8)
    grey = (255 * values).nan_to_num(0).round().byte()[..., None].expand(-1, -1, 3)
    return torch.where(values.isfinite()[..., None], grey, hole).numpy()


def reduce_depth(depth: np.ndarray, factor: int) -> np.ndarray:
    """Reduce a map, (H, W) in metres, by a whole factor without mixing surfaces; rows and columns that remain are cut.

    The inverse depth of a block is the mean of those pixels that lie within :data:`dsr.geometry.mesh.LARGEST_STEP` of
    the block's median. A block of which less than half is known is a hole.
    """
    if factor == 1:
        return depth.astype(np.float64)
    with np.errstate(divide="ignore"):
        blocks = _blocks(1 / depth.astype(np.float64), factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=-1)
    ordered = np.sort(blocks, axis=-1)  # NaN comes last
    at = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, at[..., None], axis=-1)
    near = known & (np.abs(blocks - median) <= LARGEST_STEP * np.abs(median))
    total = np.where(near, blocks, 0).sum(axis=-1)
    hole = 2 * count < factor * factor
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(hole, np.nan, near.sum(axis=-1) / total)


def _error_levels(errors: np.ndarray, there: np.ndarray, factor: int, low: float, high: float) -> np.ndarray:
    """Reduce errors, (H, W), by the mean of the known ones in each block, and return them on a logarithmic scale.

    They are uint8: 1 is ``low`` or less, 255 ``high`` or more, 0 unknown or where no pixel is ``there``.
    """
    means = errors.astype(np.float64)
    if factor > 1:
        blocks = _blocks(means, factor)
        known = np.isfinite(blocks)
        with np.errstate(invalid="ignore"):
            means = np.where(known, blocks, 0).sum(axis=-1) / known.sum(axis=-1)
    known = there & np.isfinite(means)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(np.maximum(means, low) / low) / np.log(high / low)
    levels = 1 + np.rint((ERROR_LEVELS - 1) * np.clip(np.where(known, share, 0), 0, 1))
    return np.where(known, levels, 0).astype(np.uint8)


def reduce_mask(mask: np.ndarray, factor: int) -> np.ndarray:
    """Reduce a mask, (H, W) bool: true where at least half of a block is."""
    return mask if factor == 1 else 2 * _blocks(mask, factor).sum(axis=-1) >= factor * factor


def find_joints(depth: np.ndarray, factor: int) -> Joints:
    """Return which blocks of a map, (H, W) in metres, a mesh of the whole map joins.

    Two neighbouring blocks are joined if at least half of the rows (or columns) have no cut between the middles of the
    two. Cuts found in the reduced map would be too many: the larger the pixels, the more a surface bends between them.
    """
    joints = []
    for lines in (depth, depth.T):
        height, width = lines.shape[0] // factor, lines.shape[1] // factor
        joined = np.empty((height, width - 1), bool)
        rows = max(1, _STRIP // (lines.shape[1] * factor))
        for start in range(0, height, rows):
            stop = min(start + rows, height)
            across = find_connections(1 / lines[start * factor : stop * factor].astype(np.float64))
            broken = np.pad(np.cumsum(~across, axis=1), ((0, 0), (1, 0)))  # number of cuts left of each pixel
            middles = factor // 2 + factor * np.arange(width)
            whole = broken[:, middles[1:]] == broken[:, middles[:-1]]
            joined[start:stop] = 2 * whole.reshape(stop - start, factor, width - 1).sum(axis=1) >= factor
        joints.append(joined)
    return joints[0], joints[1].T


def pack_grid(grid: Grid) -> tuple[dict[str, Any], str]:
    """Return the header of a surface for the page, and its data as base64.

    The data are bytes compressed by zlib, in planes of h x w bytes: the high, middle and low byte of the deviation of
    inverse depth from its prediction modulo 2**24, the flags, and the levels of each error in order.
    """
    camera, valid = grid.camera, np.isfinite(grid.depth)
    inverse = 1 / grid.depth
    low, high = (float(inverse[valid].min()), float(inverse[valid].max())) if valid.any() else (1.0, 1.0)
    span = max(high - low, 1e-6 * high)
    steps = np.where(valid, np.nan_to_num((inverse - low) / span), 0)
    levels = np.where(valid, 1 + np.rint(steps * (LEVELS - 1)), 0).astype(np.int64)
    padded = np.pad(levels, ((1, 0), (1, 0)))  # beyond the border, neighbours are 0
    rest = (levels - padded[1:, :-1] - padded[:-1, 1:] + padded[:-1, :-1]) & LEVELS
    planes = [(rest >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]
    planes += [_flags(grid), *grid.errors.values()]
    data = zlib.compress(b"".join(plane.tobytes() for plane in planes), 9)
    about = {
        "width": camera.width,
        "height": camera.height,
        "lens": [camera.fx, camera.fy, camera.cx, camera.cy],
        "range": [low, low + span],
        "levels": LEVELS,
        "errors": list(grid.errors),
        "factor": grid.factor,
    }
    return about, base64.b64encode(data).decode()


def _blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """Return the blocks of a map, (H, W), as (H // factor, W // factor, factor**2)."""
    height, width = values.shape[0] // factor, values.shape[1] // factor
    cut = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
    return cut.transpose(0, 2, 1, 3).reshape(height, width, factor * factor)


def _flags(grid: Grid) -> np.ndarray:
    flags = np.where(grid.doubtful, DOUBTFUL, 0).astype(np.uint8)
    if grid.filled is not None:
        flags |= np.where(grid.filled, FILLED, 0).astype(np.uint8)
    valid = np.isfinite(grid.depth)
    for (across, down), there, right, below in (
        (grid.certain, valid & ~grid.doubtful, RIGHT, BELOW),
        (grid.joints, valid, RIGHT_WITH_DOUBTFUL, BELOW_WITH_DOUBTFUL),
    ):
        flags[:, :-1] |= np.where(across & there[:, 1:] & there[:, :-1], right, 0).astype(np.uint8)
        flags[:-1] |= np.where(down & there[1:] & there[:-1], below, 0).astype(np.uint8)
    return flags
