"""Matrices from MATLAB files, of version 5 by its published description and of version 7.3 as HDF5.

SciPy reads version 5, too, but a damaged file can crash the whole process there.
"""

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dsr.utils.console import one_line
from dsr.utils.guards import read_limited

_LARGEST = 1 << 25  # largest number of elements that the matrices of a file may have together
_BLOCK = 1 << 24  # number of elements that a block of an array in HDF5 may have, which is unpacked whole
_MATRIX, _COMPRESSED, _STRUCTURE = 14, 15, 2
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}


def read_variables(path: Path) -> dict[str, np.ndarray]:
    """Return the matrices of numbers in a MATLAB file, of versions 5 to 7.3, by name.

    A field of a structure is named "structure.field"; cells, text and sparse matrices are left out.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a MATLAB file, there is none")
    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                stored = _few_matrices(file)
                for array in stored.values():
                    expect_own_values(array)
                return {name: array[()].T for name, array in stored.items()}
        return _few_matrices(_old_variables(memoryview(read_limited(path, 8 * _LARGEST))))
    except Exception as error:  # a damaged file makes h5py raise RuntimeError, OSError, KeyError, ..., zlib its own
        raise ValueError(
            f"{path}: expected a MATLAB file, got a damaged or foreign one ({one_line(error):.80})"
        ) from error


def _old_variables(content: memoryview) -> dict[str, Any]:
    """Return the content of a file of version 5: matrices, structures as dictionaries, None for the rest."""
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:128]))
    if order is None:
        raise ValueError("no header of MATLAB 5")
    found = {}
    left = 8 * _LARGEST
    for kind, part in _elements(content[128:], order):
        if kind == _COMPRESSED:
            unpacking = zlib.decompressobj()
            part = memoryview(unpacking.decompress(part, left + 1))  # noqa: PLW2901 - one of two kinds of the same
            if not unpacking.eof:
                raise ValueError("a compressed variable without end, or too large")
            left -= len(part)
            ((kind, part),) = _elements(part, order)  # noqa: PLW2901
        if kind == _MATRIX:
            name, value = _old_variable(part, order)
            found[name] = value
    return found


def expect_own_values(array: h5py.Dataset) -> None:
    """Refuse an array of HDF5 whose values lie in another file, or in blocks that are too large to be unpacked."""
    if array.external or array.is_virtual:
        raise ValueError(f"{array.name} has its values in another file")
    if array.chunks is not None and math.prod(array.chunks) > _BLOCK:
        raise ValueError(f"{array.name} has blocks of {array.chunks}, expected at most {_BLOCK} elements")


def _old_variable(content: memoryview, order: str) -> tuple[str, Any]:
    if not content:
        return "", None
    (_, flags), (_, sizes), (_, name), *parts = _elements(content, order)
    kind = struct.unpack_from(order + "I", flags)[0] & 0xFF
    shape = tuple(np.frombuffer(sizes, order + "i4").tolist())
    value: Any = None
    if kind in _CLASSES and min(shape) >= 0:
        stored, numbers = parts[0]
        value = np.frombuffer(numbers, order + _STORED[stored]).reshape(shape, order="F").astype(_CLASSES[kind])
    elif kind == _STRUCTURE and shape == (1, 1):
        (_, length), (_, names), *fields = parts
        step = struct.unpack(order + "i", length)[0]
        keys = [bytes(names[at : at + step]).split(b"\0")[0].decode("ascii") for at in range(0, len(names), step)]
        value = {key: _old_variable(part, order)[1] for key, (_, part) in zip(keys, fields, strict=True)}
    return bytes(name).decode("ascii"), value


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of the successive elements in a file of version 5."""
    at = 0
    while at < len(content):
        kind, length = struct.unpack_from(order + "II", content, at)
        start = at + 8
        if kind >> 16:  # at most four bytes, within the element's head
            kind, length, start = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
        else:
            at = start + length + (0 if kind == _COMPRESSED else -length % 8)
        if start + length > len(content):
            raise ValueError("an element that ends beyond the file")
        yield kind, content[start : start + length]


def _few_matrices(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the matrices of a file; more elements than expected are refused."""
    found = _matrices("", entries)
    count = sum(each.size for each in found.values())
    if count > _LARGEST:
        raise ValueError(f"{', '.join(found)} have {count} elements, expected at most {_LARGEST}")
    return found


def _matrices(prefix: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    """Return the matrices of numbers in a file or structure; those of HDF5 are not read yet, their axes reversed."""
    found: dict[str, Any] = {}
    for key in entries:
        if key.startswith("#"):  # MATLAB's own tables
            continue
        if isinstance(entries, h5py.Group) and not isinstance(entries.get(key, getlink=True), h5py.HardLink):
            raise ValueError(f"{prefix}{key} is a link")
        entry = entries[key]
        if isinstance(entry, Mapping):
            found |= _matrices(f"{prefix}{key}.", entry)
        elif isinstance(entry, np.ndarray | h5py.Dataset) and entry.dtype.kind in "biuf" and entry.ndim in (2, 3):
            found[prefix + key] = entry
    return found
