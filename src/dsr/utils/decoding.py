"""Pictures decoded by OpenCV: their sizes are checked first, and the decoders say nothing of damaged ones."""

from __future__ import annotations

import io
import os
import threading
from pathlib import Path

import cv2
import numpy as np

from dsr.utils.guards import expect_bytes, expect_pixels, pixels_of_file
from dsr.utils.picture_headers import picture_size

_BYTES_PER_PIXEL = 16
"""Bytes in memory for each allowed pixel: four channels of float32."""


def decode_pixels(place: str | Path, content: bytes, flags: int, most: int | None = None) -> np.ndarray | None:
    """Return the pixels of an encoded picture as OpenCV decodes them; None if it is damaged or none.

    Args:
        place: its name, for messages.
        content: a PNG, JPEG, TIFF, BMP, WebP or portable map.
        most: largest number of pixels; None for what its length explains.

    Raises:
        ValueError: its header declares more.

    """
    header = picture_size(io.BytesIO(content))
    if header is None:
        return None
    most = pixels_of_file(len(content)) if most is None else most
    expect_pixels(place, header.height, header.width, most)
    expect_bytes(
        place, header.bytes_per_pixel * max(header.height * header.width, header.tile), _BYTES_PER_PIXEL * most
    )
    try:
        with _QUIET_STDERR:
            return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None


class _QuietStderr:
    """A context in which stderr is discarded, so that messages of decoders (libpng, OpenCV) are not shown.

    Threads may be in it at the same time: the first redirects stderr and the last restores it.
    """

    def __init__(self) -> None:
        self._lock, self._within, self._kept = threading.Lock(), 0, -1

    def __enter__(self) -> None:
        with self._lock:
            if not self._within:
                self._kept = os.dup(2)
                with open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device
                    os.dup2(nowhere.fileno(), 2)
            self._within += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._within -= 1
            if not self._within:
                os.dup2(self._kept, 2)
                os.close(self._kept)


_QUIET_STDERR = _QuietStderr()


def quiet_decoders() -> _QuietStderr:
    """Return a context in which messages of decoders about damaged files are not shown."""
    return _QUIET_STDERR
