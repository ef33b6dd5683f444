"""Renderings as the study shows them: all of one scene encoded alike, without loss, and without a word in the file."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.shading import LIGHT_NAMES, render
from dsr.viz.panels import normals_seen_by


def shading_of(depth: Tensor, camera: Camera, light: str) -> Tensor:
    """Return the rendering of a depth map, (1, H, W) in metres, under one light: (H, W) in [0, 1], NaN where unknown.

    Raises:
        ValueError: there is no such light.

    """
    if light not in LIGHT_NAMES:
        raise ValueError(f"light: expected one of {', '.join(LIGHT_NAMES)}, got {light!r}")
    return render(normals_seen_by(camera, depth))[0, LIGHT_NAMES.index(light)]


def grey_png(shades: Tensor, known: Tensor) -> bytes:
    """Return a PNG of 8 bits: black is level 1, white is 255, and what is missing is level 0 and transparent.

    Args:
        shades: (H, W) in [0, 1], NaN where unknown.
        known: (H, W) bool, the pixels to show.

    """
    levels = torch.where(known & shades.isfinite(), 1 + (254 * shades).round(), torch.zeros_like(shades))
    content = io.BytesIO()
    picture = Image.fromarray(levels.numpy().astype(np.uint8))
    picture.save(content, "PNG", transparency=0, compress_level=9)
    return content.getvalue()
