"""Arrays in ``.npz`` files, and tensors in torch's own: plain values alone, never Python objects."""

import warnings
import zipfile
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

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
            found = {name: arrays[name] for name in arrays.files if names is None or name in names}
            if any(isinstance(each, bytes) for each in found.values()):  # of a member that is no array
                raise ValueError
            return found


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


def read_torch_file(path: Path) -> Any:
    """Return the content of a torch file of plain values and tensors, on the CPU; no code in it is executed."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on files that it then refuses
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch names no set of errors for damaged files
        raise ValueError(
            f"{path}: expected a torch file of plain tensors, got one that is damaged or holds other Python objects, "
            f"which are never loaded ({type(error).__name__})"
        ) from error
    todo, seen = [content], set()
    while todo:
        value = todo.pop()
        if isinstance(value, Tensor):
            if value.is_meta or value.layout != torch.strided or value.is_quantized:
                what = "one without values" if value.is_meta else f"one of {value.layout}, {value.dtype}"
                raise ValueError(f"{path}: expected a torch file of plain tensors, got {what}")
        elif isinstance(value, (Mapping, list, tuple)) and id(value) not in seen:
            seen.add(id(value))
            todo += value.values() if isinstance(value, Mapping) else value
    return content


def read_tensors(path: Path, key: str | None = None) -> dict[str, Tensor]:
    """Return the tensors of a torch file by name, or those that it has under a key."""
    content = read_torch_file(path)
    found = content.get(key) if isinstance(content, dict) and key is not None else content
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        keys = ", ".join(map(str, list(content)[:4])) if isinstance(content, dict) else type(content).__name__
        place = "" if key is None else f" under the key {key}"
        raise ValueError(f"{path}: expected a network's tensors by name{place}, got {keys}")
    return {str(name): value for name, value in found.items()}
