"""Small results of ``dsr upsample``, written without computing any."""

import json
from dataclasses import asdict

import numpy as np
import torch

from dsr.geometry.camera import Camera
from dsr.io.depth_files import write_depth_file
from dsr.io.exports import write_input

SIZE = 64
CAMERA = Camera(SIZE, SIZE, 80.0, 80.0, 31.0, 32.5)
HOLE = (slice(40, 52), slice(8, 24))


def waves(size=SIZE, hole=True):
    """Return a curved wall 2 m away, half a metre further in the right third, perhaps with a hole: (size, size)."""
    v, u = np.mgrid[:size, :size] / size
    depth = 2 + 0.12 * np.sin(7 * u) * np.cos(5 * v) + 0.1 * v
    depth[:, 2 * size // 3 :] += 0.5
    if hole:
        depth[HOLE] = np.nan
    return depth.astype(np.float32)


def write_result(folder, depth=None, *, camera=CAMERA, with_input=True, with_errors=True, max_error=0.02, **info):
    """Write a result whose input is a quarter as large and whose photo is red on the left and blue on the right.

    The expected errors of depth grow from 2 mm on the left to 60 mm on the right, those of normals from 2 to 40 degrees
    downwards.
    """
    depth = waves() if depth is None else depth
    folder.mkdir(parents=True, exist_ok=True)
    write_depth_file(folder / "depth_metres.tiff", depth)
    height, width = depth.shape
    if with_input:
        rgb = torch.zeros(3, height, width)
        rgb[0, :, : width // 2] = 0.9
        rgb[2, :, width // 2 :] = 0.9
        write_input(folder / "input.npz", rgb, torch.from_numpy(depth[::4, ::4].copy())[None])
    if with_errors:
        u, v = np.linspace(0, 1, width), np.linspace(0, 1, height)
        errors = {"depth_error": 0.002 * 30 ** (u + 0 * v[:, None]), "angle_error": 2 * 20 ** (0 * u + v[:, None])}
        np.savez(folder / "confidence.npz", **{name: each.astype(np.float32) for name, each in errors.items()})
    entries = {
        "complete": True,
        "inputs": {},
        "settings": {"max_error": max_error},
        "files": ["depth_metres.tiff"],
        "method": "facets",
        "scale": 4,
        "photo_size": [width, height],
        "input_size": [width // 4, height // 4],
        "camera": asdict(camera),
        "noise": {"deviation": 0.0021, "extent": 2.0},
        "assumptions": ["whole numbers are read as millimetres (median 2.1 m)"],
        **info,
    }
    (folder / "info.json").write_text(json.dumps(entries))
    return folder
