"""Torch's own files, of weights and checkpoints: plain values and tensors, and never more than the file holds."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dsr.utils.guards import expect_bytes, opened


def read_torch_file(path: Path) -> Any:
    """Return the content of a torch file of plain values and tensors, on the CPU; no code in it is executed."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    try:
        expect_stored(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on files that it then refuses
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch names no set of errors for damaged files
        raise ValueError(
            f"{path}: expected a torch file of plain tensors, got one that is damaged or holds other Python objects, "
            f"which are never loaded ({type(error).__name__})"
        ) from error
    _expect_plain_tensors(path, content)
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


def _expect_plain_tensors(path: Path, content: Any) -> None:
    """Refuse a file with a tensor without values of its own.

    That is one of the device ``meta``, one that is sparse or quantised, or one that repeats values: a few bytes would
    become gigabytes with the first sum.
    """
    todo, seen = [content], set()
    while todo:
        value = todo.pop()
        if isinstance(value, Tensor):
            if value.is_meta or value.layout != torch.strided or value.is_quantized:
                what = "one without values" if value.is_meta else f"one of {value.layout}, {value.dtype}"
                raise ValueError(f"{path}: expected a torch file of plain tensors, got {what}")
            if value.numel() * value.element_size() > value.untyped_storage().nbytes():
                raise ValueError(f"{path}: expected a torch file of plain tensors, got one that repeats values")
        elif isinstance(value, (Mapping, list, tuple)) and id(value) not in seen:
            seen.add(id(value))
            todo += value.values() if isinstance(value, Mapping) else value


def expect_stored(path: Path) -> None:
    """Check that no member of a torch file, if it is there, is compressed or shared; torch writes none so."""
    if not path.exists():
        return
    with opened(path) as file:
        if not zipfile.is_zipfile(file):  # as of torch before version 1.6
            return
    with zipfile.ZipFile(path) as packed:
        members = packed.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError(f"{path}: expected members that are not compressed")
    expect_bytes(path, sum(member.file_size for member in members), path.stat().st_size)
