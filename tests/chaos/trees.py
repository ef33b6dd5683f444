"""Whether two directories have the same results, and whether every file in one is whole.

Everything has to be the same but for the following, which differs between two undisturbed runs, or tells that a run
went on:

- ``seconds``: an array of predictions, and entries of ``summary.json``, ``info.json`` and a report's page;
- which scenes were predicted and which ones reused, in ``summary.json``; together they have to be the same;
- logs of TensorBoard: their names, times of writing and in the table of runs, the patches per second; a resumed run
  continues in a further file and may repeat steps, of which the last one counts;
- the date of a PDF;
- hidden temporary files, which a command that is killed may leave.
"""

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

EVENTS = "events.out.tfevents."
_CLOCKED_TAGS = {"train/patches_per_second"}
_CLOCKED_KEYS = {"seconds"}


def files_below(folder: Path) -> dict[str, Path]:
    """Return the files below a folder by their relative paths, all logs of TensorBoard in a folder as one."""
    paths = (path for path in sorted(folder.rglob("*")) if not path.is_dir())
    return {str((path.parent / EVENTS if EVENTS in path.name else path).relative_to(folder)): path for path in paths}


def differences(reference: Path, got: Path) -> list[str]:
    """Return what differs between two directories, one line each."""
    expected, found = files_below(reference), files_below(got)
    lines = [f"{name}: missing" for name in expected.keys() - found.keys()]
    more = {name for name in found.keys() - expected.keys() if not Path(name).name.startswith(".")}
    lines += [f"{name}: not in the reference" for name in more]
    for name in sorted(expected.keys() & found.keys()):
        one, two = expected[name], found[name]
        try:
            if one.read_bytes() != two.read_bytes() and content(one) != content(two):
                lines.append(f"{name}: {_first_difference(content(one), content(two))}")
        except Exception as error:
            lines.append(f"{name}: cannot be read: {type(error).__name__}: {error}")
    return sorted(lines)


def damaged(folder: Path) -> list[str]:
    """Return the files below a folder that cannot be read, temporary ones and logs left out, one line each."""
    lines = []
    for name, path in files_below(folder).items():
        if any(part.startswith(".") for part in Path(name).parts) or EVENTS in name:
            continue
        try:
            _check(path)
        except Exception as error:
            lines.append(f"{name}: damaged: {type(error).__name__}: {error}")
    return lines


def content(path: Path) -> Any:
    """Return what a file says, without what is inherently of its time."""
    if EVENTS in path.name:
        return _events(path.parent)
    reader = _READERS.get(path.suffix.lower())
    return path.read_bytes() if reader is None else reader(path)


def _check(path: Path) -> None:
    """Raise if a file is not whole."""
    if path.suffix.lower() == ".png":
        with Image.open(path) as image:
            image.load()
    elif path.suffix.lower() == ".html":
        if not path.read_text(encoding="utf-8").rstrip().endswith("</html>"):
            raise ValueError("no end")
    elif not path.stat().st_size:
        raise ValueError("empty")
    else:
        content(path)


def _read_npz(path: Path) -> dict[str, bytes]:
    """Return the members of an archive of arrays, without the computing time."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist() if name.removesuffix(".npy") != "seconds"}


def _read_npy(path: Path) -> tuple[str, tuple[int, ...], bytes]:
    array = np.load(path)
    return str(array.dtype), array.shape, array.tobytes()


def _read_json(path: Path) -> Any:
    value = _without_clock(json.loads(path.read_text(encoding="utf-8")))
    if path.name == "summary.json":
        value["predicted or reused"] = sorted(value.pop("predicted") + value.pop("reused"))
    return value


def _without_clock(value: Any) -> Any:
    """Return a value of JSON without the keys of computing times."""
    if isinstance(value, dict):
        return {key: _without_clock(each) for key, each in value.items() if key not in _CLOCKED_KEYS}
    return [_without_clock(each) for each in value] if isinstance(value, list) else value


def _read_csv(path: Path) -> list[list[str]]:
    rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if any(len(row) != len(rows[0]) for row in rows) or not path.read_bytes().endswith(b"\n"):
        raise ValueError("a row is cut off")
    return rows


def _read_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _read_checkpoint(path: Path) -> Any:
    import torch  # noqa: PLC0415 - takes a second to import

    def plain(value: Any) -> Any:
        if torch.is_tensor(value):
            return str(value.dtype), tuple(value.shape), value.contiguous().numpy().tobytes()
        if isinstance(value, Mapping):
            return {str(key): plain(each) for key, each in value.items()}
        return [plain(each) for each in value] if isinstance(value, (list, tuple)) else value

    return plain(torch.load(path, weights_only=True, map_location="cpu"))


def _read_safetensors(path: Path) -> Any:
    from safetensors import safe_open  # noqa: PLC0415

    with safe_open(path, "np") as file:
        return file.metadata(), {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118


def _read_ply(path: Path) -> bytes:
    import trimesh  # noqa: PLC0415

    trimesh.load(path, process=False)
    return path.read_bytes()


def _read_html(path: Path) -> str:
    """Return a page without the computing times in its data."""
    return re.sub(r'"seconds":\{(?:[^{}]|\{[^{}]*\})*\}', "", path.read_text(encoding="utf-8"))


def _read_pdf(path: Path) -> bytes:
    data = path.read_bytes()
    if not data.rstrip().endswith(b"%%EOF"):
        raise ValueError("no end")
    return re.sub(rb"/CreationDate \(.*?\)", b"", data)


_READERS: Mapping[str, Callable[[Path], Any]] = {
    ".npz": _read_npz, ".npy": _read_npy, ".json": _read_json, ".csv": _read_csv, ".yaml": _read_yaml,
    ".ckpt": _read_checkpoint, ".safetensors": _read_safetensors, ".ply": _read_ply, ".html": _read_html,
    ".pdf": _read_pdf,
}  # fmt: skip


def _events(folder: Path) -> dict[tuple[str, int], bytes]:
    """Return the values of all TensorBoard logs in a folder by tag and step; the last one of a tag and step counts."""
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader  # noqa: PLC0415

    found: dict[tuple[str, int], bytes] = {}
    for path in sorted(folder.glob(f"{EVENTS}*"), key=lambda each: (each.name.split(".")[3], each.name)):
        for event in LegacyEventFileLoader(str(path)).Load():
            for value in event.summary.value:
                found[value.tag, event.step] = b"" if value.tag in _CLOCKED_TAGS else _plain(value)
    return found


def _plain(value: Any) -> bytes:
    """Return a value of a log as bytes, without the times in TensorBoard's table of runs."""
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData  # noqa: PLC0415

    if value.metadata.plugin_data.plugin_name == "hparams":
        data = HParamsPluginData.FromString(value.metadata.plugin_data.content)
        if data.HasField("session_start_info"):
            data.session_start_info.ClearField("start_time_secs")
        if data.HasField("session_end_info"):
            data.session_end_info.ClearField("end_time_secs")
        value.metadata.plugin_data.content = data.SerializeToString(deterministic=True)
    return value.SerializeToString(deterministic=True)


def _first_difference(one: Any, two: Any) -> str:
    """Return where two contents differ, as a short text."""
    return next(_walk(one, two, ""), "differs")[:300]


def _walk(one: Any, two: Any, where: str) -> Iterator[str]:
    """Yield the places where two contents differ."""
    if isinstance(one, dict) and isinstance(two, dict):
        for key in sorted(one.keys() | two.keys(), key=str):
            if key not in one or key not in two:
                yield f"{where}/{key} is {'missing' if key in one else 'new'}"
            else:
                yield from _walk(one[key], two[key], f"{where}/{key}")
    elif isinstance(one, (list, tuple)) and isinstance(two, (list, tuple)) and len(one) == len(two):
        for number, (left, right) in enumerate(zip(one, two, strict=True)):
            yield from _walk(left, right, f"{where}[{number}]")
    elif one != two:
        sizes = isinstance(one, bytes)
        yield f"{where} differs" if sizes else f"{where}: expected {one!r:.80}, got {two!r:.80}"
