"""What files say, without what differs between two undisturbed runs.

That is: seconds in predictions, ``summary.json``, ``info.json`` and pages; which scenes were predicted and which ones
reused; the date of a PDF; logs of TensorBoard, in which a resumed run may repeat steps; hidden temporary files
and folders, which a command that is killed may leave.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file

LOG = "events.out.tfevents."


def files_of(folder: Path) -> dict[str, Path]:
    """Return the files below a folder that are compared, by their relative paths."""
    files = {path.relative_to(folder): path for path in sorted(folder.rglob("*")) if path.is_file()}
    hidden = {place for place in files if any(part.startswith((".", LOG)) for part in place.parts)}
    return {str(place): path for place, path in files.items() if place not in hidden}


def content(path: Path) -> Any:
    """Return what a file says; raise any error if it is not whole."""
    return _READERS.get(path.suffix, Path.read_bytes)(path)


def damaged(folder: Path) -> list[str]:
    """Return the files below a folder that are not whole, one line each."""
    lines = []
    for name, path in files_of(folder).items():
        try:
            content(path)
        except Exception as error:
            lines.append(f"{name}: damaged: {type(error).__name__}: {error}")
    return lines


def differences(reference: Path, got: Path) -> list[str]:
    """Return what differs between two folders, one line each."""
    expected, found = files_of(reference), files_of(got)
    lines = [f"{name}: missing" for name in expected.keys() - found.keys()]
    lines += [f"{name}: not in the reference" for name in found.keys() - expected.keys()]
    for name in expected.keys() & found.keys():
        one, two = expected[name], found[name]
        if one.read_bytes() != two.read_bytes() and content(one) != content(two):
            lines.append(f"{name}: differs")
    return sorted(lines)


def _plain(value: Any) -> Any:
    """Return arrays and tensors as their types, shapes and bytes."""
    if isinstance(value, torch.Tensor):
        value = value.numpy()
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, (list, tuple)) else value


def _without_seconds(value: Any) -> Any:
    """Return a value of JSON without computing times."""
    if isinstance(value, dict):
        return {key: _without_seconds(each) for key, each in value.items() if key != "seconds"}
    return [_without_seconds(each) for each in value] if isinstance(value, list) else value


def _read_npz(path: Path) -> Any:
    with np.load(path) as arrays:
        return {name: _plain(arrays[name]) for name in arrays.files if name != "seconds"}


def _read_png(path: Path) -> bytes:
    with Image.open(path) as image:
        return np.asarray(image).tobytes()


def _read_json(path: Path) -> Any:
    value = _without_seconds(json.loads(path.read_text()))
    if path.name == "summary.json":
        value["predicted or reused"] = sorted(value.pop("predicted") + value.pop("reused"))
    return value


def _read_html(path: Path) -> str:
    text = path.read_text()
    if not text.rstrip().endswith("</html>"):
        raise ValueError(f"{path}: expected </html> at its end")
    return re.sub(r'"seconds":\{(?:[^{}]|\{[^{}]*\})*\}', "", text)


_READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npz": _read_npz,
    ".npy": lambda path: _plain(np.load(path)),
    ".png": _read_png,
    ".json": _read_json,
    ".ckpt": lambda path: _plain(torch.load(path, weights_only=True, map_location="cpu")),
    ".safetensors": lambda path: _plain(load_file(path)),
    ".html": _read_html,
    ".pdf": lambda path: re.sub(rb"/CreationDate \(.*?\)", b"", path.read_bytes()),
}
