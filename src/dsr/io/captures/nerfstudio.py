"""Scenes of nerfstudio and instant-ngp: https://docs.nerf.studio/quickstart/data_conventions.html.

``transforms.json`` has intrinsics and lens coefficients of all frames or each, with the first pixel's corner at (0, 0),
and poses of OpenGL's camera.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dsr.geometry.camera import Lens
from dsr.io.frames import CaptureFrame, Geometry
from dsr.io.pairs import Pair, PairingResult
from dsr.io.trajectories import check_pose, intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import is_number, parse_json, path_within, read_text, refusing

_NAME = "transforms.json"


def add_transforms(folder: Path, found: PairingResult) -> PairingResult | None:
    """Return pairs with cameras and poses of ``transforms.json`` in a folder or, as dsr writes it, above; else None."""
    file = next((path for path in (folder / _NAME, folder.parent / _NAME) if path.is_file()), None)
    if file is None:
        return None
    pairs, count = {pair.rgb: pair for pair in found.pairs}, 0
    photos = {path.with_suffix(""): path for path in pairs}  # for names without suffixes
    try:
        entries = parse_json(read_text(file))
        unit = entries.get("depth_unit_scale_factor")
        for view in entries["frames"]:
            photo = path_within(file.parent, view["file_path"], file)
            photo = photos.get(photo, photo)
            depth = path_within(file.parent, view["depth_file_path"], file) if view.get("depth_file_path") else None
            depth = depth if depth and depth.is_file() else None
            pair = pairs.get(photo) or (Pair(photo.stem, photo, depth) if depth and file.parent == folder else None)
            if pair is None:
                continue
            stated = {**entries, **view, "frames": ()}
            geometry = functools.partial(_geometry, f"{file}: {view['file_path']}", stated)
            frame = CaptureFrame("nerfstudio", geometry, file, repr(stated).encode())
            own = unit if is_number(unit) and unit > 0 else pair.unit
            pairs[photo], count = replace(pair, depth=depth or pair.depth, unit=own, capture=frame), count + 1
    except (ValueError, TypeError, KeyError, AttributeError):  # of another program
        return None
    if not count:
        return None
    text = f"cameras and poses: {_NAME}; its unit is assumed to be the metre"
    note = Assumption(text, f"{count} of {len(pairs)} photos")
    return replace(found, pairs=tuple(pairs.values()), assumptions=(*found.assumptions, note))


def _geometry(place: str, view: dict[str, Any], size: tuple[int, int]) -> Geometry:
    """Return camera, lens and pose of a frame, of which the entries may be anything."""
    expected = f"{place}: expected numbers of a camera and a pose of 4 x 4"
    with refusing(expected, ValueError, TypeError, KeyError, ArithmeticError):
        width, height = int(view.get("w", size[1])), int(view.get("h", size[0]))
        fx = view["fl_x"] if "fl_x" in view else width / 2 / math.tan(view.get("camera_angle_x", 0) / 2 or math.nan)
        centre = view.get("cx", width / 2) - 0.5, view.get("cy", height / 2) - 0.5
        intrinsics = (fx, view.get("fl_y", fx), *centre)
        camera = None if math.isnan(fx) else intrinsics_camera(place, (height, width), intrinsics)
        fisheye = "FISHEYE" in str(view.get("camera_model")) or bool(view.get("is_fisheye"))
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
        lens = Lens("kannala_brandt" if fisheye else "brown_conrady", tuple(float(view.get(name, 0)) for name in names))
        matrix = np.array(view["transform_matrix"], np.float64) if "transform_matrix" in view else None
        if matrix is not None and matrix.shape != (4, 4):
            raise TypeError
    return Geometry(camera, None if matrix is None else check_pose(place, matrix, opengl=True), lens=lens)
