"""Torch's own files, of weights and checkpoints: plain values and tensors alone."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor


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
    """Refuse a file with a tensor of the device ``meta``, a sparse or a quantised one."""
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
