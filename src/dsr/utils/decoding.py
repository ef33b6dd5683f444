"""Pictures decoded by OpenCV: their sizes are checked first, and the decoders say nothing of damaged ones."""

from __future__ import annotations

import io
import os
import struct
import threading
from pathlib import Path

import cv2
import numpy as np

from dsr.utils.guards import expect_bytes, expect_pixels, pixels_of_file
from dsr.utils.picture_headers import picture_size, tiff_pages

_BYTES_PER_PIXEL = 16  # in memory for each allowed pixel: four channels of float32
# Photometric interpretations of TIFF: a mosaic of colours, and linear raw values; GDAL's tag, a number as text.
_RAW, _GDAL_NODATA = (32803, 34892), 42113
_GREY_AND_OPACITY = 4  # colour type of PNG


def decode_pixels(place: str | Path, content: bytes, flags: int, most: int | None = None) -> np.ndarray | None:
    """Return the pixels of an encoded picture as OpenCV decodes them; None if it is damaged or none.

    With IMREAD_UNCHANGED, holes of a TIFF of GDAL are 0 or NaN, and grey with opacity has one channel if it is opaque.

    Args:
        place: its name, for messages.
        content: a PNG, JPEG, TIFF, BMP, WebP or portable map.
        most: largest number of pixels; None for what its length explains.

    """
    header = picture_size(io.BytesIO(content))
    if header is None:
        return None
    most = pixels_of_file(len(content)) if most is None else most
    expect_pixels(place, header.height, header.width, most)
    expect_bytes(
        place, header.bytes_per_pixel * max(header.height * header.width, header.tile), _BYTES_PER_PIXEL * most
    )
    no_data = None
    if content[:2] in (b"II", b"MM"):
        content, no_data = _only_page(place, content, flags)
    try:
        with _QUIET_STDERR:
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None
    if flags == cv2.IMREAD_UNCHANGED and pixels is not None:
        if no_data is not None:
            pixels[pixels == no_data] = 0 if pixels.dtype.kind in "iu" else np.nan
        if content[:4] == b"\x89PNG" and content[25] == _GREY_AND_OPACITY:  # which OpenCV makes four channels of
            opaque = pixels[..., 3].min() == 256**pixels.itemsize - 1
            pixels = pixels[..., 0] if opaque else pixels[..., [0, 3]]
    return pixels


def _only_page(place: str | Path, content: bytes, flags: int) -> tuple[bytes, float | None]:
    """Return a TIFF whose first page is the only one that is no thumbnail, and the value of its holes, or None.

    A photo may have smaller pages behind it. OpenCV applies its orientation whatever the flags say.
    """
    pages = tiff_pages(io.BytesIO(content))
    if any(page.tags.get(262, (0,))[0] in _RAW for page in pages):
        raise ValueError(f"{place}: expected a developed photo, got a raw one (DNG or the like), which is not read")
    if flags != cv2.IMREAD_UNCHANGED and all(page.tags[256] < pages[0].tags[256] for page in pages[1:]):
        pages = pages[:1]
    if len(pages) > 1:
        sizes = ", ".join(f"{page.tags[256][0]} x {page.tags[257][0]}" for page in pages)
        raise ValueError(f"{place}: expected a TIFF of one page, got {len(pages)}: {sizes} (width x height)")
    (page,) = pages
    order, big = "<" if content[:1] == b"I" else ">", b"+" in content[2:4]
    alone = bytearray(content)
    struct.pack_into(order + ("Q" if big else "I"), alone, 8 if big else 4, page.at)
    if page.orientation_at and flags & cv2.IMREAD_IGNORE_ORIENTATION:
        alone[page.orientation_at : page.orientation_at + 2] = struct.pack(order + "H", 1)
    try:
        return bytes(alone), float(bytes(page.tags.get(_GDAL_NODATA, ())).strip(b"\0 "))
    except ValueError:
        return bytes(alone), None


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
