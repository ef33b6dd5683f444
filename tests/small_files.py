"""Small files, written byte by byte where a test reads them."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike


def written(path: Path, content: bytes) -> Path:
    """Write a file in a folder that is made where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def touch(folder: Path, *names: str) -> Path:
    """Make empty files."""
    for name in names:
        written(folder / name, b"")
    return folder


def encoded_png(pixels: np.ndarray) -> bytes:
    """Return a PNG file of OpenCV's."""
    return cv2.imencode(".png", pixels)[1].tobytes()


def png_by_its_specification(values: ArrayLike, depth: int = 16, colour: int = 0) -> bytes:
    """Return a PNG file of values (H, W) or (H, W, channels): big-endian samples of 8 or 16 bits."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    samples = np.asarray(values).astype(">u2" if depth == 16 else "u1")
    lines = b"".join(b"\0" + row.tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", samples.shape[1], samples.shape[0], depth, colour, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines, 1)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body
