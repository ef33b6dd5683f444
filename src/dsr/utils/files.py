"""Atomic writing of files, and reading of archives of arrays."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Container, Iterator
from pathlib import Path

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


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
