"""Atomic writing of files, and reading of archives of arrays."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import tempfile
import zipfile
from collections.abc import Container, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from dsr.utils.limits import array_bytes, bytes_of_archive, expect_bytes, opened
from dsr.utils.space import space_for
from dsr.utils.temporary import owner, remove_abandoned, temporary_folder


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without error.

    The directory is created if it does not exist. After an error or an interruption the temporary file is deleted; one
    that a killed process has left is deleted the next time that a file is written in its directory.

    Raises:
        FullDiskError: there is no space for the file.

    """
    with space_for(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-{owner()}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        with space_for(path):
            yield temporary
            temporary.chmod(0o644)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that replaces it when the block ends without error.

    Raises:
        FullDiskError: there is no space for its files.

    """
    with temporary_folder(path.parent, path.name) as temporary:
        yield temporary
        temporary.chmod(0o755)
        with temporary_folder(path.parent, path.name) as old:
            if path.exists():
                path.replace(old / path.name)
            temporary.replace(path)


_LARGEST_HEADER = 1 << 14
"""Largest size in bytes of the header of an array."""


def read_arrays(path: Path, names: Container[str] | None = None, most: int | None = None) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file.

    Args:
        path: the file.
        names: of the arrays to read, of which it need not have all; None for all that it has.
        most: largest number of bytes that they may have together; None for what the size of the file explains, see
            :func:`dsr.utils.limits.bytes_of_archive`.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or no archive of arrays, or they are too large, by what their headers say.

    """
    wanted = {name: header for name, header in array_headers(path).items() if names is None or name in names}
    size = sum(array_bytes(shape, dtype.itemsize) for shape, dtype in wanted.values())
    expect_bytes(path, size, bytes_of_archive(path.stat().st_size) if most is None else most)
    with opened(path) as file:
        try:
            arrays = np.load(file)
            return {name: arrays[name] for name in arrays.files if name in wanted}
        except Exception as error:  # a damaged archive makes NumPy raise BadZipFile, EOFError, zlib.error, ...
            raise ValueError(f"{path}: expected an archive of arrays, got a damaged or foreign file") from error


def array_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of the arrays of an ``.npz`` file, without reading their values.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or no archive of arrays, or an array is one of Python objects.

    """
    headers = {}
    with opened(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    key = name.removesuffix(".npy")
                    if key in headers:  # which of them NumPy reads is another matter
                        raise ValueError(f"expected arrays of different names, got two named {key!r}")
                    with archive.open(name) as member:
                        headers[key] = read_array_header(member)
        except Exception as error:  # as in read_arrays
            raise ValueError(f"{path}: expected an archive of arrays, got a damaged or foreign file") from error
    return headers


def read_array_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Return shape and type in the header of an ``.npy`` file, and stay behind it.

    Raises:
        ValueError: it is no such header, or one of an array of Python objects.

    """
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


def open_array(path: Path) -> np.ndarray:
    """Return the array of an ``.npy`` file, mapped: its header and its size are checked, and values read when used.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, or no array of numbers.

    """
    try:
        with opened(path), np.errstate(over="ignore"):  # of sizes that no file has, which are refused
            array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise
    except Exception as error:  # a damaged header makes NumPy raise TokenError, SyntaxError, OverflowError, ...
        raise ValueError(f"{path}: expected an array, got a damaged or foreign file") from error
    return array


def look_anew(folder: Path) -> None:
    """Have a client of NFS ask its server what a directory contains; it remembers for a while which files it lacks."""
    with contextlib.suppress(OSError):  # there is no such directory, or the system opens none
        os.close(os.open(folder, os.O_RDONLY))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
