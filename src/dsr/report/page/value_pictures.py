"""Pictures of a report page: encoding of maps as 8-bit pictures, and levels of compression and reduction.

The page computes renderings, colours and readouts itself from stored values:

- Normals are stored as unclipped shadings under the orthonormal directions :data:`dsr.geometry.lights.BASIS`, which
  determine those under any light. A value s in [-1, 1] is stored as 255 (s + 1) / 2; the three maps are side by side.
- Depth is stored linearly between two limits.
- The error is sign(q - 128) (q - 128)^2 / 127^2 times the largest error, so that small errors have small steps.
- Expected errors, which have no sign, are q^2 / 255^2 times the largest one.
- The valid mask is a separate lossless picture, since lossy compression changes every value.
"""

from __future__ import annotations

import base64
import hashlib
import math
from dataclasses import dataclass, field

import cv2
import numpy as np

NOTHING_VALID, DEPTH_VALID, ALL_VALID = 0, 128, 255
"""Values of a mask: missing; valid depth without a normal; valid depth and normal."""
_WEBP_LOSSLESS = 101
"""OpenCV's WebP quality for lossless compression."""
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
"""A third of the time of zlib's level 6 for 8 % more bytes, a fifteenth of that of lossless WebP."""


@dataclass(frozen=True)
class Level:
    """Storage of pictures.

    Args:
        quality: WebP quality, 1..100; None for lossless.
        longest: maximum longer side, pixels; larger pictures are reduced.
        fast: whether lossless pictures are PNG, which takes a fifteenth of the time of WebP and is a third larger.

    """

    quality: int | None
    longest: int
    fast: bool = False

    def text(self, reduced: bool) -> str:
        """Describe the compression and reduction for users."""
        parts = [
            "lossless, 8 bits" if self.quality is None else f"compressed with losses (WebP, quality {self.quality})"
        ]
        if reduced:
            parts.append(f"reduced to {self.longest} pixels at most")
        return ", ".join(parts)


LEVELS = (
    Level(None, 4096, fast=True),
    Level(None, 4096),
    Level(92, 4096),
    Level(88, 640),
    Level(85, 480),
    Level(80, 360),
    Level(80, 256),
    Level(75, 192),
)
"""Levels from best to worst; the last is used regardless of the size."""


@dataclass
class PictureStore:
    """Pictures by name, each stored once.

    Args:
        level: compression and reduction of the pictures.

    """

    level: Level
    pictures: dict[str, str] = field(default_factory=dict)
    size: int = 0
    reduced: bool = False

    def add(self, picture: np.ndarray, *, exact: bool = False) -> str:
        """Encode an 8-bit picture, (H, W) or (H, W, 3) RGB, and return its name; ``exact`` forces lossless encoding."""
        quality = _WEBP_LOSSLESS if exact or self.level.quality is None else self.level.quality
        settings = _PNG if self.level.fast else (cv2.IMWRITE_WEBP_QUALITY, quality)
        ordered = np.ascontiguousarray(picture if picture.ndim == 2 else picture[..., ::-1])
        _, content = cv2.imencode(".png" if self.level.fast else ".webp", ordered, settings)
        name = "p" + hashlib.sha256(content.tobytes()).hexdigest()[:16]
        self._keep(name, base64.b64encode(content.tobytes()).decode("ascii"))
        return name

    def merge(self, other: PictureStore) -> None:
        """Add the pictures of another pool."""
        for name, content in other.pictures.items():
            self._keep(name, content)
        self.reduced |= other.reduced

    def _keep(self, name: str, content: str) -> None:
        """Add an encoded picture unless it is there."""
        if name not in self.pictures:
            self.pictures[name] = content
            self.size += len(content)

    def fit(self, values: np.ndarray, valid: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Resize (H, W) or (H, W, C) values to the level by averaging valid pixels; return them and the valid mask."""
        valid = np.isfinite(values).reshape(*values.shape[:2], -1).all(axis=-1) if valid is None else valid
        height, width = values.shape[:2]
        factor = min(1.0, self.level.longest / max(height, width))
        if factor == 1:
            return np.nan_to_num(values), valid
        self.reduced = True
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        weight = cv2.resize(valid.astype(np.float64), size, interpolation=cv2.INTER_AREA)
        expanded = valid if values.ndim == 2 else valid[..., None]
        total = cv2.resize(np.where(expanded, values, 0).astype(np.float64), size, interpolation=cv2.INTER_AREA)
        divisor = np.maximum(weight, 0.5) if values.ndim == 2 else np.maximum(weight, 0.5)[..., None]
        return total / divisor, weight >= 0.5


def shading_picture(shadings: np.ndarray) -> np.ndarray:
    """Encode (H, W, 3) shadings in [-1, 1] as an (H, 3 W) picture: the three side by side."""
    levels = np.rint((np.clip(shadings, -1, 1) + 1) * 127.5).astype(np.uint8)
    return np.concatenate(list(np.moveaxis(levels, -1, 0)), axis=1)


def depth_picture(depth: np.ndarray, low: float, high: float) -> np.ndarray:
    """Encode (H, W) depth in metres as a picture: 0 at ``low`` and below, 255 at ``high`` and above."""
    return np.rint(255 * np.clip((depth - low) / (high - low), 0, 1)).astype(np.uint8)


def error_picture(error: np.ndarray, largest: float) -> np.ndarray:
    """Encode (H, W) signed errors as a picture: 128 is zero, 1 and 255 are -``largest`` and ``largest`` or beyond."""
    relative = np.clip(error / largest, -1, 1)
    return (128 + np.rint(127 * np.sign(relative) * np.sqrt(np.abs(relative)))).astype(np.uint8)


def expected_picture(error: np.ndarray, largest: float) -> np.ndarray:
    """Encode (H, W) expected errors, 0 or more, as a picture: 255 is ``largest`` or beyond."""
    return np.rint(255 * np.sqrt(np.clip(error / largest, 0, 1))).astype(np.uint8)


def mask_picture(depth_valid: np.ndarray, normal_valid: np.ndarray) -> np.ndarray | None:
    """Encode valid masks as a picture, None if all pixels are valid."""
    if depth_valid.all() and normal_valid.all():
        return None
    picture = np.where(normal_valid & depth_valid, ALL_VALID, DEPTH_VALID)
    return np.where(depth_valid, picture, NOTHING_VALID).astype(np.uint8)


def megabytes(size: float) -> str:
    """Format a size in bytes as megabytes."""
    return f"{size / 1e6:.1f} MB" if size < 1e7 else f"{math.ceil(size / 1e6)} MB"
