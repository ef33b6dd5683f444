"""Recognise pictures that are no depth maps: depth in grey or colours for viewing, or a photo."""

from __future__ import annotations

import cv2
import numpy as np

_MAPS = (
    "JET", "TURBO", "VIRIDIS", "PLASMA", "INFERNO", "MAGMA", "HOT", "BONE", "RAINBOW", "HSV", "PARULA", "CIVIDIS",
    "OCEAN", "COOL", "AUTUMN", "SUMMER", "SPRING", "WINTER", "PINK", "TWILIGHT",
)  # fmt: skip
_SAMPLE, _ALIKE, _SHARE = 2000, 12, 0.9
"""Number of pixels that are compared, the largest difference of a channel of 255, and the share of pixels that have one
of a map's colours."""


def describe_picture(values: np.ndarray) -> str:
    """Describe what a picture of several channels, or of 8 bits, probably shows.

    Args:
        values: (H, W) or (H, W, C) as they are stored.

    """
    if values.ndim == 2:
        return "a picture for viewing, or disparities of an old benchmark"
    if values.ndim == 3 and values.shape[2] == 2:
        return "grey that is transparent in places"
    if values.ndim != 3 or values.shape[2] not in (3, 4) or not values.size:
        return "no map"
    pixels = values[..., :3].reshape(-1, 3)
    pixels = pixels[:: -(-len(pixels) // _SAMPLE)].astype(np.int64)
    if (pixels == pixels[:, :1]).all():
        return "three equal channels, a grey picture for viewing"
    pixels = pixels // 257 if values.dtype == np.uint16 else pixels
    pixels = pixels[pixels.any(axis=1)]  # black where there is nothing to colour
    for name in _MAPS:
        colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{name}"))
        for order in (colours[:, 0].astype(np.int64), colours[:, 0, ::-1].astype(np.int64)):
            apart = np.abs(pixels[:, None] - order).max(axis=2).min(axis=1)
            if (apart <= _ALIKE).mean() > _SHARE:
                return f"a picture coloured for viewing by the map {name.lower()}, whose values are lost"
    return "a picture in colour, a photo or a map coloured for viewing"
