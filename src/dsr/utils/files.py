"""Atomic writing of files, and reading of archives of arrays."""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from collections.abc import Container, Iterator
from pathlib import Path
from typing import IO

import numpy as np


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without error.

    The directory is created if it does not exist. After an error or an interruption the temporary file is deleted.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_arrays(path: Path, names: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file.

    Args:
        path: the file.
        names: of the arrays to read, of which it need not have all; None for all that it has.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or no archive of arrays.

    """
    with path.open("rb") as file:
        try:
            arrays = np.load(file)
            return {name: arrays[name] for name in arrays.files if names is None or name in names}
        except Exception as error:  # a damaged archive makes NumPy raise BadZipFile, EOFError, zlib.error, ...
            raise ValueError(f"{path}: expected an archive of arrays, got a damaged or foreign file") from error


def array_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of the arrays of an ``.npz`` file, without reading their values.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or no archive of arrays, or an array is one of Python objects.

    """
    headers = {}
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    with archive.open(name) as member:
                        headers[name.removesuffix(".npy")] = _array_header(member)
        except Exception as error:  # as in read_arrays
            raise ValueError(f"{path}: expected an archive of arrays, got a damaged or foreign file") from error
    return headers


def _array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Return shape and type in the header of an ``.npy`` file."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("expected an array of numbers, got one of Python objects")
    return shape, dtype


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
