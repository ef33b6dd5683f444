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


def npz_long_header(path: Path) -> None:
    """Write an archive with an array whose header is 600 MB long."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        zeros(packed, "depth.npy", b"\x93NUMPY\2\0" + struct.pack("<I", LARGE), LARGE)


def npy(path: Path) -> None:
    """Write the header of an array of 2^70 bytes, and a sparse file behind it."""
    path.write_bytes(npy_head((1 << 34, 1 << 33), "<f4"))


def npy_sparse(path: Path) -> None:
    """Write an array of 4 GB that takes no room on the disk."""
    with path.open("wb") as file:
        file.write(npy_head((1 << 15, 1 << 15), "<f4"))
        file.truncate(file.tell() + (4 << 30))


def _png(width: int, height: int, rows: int, bits: int = 16) -> bytes:
    """Return a grey PNG that has ``rows`` rows of zeros, whatever its header says."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packing = zlib.compressobj(1)
    row = b"\0" * (1 + width * bits // 8) if rows else b""
    data = b"".join(packing.compress(row) for _ in range(rows)) + packing.flush()
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def png(path: Path) -> None:
    """Write a PNG of 2^28 pixels."""
    path.write_bytes(_png(1 << 14, 1 << 14, 1 << 14))


def png_huge_header(path: Path) -> None:
    """Write a PNG that declares 2^62 pixels and has none."""
    path.write_bytes(_png((1 << 31) - 1, (1 << 31) - 1, 0))


def png_of_16_megapixels(path: Path) -> None:
    """Write a PNG of 2^24 pixels."""
    path.write_bytes(_png(1 << 12, 1 << 12, 1 << 12))


def jpeg(path: Path) -> None:
    """Write the beginning of a JPEG of 65500 x 65500 pixels."""
    frame = struct.pack(">BHHB", 8, 65500, 65500, 1) + b"\1\x11\0"
    path.write_bytes(b"\xff\xd8\xff\xc2" + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xda")


def bmp(path: Path) -> None:
    """Write the header of a BMP of 40000 x 40000 pixels."""
    header = struct.pack("<IiiHHIIiiII", 40, 40000, -40000, 1, 24, 0, 0, 0, 0, 0, 0)
    path.write_bytes(b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + header + b"\0" * 1000)


def webp(path: Path) -> None:
    """Write the header of a lossless WebP of 16384 x 16384 pixels."""
    content = b"\x2f" + struct.pack("<I", 0x3FFF | 0x3FFF << 14) + b"\0" * 50
    chunk = b"WEBPVP8L" + struct.pack("<I", len(content)) + content
    path.write_bytes(b"RIFF" + struct.pack("<I", len(chunk)) + chunk)


def ppm(path: Path) -> None:
    """Write the header of a portable map of 30000 x 30000 pixels."""
    path.write_bytes(b"P6\n# none\n30000 30000\n255\n" + b"\0" * 1000)


def tiff(
    path: Path, size: tuple[int, int] = (1 << 15, 1 << 15), tile: tuple[int, int] | None = None, big: bool = False
) -> None:
    """Write a TIFF of floats that is empty behind its directory: of a size, and with tiles of another."""
    tags = {256: size[1], 257: size[0], 258: 32, 259: 8, 262: 1, 277: 1, 339: 3}
    tags |= {322: tile[1], 323: tile[0], 324: 8, 325: 8} if tile else {273: 8, 278: size[0], 279: 8}
    entries = [struct.pack("<HHQQ" if big else "<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items())]
    head = b"II+\0\x08\0\0\0" + struct.pack("<Q", 16) if big else b"II*\0" + struct.pack("<I", 8)
    path.write_bytes(head + struct.pack("<Q" if big else "<H", len(tags)) + b"".join(entries) + b"\0" * 64)


def tiff_tiles(path: Path) -> None:
    """Write a TIFF of 64 x 64 pixels in one tile of 16384 x 16384."""
    tiff(path, (64, 64), (1 << 14, 1 << 14))


def tiff_big(path: Path) -> None:
    """Write a BigTIFF of 2^60 pixels."""
    tiff(path, (1 << 30, 1 << 30), big=True)


def pfm(path: Path) -> None:
    """Write a sparse PFM of 3 GB."""
    with path.open("wb") as file:
        file.write(b"Pf\n30000 25000\n-1.0\n")
        file.truncate(file.tell() + 4 * 30000 * 25000)


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
    """Write a MATLAB 5 file with five compressed variables of 200 MB of zeros each."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    count = 200 << 20
    parts = []
    for number in range(5):
        head = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<2i", count // 8, 1))
        head += element(1, b"depth%d" % number) + struct.pack("<II", 9, count)
        packing = zlib.compressobj(1)
        data = packing.compress(struct.pack("<II", 14, len(head) + count) + head)
        data += b"".join(packing.compress(b"\0" * CHUNK) for _ in range(count // CHUNK))
        data += packing.compress(b"\0" * (count % CHUNK)) + packing.flush()
        parts.append(struct.pack("<II", 15, len(data)) + data)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + b"".join(parts))


def mat73(path: Path, chunks: tuple[int, int] | None = None) -> None:
    """Write an HDF5 file with matrices that have 2^28 elements together, none of them stored."""
    with h5py.File(path, "w") as file:
        for number in range(4):
            shape = (1 << 13, 1 << 13)
            file.create_dataset(f"depth{number}", shape, "f8", chunks=chunks or (1 << 10, 1 << 10), compression="gzip")


def mat73_block(path: Path) -> None:
    """Write an HDF5 file with a matrix in one block of 2^28 elements."""
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "depth", (64, 64), "f4", maxshape=(None, None), chunks=(1 << 14, 1 << 14), compression="gzip"
        )


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
