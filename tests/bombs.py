"""Small files that unpack to gigabytes, or whose headers say so, and a limit of memory as commands have it."""

import contextlib
import io
import json
import os
import resource
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

LARGE = 600 << 20  # Bytes, more than a refusal may take
CHUNK = 1 << 24


@contextlib.contextmanager
def limited_memory(most: int) -> Iterator[None]:
    """Limit this process in the block to ``most`` bytes more than it has, on Linux."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with contextlib.suppress(OSError):
        lines = Path("/proc/self/status").read_text().splitlines()
        now = 1024 * int(next(line for line in lines if line.startswith("VmData")).split()[1])
        resource.setrlimit(resource.RLIMIT_DATA, (now + most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


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


def png(path: Path, side: int = 1 << 14) -> None:
    """Write a square grey PNG of zeros, 2^28 pixels by default."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packing = zlib.compressobj(1)
    row = b"\0" * (1 + 2 * side)
    data = b"".join(packing.compress(row) for _ in range(side)) + packing.flush()
    header = struct.pack(">IIBBBBB", side, side, 16, 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def png_of_16_megapixels(path: Path) -> None:
    """Write a PNG of 2^24 pixels."""
    png(path, 1 << 12)


def jpeg(path: Path) -> None:
    """Write the beginning of a JPEG of 65500 x 65500 pixels."""
    frame = struct.pack(">BHHB", 8, 65500, 65500, 1) + b"\1\x11\0"
    path.write_bytes(b"\xff\xd8\xff\xc2" + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xda")


def tiff(path: Path) -> None:
    """Write the directory of a TIFF of 2^30 floats, and none of them."""
    tags = {256: 1 << 15, 257: 1 << 15, 258: 32, 259: 8, 262: 1, 273: 8, 277: 1, 278: 1 << 15, 279: 8, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + b"\0" * 64)


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


class Trap:
    """Makes a folder where somebody unpickles it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)
