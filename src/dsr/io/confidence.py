"""Confidence maps: how sure a sensor is of each pixel of its depth map, as levels 0 to 2, 0 to 255, or fractions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dsr.data.formats.files import read_pixels
from dsr.io.depth_files import DEPTH_SUFFIXES, read_array_file
from dsr.io.frames import Source
from dsr.utils.limits import pixels_beside

HIGHEST_LEVEL = 2
"""ARKit's levels are 0 (low), 1 (medium) and 2 (high)."""
SLACK = 0.002
"""Fractions count as equal within this: 127 of 255 is a half."""
_ARRAYS = (".npy", ".npz", ".pfm", ".exr")
CONFIDENCE_SUFFIXES = (*DEPTH_SUFFIXES, ".bmp")
"""Of the files of confidence maps."""


@dataclass(frozen=True)
class ConfidenceMap:
    """Where a confidence map is, and how it counts.

    Args:
        path: the file, or the name of the place in one.
        highest: value that stands for full confidence; 1 for fractions.
        source: where the map is, if it is no file of its own.

    """

    path: Path
    highest: float
    source: Source | None = None

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """Return the confidence of a depth map of (h, w), float32 from 0 to 1.

        Raises:
            ValueError: it is missing, damaged, of another size, or has values out of range.

        """
        values = read_values(self.path, pixels_beside(*size)) if self.source is None else self.source.read()
        if values.shape != size:
            raise ValueError(
                f"{self.path}: expected confidence of the depth map's {size[1]} x {size[0]} pixels (width x height), "
                f"got {values.shape[1]} x {values.shape[0]}"
            )
        if not ((values >= 0) & (values <= self.highest)).all():
            wrong = values[~((values >= 0) & (values <= self.highest))][0]
            raise ValueError(f"{self.path}: expected confidence from 0 to {self.highest:g}, got {wrong}")
        return values.astype(np.float32) / np.float32(self.highest)


def read_values(path: Path, most: int | None = None) -> np.ndarray:
    """Return a confidence map as it is stored, (h, w).

    Args:
        path: the file.
        most: largest number of pixels; None for what the size of the file explains.

    Raises:
        ValueError: it is missing, damaged, too large, or has several channels.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a confidence map, there is no such file")
    array = path.suffix.lower() in _ARRAYS
    values = read_array_file(path, most) if array else read_pixels(path, cv2.IMREAD_UNCHANGED, most)
    if values.ndim != 2 or values.dtype.kind not in "fiub" or not values.size:
        raise ValueError(f"{path}: expected one channel of numbers, got {values.dtype} of shape {values.shape}")
    return values


def find_highest(paths: Sequence[Path]) -> float:
    """Return the value that stands for full confidence in maps that belong together.

    Floats are fractions. Whole numbers are levels from 0 to 2 if no map has a larger one; else they go up to 255, or up
    to 65535 in maps of 16 bits that have more than 255. Maps that cannot be read do not count; that is said when their
    frame is read.
    """
    highest = float(HIGHEST_LEVEL)
    for path in paths:
        try:
            values = read_values(path)
        except ValueError:
            continue
        if values.dtype.kind in "fb":
            return 1.0
        if values.max() > 255:
            return 65535.0
        if values.max() > HIGHEST_LEVEL:
            highest = 255.0
        if highest == 255 and values.dtype.itemsize == 1:
            break
    return highest
