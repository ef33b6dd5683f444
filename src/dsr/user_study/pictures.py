"""Renderings of the study as lossless PNG files, all encoded with the same settings and without metadata."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.lights import LIGHT_NAMES
from dsr.geometry.shading import render
from dsr.viz.panels import normals_seen_by


def shading_of(depth: Tensor, camera: Camera, light: str) -> Tensor:
    """Render a depth map, (1, H, W) in metres, under one light: (H, W) in [0, 1], NaN where undefined.

    Raises:
        ValueError: there is no such light.

    """
    if light not in LIGHT_NAMES:
        raise ValueError(f"light: expected one of {', '.join(LIGHT_NAMES)}, got {light!r}")
    return render(normals_seen_by(camera, depth))[0, LIGHT_NAMES.index(light)]


def grey_png(shades: Tensor, valid: Tensor) -> bytes:
    """Encode an 8-bit PNG: black is level 1, white is 255, and missing pixels are level 0 and transparent.

    Args:
        shades: (H, W) in [0, 1], NaN where undefined.
        valid: (H, W) bool mask of the pixels to show.

    """
    levels = torch.where(valid & shades.isfinite(), 1 + (254 * shades).round(), torch.zeros_like(shades))
    content = io.BytesIO()
    picture = Image.fromarray(levels.numpy().astype(np.uint8))
    picture.save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()
