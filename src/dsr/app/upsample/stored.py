"""Results of ``dsr upsample`` as they lie in folders, for looking at."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dsr.app.upsample.limits import LARGEST_ERROR
from dsr.app.upsample.outputs import ERRORS, INFO, METRES
from dsr.evaluation.store import load_errors
from dsr.geometry.camera import Camera
from dsr.io.input_files import INPUT, read_input
from dsr.utils.files import array_headers
from dsr.viewer.surfaces import ViewedResult

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
    return sorted(found, key=lambda path: [_natural(part) for part in path.parts])


def read_result(folder: Path, name: str) -> ViewedResult:
    """Read a result.

    Args:
        folder: that of the result.
        name: its name on the page.

    Raises:
        ValueError: the folder holds no complete result, or a file is damaged.

    """
    info = _read_info(folder / INFO)
    camera = _camera(folder / INFO, info)
    depth = _read_depth(folder, camera)
    said = info.get("assumptions")
    notes = [str(text) for text in said] if isinstance(said, list) else []
    errors: tuple[np.ndarray, np.ndarray] | None = None
    if (folder / ERRORS).is_file():
        errors = _read_errors(folder / ERRORS, camera)
    photo = depth_lr = None
    try:
        photo, depth_lr = read_input(folder / INPUT)
    except FileNotFoundError:
        notes.append(f"without {INPUT} there is neither the photo nor the input; the same `dsr upsample` again adds it")
    return ViewedResult(
        name=name,
        depth=depth,
        camera=camera,
        photo=photo,
        depth_lr=depth_lr,
        depth_error=None if errors is None else errors[0],
        angle_error=None if errors is None else errors[1],
        max_error=_max_error(info.get("settings")),
        facts=_facts(info, depth),
        notes=notes,
    )


def _natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts the numbers in names by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)]


def _read_info(path: Path) -> Mapping[str, Any]:
    """Read ``info.json`` of a complete result."""
    try:
        if path.stat().st_size > _LARGEST_INFO:
            raise ValueError("too large")
        info = json.loads(path.read_text(encoding="utf-8"))
        complete, _ = info["complete"], info["files"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else") from error
    if complete is not True:
        raise ValueError(f"{path}: expected a complete result, got that of an interrupted run; run it again")
    return info


def _camera(path: Path, info: Mapping[str, Any]) -> Camera:
    """Return the camera of the photo."""
    try:
        return Camera(**info["camera"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: expected the photo's camera under `camera`, got {info.get('camera')!r}") from error


def _max_error(settings: Any) -> float:
    """Return the expected error from which pixels are left out, as a fraction of the depth."""
    limit = settings.get("max_error") if isinstance(settings, dict) else None
    return float(limit) if isinstance(limit, int | float) and 0 < limit < 1e9 else LARGEST_ERROR


def _read_depth(folder: Path, camera: Camera) -> np.ndarray:
    """Return the depth, (H, W) float32 in metres, NaN in holes."""
    for name in (METRES, "depth.npy"):
        path = folder / name
        if not path.is_file():
            continue
        try:
            stored = np.load(path, mmap_mode="r", allow_pickle=False)  # checks the size before anything is read
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"{path}: expected a map of depths, got a damaged or foreign file") from error
        size = (camera.height, camera.width)
        if not isinstance(stored, np.ndarray) or stored.shape != size or stored.dtype != np.float32:
            text = f"{stored.dtype} of shape {stored.shape}" if isinstance(stored, np.ndarray) else "an archive"
            raise ValueError(f"{path}: expected float32 of shape {size}, the photo's, got {text}")
        if min(size) < 2:
            raise ValueError(f"{path}: expected a map of at least 2 x 2 pixels, got {size}")
        depth = np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(math.nan))
        if not np.isfinite(depth).any():
            raise ValueError(f"{path}: expected depths, all pixels are holes")
        return depth
    raise ValueError(f"{folder}: expected a result with depth, got one without {METRES}; run it with --only depth")


def _read_errors(path: Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected errors, (H, W) each, in metres and degrees."""
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
    if isinstance(noise, dict) and isinstance(noise.get("deviation"), int | float):
        facts["noise of the input"] = f"about {1e3 * noise['deviation']:.2g} mm"
    return facts


def _size(size: Any) -> str:
    """Return a size as text."""
    return f"{size[0]} x {size[1]}" if isinstance(size, list) and len(size) == 2 else "unknown"
