"""Readers of the result folders of ``dsr upsample``, for ``dsr view``, ``dsr fuse`` and exports."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dsr.app.upsample.outputs import INFO
from dsr.app.upsample.parts import ERRORS, METRES, Results
from dsr.evaluation.results import load_errors
from dsr.geometry.camera import Camera
from dsr.inference import find_filled
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import INPUT, read_input
from dsr.io.frames import UPS
from dsr.sample import expect_distances
from dsr.utils.arrays import array_headers
from dsr.utils.guards import TooLargeError, is_number, natural_key, parse_json, pixels_beside, read_limited
from dsr.utils.progress import show_length

if TYPE_CHECKING:
    from dsr.report.surface_page import ViewedResult

_DEEPEST = 6
"""Folders below the given one in which results are looked for."""
_LARGEST_INFO = 16 << 20


def find_results(folder: Path) -> list[Path]:
    """Return the folders of results at and below a folder, in the order of their names, numbers by value.

    Raises:
        ValueError: there is none.

    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected the folder of a result of `dsr upsample`, there is no such folder")
    found = []
    for root, names, files in os.walk(folder):
        if INFO in files:
            found.append(Path(root))
        if INFO in files or len(Path(root).relative_to(folder).parts) >= _DEEPEST:
            names.clear()
    if not found:
        raise ValueError(f"{folder}: expected a result of `dsr upsample`, or a folder of them, got one without {INFO}")
    return sorted(found, key=natural_key)


def read_result(folder: Path, name: str) -> ViewedResult:
    """Read a result.

    Args:
        folder: that of the result.
        name: its name on the page.

    Raises:
        ValueError: the folder holds no complete result, or a file is damaged.

    """
    from dsr.report.surface_page import ViewedResult  # noqa: PLC0415 - pages need Matplotlib

    info = read_info(folder / INFO)
    camera = read_camera(folder / INFO, info)
    depth = read_depth(folder, camera)
    said = info.get("assumptions")
    notes = [str(text) for text in said] if isinstance(said, list) else []
    errors: tuple[np.ndarray, np.ndarray] | None = None
    if (folder / ERRORS).is_file():
        errors = read_errors(folder / ERRORS, camera)
    photo = depth_lr = None
    try:
        photo, depth_lr = read_input(folder / INPUT)
    except FileNotFoundError:
        notes.append(f"without {INPUT} there is neither the photo nor the input; the same `dsr upsample` again adds it")
    filled = None if depth_lr is None else find_filled(*(torch.from_numpy(each)[None] for each in (depth, depth_lr)))
    return ViewedResult(
        name=name,
        depth=depth,
        camera=camera,
        photo=photo,
        depth_lr=depth_lr,
        depth_error=None if errors is None else errors[0],
        angle_error=None if errors is None else errors[1],
        filled=None if filled is None else filled[0].numpy(),
        max_error=_max_error(info.get("settings")),
        facts=_facts(info, depth),
        notes=notes,
    )


def read_info(path: Path) -> Mapping[str, Any]:
    """Read ``info.json`` of a complete result.

    Raises:
        ValueError: it is damaged or foreign, or the run was interrupted.

    """
    try:
        info = parse_json(read_limited(path, _LARGEST_INFO), finite=False)
        complete, _ = info["complete"], info["files"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else") from error
    if complete is not True:
        raise ValueError(f"{path}: expected a complete result, got that of an interrupted run; run it again")
    return info


def read_up(info: Mapping[str, Any]) -> str:
    """Return the axis of the world that points up, one of :data:`dsr.io.frames.UPS`."""
    up = info.get("up")
    return up if isinstance(up, str) and up in UPS else ""


def read_camera(path: Path, info: Mapping[str, Any]) -> Camera:
    """Return the camera of the photo.

    Args:
        path: ``info.json``, named in an error.
        info: its entries.

    Raises:
        ValueError: they hold no camera.

    """
    try:
        return Camera(**info["camera"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        came = f"{info.get('camera')!r:.200}"
        raise ValueError(f"{path}: expected the photo's camera under `camera`, got {came}") from error


def _max_error(settings: Any) -> float:
    """Return the expected error from which pixels are left out, as a fraction of the depth."""
    limit = settings.get("max_error") if isinstance(settings, dict) else None
    return float(limit) if is_number(limit) and 0 < limit < 1e9 else Results.max_error / 100


def read_depth(folder: Path, camera: Camera) -> np.ndarray:
    """Return the depth of a result, (H, W) float32 in metres, NaN in holes.

    Raises:
        ValueError: the file is missing, damaged or foreign, or has no depth.

    """
    path, size = folder / METRES, (camera.height, camera.width)
    if not path.is_file():
        raise ValueError(f"{folder}: expected a result with depth, got one without {METRES}; run it with --only depth")
    try:
        stored = read_depth_file(path, pixels_beside(*size))
    except TooLargeError:
        raise
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: expected a map of depths, got a damaged or foreign file") from error
    if stored.shape != size or stored.dtype != np.float32:
        text = f"{stored.dtype} of shape {stored.shape}"
        raise ValueError(f"{path}: expected float32 of shape {size}, the photo's, got {text}")
    if min(size) < 2:
        raise ValueError(f"{path}: expected a map of at least 2 x 2 pixels, got {size}")
    depth = np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(math.nan))
    if not np.isfinite(depth).any():
        raise ValueError(f"{path}: expected depths, all pixels are holes")
    expect_distances(str(path), torch.from_numpy(depth))
    return depth


def read_errors(path: Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected errors of depth and normal, (H, W) float32 each, in metres and degrees.

    Raises:
        ValueError: the file is damaged or foreign.

    """
    size = (camera.height, camera.width)
    shapes = {name: shape for name, (shape, _) in array_headers(path).items()}
    if any(shapes.get(name) != size for name in ("depth_error", "angle_error")):
        raise ValueError(f"{path}: expected depth_error and angle_error of shape {size}, the photo's, got {shapes}")
    errors = load_errors(path)
    if errors is None:
        raise ValueError(f"{path}: expected depth_error and angle_error, got {shapes}")
    return errors[0][0].numpy(), errors[1][0].numpy()


def _facts(info: Mapping[str, Any], depth: np.ndarray) -> dict[str, str]:
    """Return what is written below the surface."""
    known = depth[np.isfinite(depth)]
    near, middle, far = np.percentile(known, (1, 50, 99))
    facts = {
        "method": f"{info.get('method', 'unknown')} x{info.get('scale', '?')}",
        "photo": _size(info.get("photo_size")),
        "input": _size(info.get("input_size")),
        "depth": f"{near:.2f} to {far:.2f} m, median {middle:.2f} m",
    }
    noise = info.get("noise")
    if isinstance(noise, dict) and is_number(noise.get("deviation")):
        facts["noise of the input"] = f"about {show_length(noise['deviation'], 2)}"
    return facts


def _size(size: Any) -> str:
    """Return a size as text."""
    return f"{size[0]} x {size[1]}" if isinstance(size, list) and len(size) == 2 else "unknown"
