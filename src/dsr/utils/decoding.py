"""Pictures decoded by OpenCV: sizes are checked first, from the headers, and decoders say nothing of damaged ones.

Pillow reads the headers; those of TIFF (revision 6.0 of the specification, and BigTIFF) are read here, for the pages
behind the first one, and for tags that OpenCV ignores.
"""

import contextlib
import io
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

import cv2
import numpy as np
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.WebPImagePlugin import WebPImageFile

from dsr.utils.guards import expect_pixels, pixels_of_file

# Photometric interpretations of TIFF: a mosaic of colours, and linear raw values; GDAL's tag, a number as text.
_RAW, _GDAL_NODATA = (32803, 34892), 42113
_PNG, _GREY_AND_OPACITY = b"\x89PNG\r\n\x1a\n", 4  # colour type of PNG
_ORIENTATION, _TAGS = 274, {254, 255, 256, 257, 258, 259, 262, 274, 330, 339, 42113}
_TAG_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
_MOST_TAGS, _MOST_VALUES, _MOST_PAGES = 4096, 64, 64
# Their classes, as Image.open warns of photos of 90 megapixels.
_PILLOW: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile, b"RIFF": WebPImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), PpmImageFile),
}  # fmt: skip


def decode_pixels(place: str | Path, content: bytes, flags: int, most: int | None = None) -> np.ndarray | None:
    """Return the pixels of an encoded picture as OpenCV decodes them; None if it is damaged or none.

    With IMREAD_UNCHANGED, holes of a TIFF of GDAL are 0 or NaN, and grey with opacity has one channel if it is opaque.
    A message begins with ``place``. ``most``: largest number of pixels; None for what the length explains.
    """
    size = picture_size(io.BytesIO(content))
    if size is None:
        return None
    expect_pixels(place, *size, pixels_of_file(len(content)) if most is None else most)
    no_data = None
    if content[:2] in (b"II", b"MM"):
        content, no_data = _only_page(place, content, flags)
    try:
        with QUIET_DECODERS:
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        return None
    if flags == cv2.IMREAD_UNCHANGED and pixels is not None:
        if no_data is not None:
            pixels[pixels == no_data] = 0 if pixels.dtype.kind in "iu" else np.nan
        if content.startswith(_PNG) and content[25] == _GREY_AND_OPACITY:  # which OpenCV makes four channels of
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
    """A context without messages of decoders: its first thread redirects stderr, and its last one restores it."""

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


QUIET_DECODERS = _QuietStderr()


def picture_size(file: IO[bytes]) -> tuple[int, int] | None:
    """Return height and width of the picture in an open file; None without a complete header of these formats."""
    file.seek(0)
    start = file.read(24)
    try:
        if start.startswith(_PNG):
            width, height = struct.unpack(">II", start[16:])
        elif start[:2] in (b"II", b"MM"):
            tags = tiff_pages(file)[0].tags
            width, height = tags[256][0], tags[257][0]
        else:
            [reader] = [each for magic, each in _PILLOW.items() if start.startswith(magic)]
            file.seek(0)
            width, height = reader(file).size
    except Exception:  # Pillow names no set of errors for damaged files
        return None
    return (height, width) if min(height, width) > 0 else None


class TiffPage(NamedTuple):
    """A page of a TIFF."""

    at: int  # place of its directory in the file
    orientation_at: int  # place of its orientation, 0 for none
    tags: dict[int, tuple[int, ...]]  # the larger values of one that is there twice; texts are their bytes


def tiff_pages(file: IO[bytes]) -> list[TiffPage]:
    """Return the pages of a TIFF and its sub-images, but for thumbnails, overviews and masks of them."""
    file.seek(0)
    order = {b"II": "<", b"MM": ">"}[file.read(2)]

    def read(at: int, code: str) -> tuple[int, ...]:
        file.seek(at)
        return struct.unpack(order + code, file.read(struct.calcsize(order + code)))

    word, count_code, size, step = ("Q", "Q", 8, 20) if read(2, "H") == (43,) else ("I", "H", 4, 12)
    ahead, seen, pages = [*read(size, word)], {0}, list[TiffPage]()
    while ahead and len(seen) <= _MOST_PAGES:
        at = ahead.pop(0)
        if at in seen:
            continue
        seen.add(at)
        with contextlib.suppress(struct.error, ValueError, OverflowError, OSError):  # pages behind a damaged one
            (count,) = read(at, count_code)
            start, orientation_at, tags = at + struct.calcsize(order + count_code), 0, dict[int, tuple[int, ...]]()
            if count > _MOST_TAGS:
                continue
            for place in range(start, start + step * count, step):
                tag, kind, length = read(place, "HH" + word)
                if not length or tag not in _TAGS or kind not in _TAG_TYPES:
                    continue
                value_at, bytes_each = place + 4 + size, struct.calcsize(order + _TAG_TYPES[kind])
                if length * bytes_each > size:  # the values lie elsewhere
                    (value_at,) = read(value_at, word)
                tags[tag] = max(tags.get(tag, ()), read(value_at, f"{min(length, _MOST_VALUES)}{_TAG_TYPES[kind]}"))
                orientation_at = value_at if tag == _ORIENTATION else orientation_at
            if tags.get(256) and tags.get(257):
                pages.append(TiffPage(at, orientation_at, tags))
            ahead += [*tags.get(330, ()), *read(start + step * count, word)]
    return [page for page in pages if not page.tags.get(254, (0,))[0] & ~2 and page.tags.get(255) != (2,)] or pages


_NOT_READ = {
    b"#?": "Radiance HDR", b"v/1\x01": "OpenEXR", b"\x93NUMPY": "a NumPy array", b"PK\3\4": "an archive", b"PF": "PFM",
    b"GIF8": "GIF", b"8BPS": "Photoshop", b"%PDF": "PDF", b"P7": "PAM", b"Pf": "PFM", b"\xff\x0a": "JPEG XL",
    b"\0\0\0\x0cJXL ": "JPEG XL", b"\0\0\0\x0cjP  ": "JPEG 2000", b"\xff\x4f\xff\x51": "JPEG 2000",
    b"FUJIFILM": "a raw photo", b"IIU\0": "a raw photo",
}  # fmt: skip
_BRANDS = {b"avi": "AVIF", b"hei": "HEIC", b"hev": "HEIC", b"mif": "HEIC", b"crx": "a raw photo"}
_COMPRESSIONS = {1, 5, 6, 7, 8, 32773, 32946}  # of TIFF, which OpenCV reads


def format_not_read(content: bytes, *, stored: bool) -> str:
    """Return what a picture is that OpenCV cannot decode, in 8 bits or as ``stored``; empty if damaged or unknown."""
    if content[4:8] == b"ftyp":
        return _BRANDS.get(content[8:11], "a video")
    if content[:2] in (b"II", b"MM") and picture_size(io.BytesIO(content)) is not None:
        tags = tiff_pages(io.BytesIO(content))[0].tags
        bits, floats, compression = tags.get(258, (1,))[0], tags.get(339, (1,))[0] == 3, tags.get(259, (1,))[0]
        if compression not in _COMPRESSIONS:
            return f"a TIFF with compression {compression}"
        if (bits > 16 and not stored) or (bits < 32 and floats):
            return f"a TIFF of {bits}-bit {'floats' if floats else 'values'}"
    return next((name for magic, name in _NOT_READ.items() if content.startswith(magic)), "")
