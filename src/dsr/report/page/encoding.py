"""Pictures of a report's page: maps as 8-bit pictures, and how much they may be compressed and reduced.

The page computes renderings, colours and readouts itself, so it gets values and no renderings:

- The normals as the unclipped shadings under e1, e2, e3, which are orthonormal: any light follows from them, e4 being
  (e1 + e2 + e3) / sqrt(3). A value s in [-1, 1] is stored as 255 (s + 1) / 2; the three stand side by side.
- The depth between two limits, linearly.
- The error E(q) = sign(q - 128) (q - 128)^2 / 127^2 times the largest: fine steps where it is small.
- What is known as a mask of its own, for compression with losses leaves no value untouched.
"""

from __future__ import annotations

import base64
import hashlib
import math
from dataclasses import dataclass, field

import cv2
import numpy as np

NOTHING_KNOWN, DEPTH_KNOWN, ALL_KNOWN = 0, 128, 255
"""The values of a mask: a hole; depth without a normal; depth and normal."""
_LOSSLESS = 101
"""OpenCV's WebP quality that stands for compression without loss."""


@dataclass(frozen=True)
class Level:
    """How pictures are stored.

    Args:
        quality: of WebP, 1..100; None without loss.
        longest: pixels of the longer side; larger pictures are reduced.

    """

    quality: int | None
    longest: int

    def text(self, reduced: bool) -> str:
        """Return what a reader must know of the pictures."""
        parts = [
            "lossless, 8 bits" if self.quality is None else f"compressed with losses (WebP, quality {self.quality})"
        ]
        if reduced:
            parts.append(f"reduced to {self.longest} pixels at most")
        return ", ".join(parts)


LEVELS = (
    Level(None, 4096),
    Level(92, 4096),
    Level(88, 640),
    Level(85, 480),
    Level(80, 360),
    Level(80, 256),
    Level(75, 192),
)
"""From the best down; the last is taken whatever it comes to."""


@dataclass
class Pool:
    """Pictures by name, each stored once.

    Args:
        level: how they are stored.

    """

    level: Level
    pictures: dict[str, str] = field(default_factory=dict)
    size: int = 0
    reduced: bool = False

    def add(self, picture: np.ndarray, *, exact: bool = False) -> str:
        """Encode a picture, (H, W) or (H, W, 3) RGB in 8 bits, and return its name; ``exact``: always without loss."""
        quality = _LOSSLESS if exact or self.level.quality is None else self.level.quality
        ordered = picture if picture.ndim == 2 else picture[..., ::-1]
        _, content = cv2.imencode(".webp", np.ascontiguousarray(ordered), [cv2.IMWRITE_WEBP_QUALITY, quality])
        name = "p" + hashlib.sha256(content.tobytes()).hexdigest()[:16]
        if name not in self.pictures:
            self.pictures[name] = base64.b64encode(content.tobytes()).decode("ascii")
            self.size += len(self.pictures[name])
        return name

    def fitted(self, values: np.ndarray, known: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W) or (H, W, C) values at the size of the level, averaged over what is known, and what is."""
        known = np.isfinite(values).reshape(*values.shape[:2], -1).all(axis=-1) if known is None else known
        height, width = values.shape[:2]
        share = min(1.0, self.level.longest / max(height, width))
        if share == 1:
            return np.nan_to_num(values), known
        self.reduced = True
        size = (max(1, round(width * share)), max(1, round(height * share)))
        weight = cv2.resize(known.astype(np.float64), size, interpolation=cv2.INTER_AREA)
        expanded = known if values.ndim == 2 else known[..., None]
        total = cv2.resize(np.where(expanded, values, 0).astype(np.float64), size, interpolation=cv2.INTER_AREA)
        divisor = np.maximum(weight, 0.5) if values.ndim == 2 else np.maximum(weight, 0.5)[..., None]
        return total / divisor, weight >= 0.5


def shading_picture(shadings: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) shadings in [-1, 1] as an (H, 3 W) picture: e1, e2, e3 side by side."""
    levels = np.rint((np.clip(shadings, -1, 1) + 1) * 127.5).astype(np.uint8)
    return np.concatenate(list(np.moveaxis(levels, -1, 0)), axis=1)


def depth_picture(depth: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return (H, W) depth in metres as a picture: 0 at ``low`` and below, 255 at ``high`` and above."""
    return np.rint(255 * np.clip((depth - low) / (high - low), 0, 1)).astype(np.uint8)


def error_picture(error: np.ndarray, largest: float) -> np.ndarray:
    """Return (H, W) signed errors as a picture: 128 is none, 1 and 255 are ``largest`` and beyond."""
    share = np.clip(error / largest, -1, 1)
    return (128 + np.rint(127 * np.sign(share) * np.sqrt(np.abs(share)))).astype(np.uint8)


def mask_picture(depth_known: np.ndarray, normal_known: np.ndarray) -> np.ndarray | None:
    """Return what is known as a picture, None where everything is."""
    if depth_known.all() and normal_known.all():
        return None
    picture = np.where(normal_known & depth_known, ALL_KNOWN, DEPTH_KNOWN)
    return np.where(depth_known, picture, NOTHING_KNOWN).astype(np.uint8)


def megabytes(size: float) -> str:
    """Return a size in bytes for a reader."""
    return f"{size / 1e6:.1f} MB" if size < 1e7 else f"{math.ceil(size / 1e6)} MB"
