"""Small files that unpack to gigabytes, or whose headers say so."""

import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np

LARGE = 600 << 20  # Bytes, more than a refusal may take
CHUNK = 1 << 24


def zeros(packed: zipfile.ZipFile, name: str, head: bytes, size: int) -> None:
    """Add a member that is ``head`` and ``size`` zeros."""
    with packed.open(name, "w", force_zip64=True) as member:
        member.write(head)
        for start in range(0, size, CHUNK):
            member.write(b"\0" * min(CHUNK, size - start))


def npy_head(shape: tuple[int, ...], dtype: str) -> bytes:
    """Return the header of an array."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": dtype, "fortran_order": False, "shape": shape})
    return head.getvalue()


def npz(path: Path, size: int = 1 << 29, name: str = "depth") -> None:
    """Write an archive with an array of zeros."""
    side = 1 << 14
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        zeros(packed, f"{name}.npy", npy_head((size // 4 // side, side), "<f4"), size)


def npy_sparse(path: Path) -> None:
    """Write an array of 4 GB that takes no room on the disk."""
    with path.open("wb") as file:
        file.write(npy_head((1 << 15, 1 << 15), "<f4"))
        file.truncate(file.tell() + (4 << 30))


def _png(width: int, height: int, rows: int) -> bytes:
    """Return a grey PNG that has ``rows`` rows of zeros, whatever its header says."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packing = zlib.compressobj(1)
    row = b"\0" * (1 + 2 * width) if rows else b""
    data = b"".join(packing.compress(row) for _ in range(rows)) + packing.flush()
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def png(path: Path) -> None:
    """Write a PNG of 2^28 pixels."""
    path.write_bytes(_png(1 << 14, 1 << 14, 1 << 14))


def png_of_16_megapixels(path: Path) -> None:
    """Write a PNG of 2^24 pixels."""
    path.write_bytes(_png(1 << 12, 1 << 12, 1 << 12))


def jpeg(path: Path) -> None:
    """Write the beginning of a JPEG of 65500 x 65500 pixels."""
    frame = struct.pack(">BHHB", 8, 65500, 65500, 1) + b"\1\x11\0"
    path.write_bytes(b"\xff\xd8\xff\xc2" + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xda")


def tiff(path: Path) -> None:
    """Write the directory of a TIFF of 2^30 floats, and none of them."""
    tags = {256: 1 << 15, 257: 1 << 15, 258: 32, 259: 8, 262: 1, 273: 8, 277: 1, 278: 1 << 15, 279: 8, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + b"\0" * 64)


def exr(path: Path) -> None:
    """Write an OpenEXR file of 2^28 pixels, all 0."""
    attributes = b"".join(
        name + b"\0" + kind + b"\0" + struct.pack("<I", len(value)) + value
        for name, kind, value in (
            (b"channels", b"chlist", b"Z\0" + struct.pack("<iB3xii", 2, 0, 1, 1) + b"\0"),
            (b"compression", b"compression", b"\3"),
            (b"dataWindow", b"box2i", struct.pack("<4i", 0, 0, (1 << 14) - 1, (1 << 14) - 1)),
            (b"displayWindow", b"box2i", struct.pack("<4i", 0, 0, (1 << 14) - 1, (1 << 14) - 1)),
            (b"lineOrder", b"lineOrder", b"\0"),
            (b"pixelAspectRatio", b"float", struct.pack("<f", 1)),
            (b"screenWindowCenter", b"v2f", struct.pack("<2f", 0, 0)),
            (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
        )
    )
    head = struct.pack("<II", 20000630, 2) + attributes + b"\0"
    block = zlib.compress(b"\0" + b"\x80" * (16 * 4 * (1 << 14) - 1), 9)
    count, length = (1 << 14) // 16, 8 + len(block)
    start = len(head) + 8 * count
    table = b"".join(struct.pack("<Q", start + number * length) for number in range(count))
    blocks = b"".join(struct.pack("<ii", 16 * number, len(block)) + block for number in range(count))
    path.write_bytes(head + table + blocks)


def mat5(path: Path) -> None:
    """Write a MATLAB 5 file with three compressed variables of 200 MB of zeros each."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    count = 200 << 20
    parts = []
    for number in range(3):
        head = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<2i", count // 8, 1))
        head += element(1, b"depth%d" % number) + struct.pack("<II", 9, count)
        packing = zlib.compressobj(1)
        data = packing.compress(struct.pack("<II", 14, len(head) + count) + head)
        data += b"".join(packing.compress(b"\0" * CHUNK) for _ in range(count // CHUNK))
        data += packing.compress(b"\0" * (count % CHUNK)) + packing.flush()
        parts.append(struct.pack("<II", 15, len(data)) + data)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + b"".join(parts))


def mat73(path: Path) -> None:
    """Write an HDF5 file with a matrix of 2^28 elements, none of them stored."""
    with h5py.File(path, "w") as file:
        file.create_dataset("depth", (1 << 14, 1 << 14), "f8", chunks=(1 << 10, 1 << 10), compression="gzip")


def r3d(path: Path) -> None:
    """Write a capture whose photo unpacks to 600 MB while the archive declares 1 kB."""
    metadata = {"w": 64, "h": 48, "dw": 8, "dh": 6, "K": [50, 0, 0, 0, 50, 0, 32, 24, 1]}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        packed.writestr("metadata", json.dumps(metadata))
        packed.writestr("rgbd/0.depth", b"bvx$")
        zeros(packed, "rgbd/0.jpg", b"", LARGE)
    content = path.read_bytes()
    for real in (struct.pack("<I", LARGE), struct.pack("<Q", LARGE)):  # in both headers
        content = content.replace(real, struct.pack("<I", 1000).ljust(len(real), b"\0"))
    path.write_bytes(content)


def pipe(path: Path) -> None:
    """Make a named pipe that nobody writes to."""
    os.mkfifo(path)


class Trap:
    """Makes a folder where somebody unpickles it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)
