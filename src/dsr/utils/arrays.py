"""Arrays in ``.npy`` and ``.npz`` files, whose headers are checked before any value is read."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Container
from pathlib import Path
from typing import IO

import numpy as np

from dsr.utils.guards import array_bytes, bytes_of_archive, expect_bytes, opened, refusing

_LARGEST_HEADER = 1 << 14  # bytes of the header of an array


def read_arrays(path: Path, names: Container[str] | None = None, most: int | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file.

    Args:
        names: of the arrays to read, of which it need not have all; None for all that it has.
        most: largest number of bytes that they may have together; None for what the size of the file explains, see
            :func:`dsr.utils.guards.bytes_of_archive`.

    """
    wanted = {name: header for name, header in array_headers(path).items() if names is None or name in names}
    size = sum(array_bytes(shape, dtype.itemsize) for shape, dtype in wanted.values())
    expect_bytes(path, size, bytes_of_archive(path.stat().st_size) if most is None else most)
    with (
        opened(path) as file,
        # a damaged archive makes NumPy raise BadZipFile, EOFError, zlib.error, ...
        refusing(f"{path}: expected an archive of arrays, got a damaged or foreign file", Exception),
    ):
        arrays = np.load(file)
        return {name: arrays[name] for name in arrays.files if name in wanted}


def array_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of the arrays of an ``.npz`` file, without reading their values."""
    headers = {}
    with (
        opened(path) as file,
        refusing(f"{path}: expected an archive of arrays, got a damaged or foreign file", Exception),  # as above
        zipfile.ZipFile(file) as archive,
    ):
        for name in archive.namelist():
            key = name.removesuffix(".npy")
            if key in headers:  # which of them NumPy reads is another matter
                raise ValueError(f"expected arrays of different names, got two named {key!r}")
            with archive.open(name) as member:
                headers[key] = read_array_header(member)
    return headers


def read_array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Return shape and type in the header of an ``.npy`` file, and stay behind it."""
    version = np.lib.format.read_magic(file)
    form = "<H" if version == (1, 0) else "<I"
    length = file.read(struct.calcsize(form))
    (size,) = struct.unpack(form, length)
    expect_bytes("header", size, _LARGEST_HEADER)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(io.BytesIO(length + file.read(size)))
    if dtype.hasobject:
        raise ValueError("expected an array of numbers, got one of Python objects")
    if any(not 0 <= each < 1 << 62 for each in shape):
        raise ValueError(f"expected the sizes of an array, got {shape}")
    return shape, dtype
