"""Arrays in ``.npz`` files: numbers and texts alone, never Python objects."""

from __future__ import annotations

import zipfile
from collections.abc import Container
from pathlib import Path

import numpy as np

from dsr.utils.guards import bytes_of_archive, expect_bytes, opened, refusing

_REFUSAL = "{}: expected an archive of arrays, got a damaged or foreign file"


def read_arrays(path: Path, names: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file: all, or those of some names that it has."""
    with opened(path) as file:
        # a damaged archive makes NumPy raise BadZipFile, EOFError, zlib.error, ...
        with refusing(_REFUSAL.format(path), Exception):
            arrays = np.load(file)
            unpacked = sum(member.file_size for member in arrays.zip.infolist())
        expect_bytes(path, unpacked, bytes_of_archive(path.stat().st_size))
        with refusing(_REFUSAL.format(path), Exception):
            return {name: arrays[name] for name in arrays.files if names is None or name in names}


def array_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of the arrays of an ``.npz`` file, without reading their values."""
    headers = {}
    with opened(path) as file, refusing(_REFUSAL.format(path), Exception), zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                first = np.lib.format.read_magic(member) == (1, 0)
                read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(member)
            headers[name.removesuffix(".npy")] = shape, dtype
    return headers
