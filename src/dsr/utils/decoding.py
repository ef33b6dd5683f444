"""Pictures decoded by OpenCV: sizes are checked first, from the headers, and decoders say nothing of damaged ones.

PNG: ISO/IEC 15948. JPEG: ITU-T T.81, B.2. TIFF: revision 6.0 of the specification, and BigTIFF. BMP: Microsoft's
BITMAPINFOHEADER. WebP: RFC 9649. Portable maps: https://netpbm.sourceforge.net/doc/pnm.html.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import cv2
import numpy as np

from dsr.utils.guards import expect_bytes, expect_pixels, pixels_of_file

_BYTES_PER_PIXEL = 16  # in memory for each allowed pixel: four channels of float32
# Photometric interpretations of TIFF: a mosaic of colours, and linear raw values; GDAL's tag, a number as text.
_RAW, _GDAL_NODATA = (32803, 34892), 42113
_GREY_AND_OPACITY = 4  # colour type of PNG
_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = {0x01, *range(0xD0, 0xD9)}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}
_ORIENTATION, _TAGS = 274, {254, 255, 256, 257, 258, 259, 262, 274, 277, 322, 323, 330, 339, 42113}
_TAG_TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
_MOST_SEGMENTS, _MOST_TAGS, _MOST_VALUES, _MOST_PAGES = 4096, 4096, 64, 64
_LARGEST_PNM_HEADER = 1 << 12
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")


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
        with QUIET_DECODERS:
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


QUIET_DECODERS = _QuietStderr()
"""A context in which messages of decoders about damaged files are not shown."""


@dataclass(frozen=True)
class PictureSize:
    """What a decoder will make of a picture."""

    height: int
    width: int
    bytes_per_pixel: int  # at most
    tile: int = 0  # pixels of a tile, which is decoded whole; 0 without tiles


def picture_size(file: IO[bytes]) -> PictureSize | None:
    """Return the size of the picture in an open file; None where it has no complete header of these formats."""
    file.seek(0)
    start = file.read(16)
    for magic, read in _READERS.items():
        if start.startswith(magic):
            try:
                found = read(file)
            except (struct.error, ValueError, IndexError, OverflowError, OSError):
                return None
            return found if found is not None and min(found.height, found.width) > 0 else None
    return None


def _png(file: IO[bytes]) -> PictureSize | None:
    file.seek(12)
    kind, width, height, depth, colour = struct.unpack(">4sIIBB", file.read(14))
    if kind != b"IHDR":
        return None
    return PictureSize(height, width, _PNG_CHANNELS.get(colour, 4) * (2 if depth > 8 else 1))


def _jpeg(file: IO[bytes]) -> PictureSize | None:
    """Follow the segments to the start of the frame."""
    file.seek(2)
    for _ in range(_MOST_SEGMENTS):
        while (byte := file.read(1)) not in (b"\xff", b""):
            pass
        while (byte := file.read(1)) == b"\xff":
            pass
        if not byte or byte[0] in (0xD9, 0xDA):
            return None
        if byte[0] in _WITHOUT_LENGTH or byte[0] == 0:
            continue
        (length,) = struct.unpack(">H", file.read(2))
        if byte[0] in _START_OF_FRAME:
            _, height, width, channels = struct.unpack(">BHHB", file.read(6))
            return PictureSize(height, width, max(3, channels))
        file.seek(length - 2, 1)
    return None


def _bmp(file: IO[bytes]) -> PictureSize | None:
    file.seek(14)
    (length,) = struct.unpack("<I", file.read(4))
    width, height = struct.unpack("<HH", file.read(4)) if length == 12 else struct.unpack("<ii", file.read(8))
    return PictureSize(abs(height), abs(width), 4)


def _tiff(file: IO[bytes]) -> PictureSize:
    tags = tiff_pages(file)[0].tags
    tile = tags.get(322, (0,))[0] * tags.get(323, (0,))[0]
    sample = max(1, -(-tags.get(258, (1,))[0] // 8))
    return PictureSize(tags[257][0], tags[256][0], sample * max(1, tags.get(277, (1,))[0]), tile)


class TiffPage(NamedTuple):
    """A page of a TIFF: the places of its directory and of its orientation (0 for none) in the file, and its tags.

    Of a tag that is there twice, the larger values count; texts are their bytes.
    """

    at: int
    orientation_at: int
    tags: dict[int, tuple[int, ...]]


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


def _webp(file: IO[bytes]) -> PictureSize | None:
    file.seek(8)
    kind, chunk = file.read(4), file.read(4)
    file.read(4)
    content = file.read(10)
    if kind != b"WEBP":
        return None
    if chunk == b"VP8X":
        width, height = (int.from_bytes(content[at : at + 3], "little") + 1 for at in (4, 7))
    elif chunk == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 1)
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (size & 0x3FFF for size in struct.unpack_from("<HH", content, 6))
    return PictureSize(height, width, 4)


def _pnm(file: IO[bytes]) -> PictureSize | None:
    file.seek(0)
    match = _PNM.match(file.read(_LARGEST_PNM_HEADER))
    return None if match is None else PictureSize(int(match[2]), int(match[1]), 6)


_READERS: dict[bytes, Callable[[IO[bytes]], PictureSize | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    b"BM": _bmp,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"II+\0": _tiff,
    b"MM\0+": _tiff,
    b"RIFF": _webp,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), _pnm),
}
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
