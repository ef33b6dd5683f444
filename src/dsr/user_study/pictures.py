"""Renderings as the study shows them: all of one scene encoded alike, without loss, and without a word in the file."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.shading import LIGHT_NAMES, render
from dsr.viz.panels import normals_seen_by

_SIGNATURE_AND_HEADER = 8 + 25
"""Bytes of a PNG before its second chunk."""


def shading_of(depth: Tensor, camera: Camera, light: str) -> Tensor:
    """Return the rendering of a depth map, (1, H, W) in metres, under one light: (H, W) in [0, 1], NaN where unknown.

    Raises:
        ValueError: there is no such light.

    """
    if light not in LIGHT_NAMES:
        raise ValueError(f"light: expected one of {', '.join(LIGHT_NAMES)}, got {light!r}")
    return render(normals_seen_by(camera, depth))[0, LIGHT_NAMES.index(light)]


def grey_png(shades: Tensor, known: Tensor) -> bytes:
    """Return a PNG of 8 bits: black is level 1, white is 255, and what is unknown is level 0 and transparent.

    Args:
        shades: (H, W) in [0, 1], NaN where unknown.
        known: (H, W) bool, what to show of it.

    """
    levels = torch.where(known & shades.isfinite(), 1 + (254 * shades).round(), torch.zeros_like(shades))
    encoded, data = cv2.imencode(".png", levels.numpy().astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not encoded:
        raise ValueError(f"expected a picture, got one of {tuple(shades.shape)} pixels that cannot be encoded")
    png = data.tobytes()
    return png[:_SIGNATURE_AND_HEADER] + _chunk(b"tRNS", struct.pack(">H", 0)) + png[_SIGNATURE_AND_HEADER:]


def _chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk of a PNG (W3C recommendation "Portable Network Graphics", section 5.3)."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
