"""Small pictures beside each other, for a notebook: a row of panels of one height."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from dsr.pictures.canvas import colours

_HEIGHT, _WIDTH, _GAP = 220, 320, 6
"""Pixels: the panels' largest size, and what lies between them."""
_QUALITY = 85


def encode_row(panels: Sequence[np.ndarray]) -> bytes:
    """Return panels in a row as a WebP, transparent between them.

    Args:
        panels: of one aspect and any sizes, (H, W) grey or (H, W, 3) RGB in [0, 1], NaN in holes. Pixels of small ones
            are repeated, so that they are to be seen.

    """
    height, width = panels[0].shape[:2]
    scale = min(_HEIGHT / height, _WIDTH / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    shown = [_resized(panel, size) for panel in panels]
    gap = np.zeros((size[1], _GAP, 4), np.uint8)
    row = np.concatenate([each for panel in shown for each in (gap, panel)][1:], axis=1)
    done, content = cv2.imencode(".webp", row[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    if not done:
        raise OSError(f"the picture of {row.shape} could not be encoded")
    return content.tobytes()


def _resized(panel: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return a panel as RGBA of a width and height."""
    colour = np.repeat(panel[..., None], 3, axis=2) if panel.ndim == 2 else panel
    holes = ~np.isfinite(colour).all(axis=2, keepdims=True)
    pixels: Any = np.where(holes, colours("gray").get_bad()[:3], colour).astype(np.float32)
    smaller = size[0] < pixels.shape[1]
    pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
    known = np.full((size[1], size[0], 1), 255, np.uint8)
    return np.concatenate((np.round(255 * pixels.clip(0, 1)).astype(np.uint8), known), axis=2)
