"""Sizes of pictures from their headers, without decoding them: PNG, JPEG, TIFF, BMP, WebP and portable maps.

PNG: ISO/IEC 15948. JPEG: ITU-T T.81, B.2. TIFF: revision 6.0 of the specification, and BigTIFF. BMP: Microsoft's
BITMAPINFOHEADER. WebP: RFC 9649. Portable maps: https://netpbm.sourceforge.net/doc/pnm.html.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = {0x01, *range(0xD0, 0xD9)}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}
_TAGS = {256: "width", 257: "height", 258: "bits", 277: "channels", 322: "tile_width", 323: "tile_height"}
_TAG_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MOST_SEGMENTS, _MOST_TAGS, _MOST_CHUNKS = 4096, 4096, 1 << 16
_LARGEST_PNM_HEADER = 1 << 12
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")


@dataclass(frozen=True)
class PictureSize:
    """What a decoder will make of a picture.

    Args:
        height, width: in pixels.
        bytes_per_pixel: at most, of the decoded pixels.
        tile: pixels of a tile, which is decoded whole; 0 without tiles.

    """

    height: int
    width: int
    bytes_per_pixel: int
    tile: int = 0


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
    if kind != b"IHDR" or not _chunks_fit(file):
        return None
    return PictureSize(height, width, _PNG_CHANNELS.get(colour, 4) * (2 if depth > 8 else 1))


def _chunks_fit(file: IO[bytes]) -> bool:
    """Return whether no chunk of a PNG claims to be longer than the file; a decoder makes room for what it claims."""
    size, place = file.seek(0, 2), 8
    for _ in range(_MOST_CHUNKS):
        file.seek(place)
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IEND":
            return True
        place += 12 + int.from_bytes(head[:4], "big")
        if place > size + 12:
            return False
    return True


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


def _tiff(file: IO[bytes]) -> PictureSize | None:
    """Read the first directory; of a tag that is there twice, the larger value."""
    file.seek(0)
    order = {b"II": "<", b"MM": ">"}[file.read(2)]
    (version,) = struct.unpack(order + "H", file.read(2))
    big = version == 43
    word, count_code, step = ("Q", "Q", 20) if big else ("I", "H", 12)
    file.seek(8 if big else 4)
    (at,) = struct.unpack(order + word, file.read(struct.calcsize(word)))
    file.seek(at)
    (count,) = struct.unpack(order + count_code, file.read(struct.calcsize(count_code)))
    entry = struct.Struct(f"{order}HH{word}{struct.calcsize(word)}s")
    found: dict[str, int] = {}
    for tag, kind, length, value in entry.iter_unpack(file.read(step * min(count, _MOST_TAGS))):
        if tag in _TAGS and kind in _TAG_TYPES:
            name, code = _TAGS[tag], order + _TAG_TYPES[kind]
            if length * struct.calcsize(code) > len(value):  # the values lie elsewhere
                file.seek(struct.unpack(order + word, value)[0])
                value = file.read(struct.calcsize(code))  # noqa: PLW2901 - of all samples, the first
            found[name] = max(found.get(name, 0), struct.unpack_from(code, value)[0])
    if count > _MOST_TAGS or not {"width", "height"} <= found.keys():
        return None
    tile = found.get("tile_width", 0) * found.get("tile_height", 0)
    sample = max(1, -(-found.get("bits", 1) // 8))
    return PictureSize(found["height"], found["width"], sample * max(1, found.get("channels", 1)), tile)


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
