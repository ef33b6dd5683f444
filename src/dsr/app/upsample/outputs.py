"""The folder of one result: the files of a result, those of an earlier run, and ``info.json``."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dsr.app.upsample.parts import ERRORS, FILES, METRES, PARTS
from dsr.evaluation.results import load_errors
from dsr.geometry.camera import Camera
from dsr.io.depth_files import read_depth_file, storable
from dsr.io.encoding import IN_METRES, Encoding
from dsr.io.inputs import Picture
from dsr.methods.base import Surface
from dsr.notes import Assumption, read_warning
from dsr.sample import FARTHEST, NEAREST
from dsr.utils.files import expect_targets, write_text
from dsr.utils.guards import parse_json, pixels_beside, read_limited

INFO = "info.json"
_SHAPES = tuple(part.name for part in PARTS.values() if part.shape)


@dataclass(frozen=True)
class PreviousRun:
    """An earlier run, as recorded in ``info.json``.

    Args:
        complete: whether it finished.
        settings, inputs: those of the run, as JSON has them.
        files: names of the files that it wrote.
        noise: that of its input, as JSON has it; None if it was not estimated.
        shapes: numbers of points and triangles of its cloud and mesh, and of its outliers.
        warnings: that it gave.
        checks: number of the checks that gave them, see :data:`dsr.notes.CHECKS`.
        said: its assumptions and notes, without warnings.
        shares: of the pixels, see :meth:`dsr.methods.base.Surface.shares`.
        seconds: of its stages.

    """

    complete: bool
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    files: tuple[str, ...]
    noise: Mapping[str, Any] | None = None
    shapes: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[Assumption, ...] = ()
    checks: object = None
    said: tuple[str, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)


def output_encoding(encoding: Encoding, chosen: str | None) -> Encoding:
    """Return how the result is stored: as the input in the input's format, else in metres, or in whole millimetres.

    It is :data:`dsr.io.encoding.IN_METRES` itself where the input's values are such and no format is chosen. Of whole
    numbers of 64 bits, which a TIFF may have and no writer writes, it has 32.

    Args:
        encoding: the input's.
        chosen: one of :data:`dsr.app.upsample.parts.FORMATS`; None for the input's.

    """
    if (
        chosen is None
        and replace(encoding, suffix=IN_METRES.suffix, hole=0.0) == replace(IN_METRES, hole=0.0)
        and (math.isnan(encoding.hole))
    ):
        return IN_METRES
    own = "tiff" if encoding.suffix == ".tif" else encoding.suffix[1:]
    if chosen in (None, own):
        return replace(encoding, dtype=str(storable(encoding.suffix, np.dtype(encoding.dtype))))
    if chosen in ("png", "mm"):
        return Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal")
    return Encoding(f".{chosen}", "float32", 1.0, math.nan, "orthogonal")


def read_previous_run(folder: Path) -> PreviousRun | None:
    """Read what an earlier run left in a folder; None if there was none.

    Raises:
        ValueError: there is an ``info.json`` that `dsr upsample` did not write.

    """
    path = folder / INFO
    if not path.is_file():
        return None
    try:
        entries = parse_json(read_limited(path), finite=False)
        noise, files, inputs = entries.get("noise"), entries["files"], dict(entries["inputs"])
        if not isinstance(files, list) or not all(isinstance(name, str) for name in files):
            raise TypeError(f"files: expected names, got {files!r}")
        if not all(isinstance(entry, dict) for entry in inputs.values()):
            raise TypeError(f"inputs: expected facts of each, got {inputs!r}")
        return PreviousRun(
            entries["complete"] is True,
            dict(entries["settings"]),
            inputs,
            tuple(files),
            None if noise is None else dict(noise),
            {name: entries[name] for name in (*_SHAPES, "outliers") if name in entries},
            tuple(read_warning(each) for each in entries.get("warnings", ())),
            entries.get("checks"),
            tuple(text for text in map(str, entries.get("assumptions", ())) if not text.startswith("warning: ")),
            _numbers(entries, "shares"),
            {stage: seconds for stage, seconds in _numbers(entries, "seconds").items() if stage != "total"},
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else; take another -o") from error


def expect_free(folder: Path, inputs: Iterable[Path], *, ours: bool) -> None:
    """Check that a result would not overwrite its input, files that no earlier run wrote, or things that are no files.

    Args:
        folder: the result's folder.
        inputs: files that must not be overwritten.
        ours: whether existing results may be replaced.

    Raises:
        ValueError: it would overwrite one of them, or a file outside of the folder.
        TargetError: a link, a device, a pipe or a socket is in the place of one.

    """
    expect_targets(folder, (*FILES, INFO))
    there = [folder / name for name in (*FILES, INFO) if (folder / name).exists()]
    for path in there:
        if any(path.samefile(other) for other in inputs):
            raise ValueError(f"{path}: the result would overwrite its input; take another -o")
    if there and not ours:
        raise ValueError(f"{there[0]}: is there already and not of an earlier run; take another -o, or --overwrite")


def kept_surface(folder: Path, camera: Camera, *, errors: bool) -> Surface | None:
    """Load the result of an earlier complete run; None if a file of it is missing.

    Args:
        folder: the result's folder.
        camera: the photo's.
        errors: whether its expected errors are needed, which are loaded if they are there.

    """
    size = (camera.height, camera.width)
    with contextlib.suppress(OSError, ValueError):
        values = read_depth_file(folder / METRES, pixels_beside(*size))
        if values.shape != size or values.dtype != np.float32:
            return None
        depth = torch.from_numpy(values)[None]
        if not bool((depth > 0).any()) or bool(((depth < NEAREST) | (depth > FARTHEST)).any()):
            return None
        expected = None
        with contextlib.nullcontext() if errors else contextlib.suppress(OSError, ValueError):
            expected = load_errors(folder / ERRORS)
        if expected is not None and all(each.shape == depth.shape for each in expected):
            return Surface(depth, *expected)
        return None if errors else Surface(depth)
    return None


def _numbers(entries: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return the numbers of an entry of ``info.json`` by their names."""
    return {key: float(value) for key, value in dict(entries.get(name, {})).items()}


def begin(folder: Path, settings: Mapping[str, Any], inputs: Mapping[str, Any], files: Sequence[str]) -> None:
    """Mark a folder as that of an unfinished run."""
    entries = {"complete": False, "inputs": inputs, "settings": settings, "files": files}
    write_text(folder / INFO, json.dumps(entries, indent=2) + "\n")


def finish(folder: Path, earlier: PreviousRun | None, entries: Mapping[str, Any], files: Sequence[str]) -> int:
    """Write ``info.json`` of a finished run, remove other files of an earlier one, and return the size of the files."""
    for name in () if earlier is None else earlier.files:
        if name not in files and name in FILES:
            (folder / name).unlink(missing_ok=True)
    write_text(folder / INFO, json.dumps({"complete": True, **entries, "files": list(files)}, indent=2) + "\n")
    return stored_bytes(folder, files)


def stored_bytes(folder: Path, files: Iterable[str]) -> int:
    """Return the size of ``info.json`` and of the files of a finished run that have not been removed since."""
    return sum((folder / name).stat().st_size for name in (*files, INFO) if (folder / name).is_file())


def described(picture: Picture, encoding: Encoding) -> dict[str, Any]:
    """Return the sizes, the camera with its pose, and the files' encodings for ``info.json``."""
    return {
        "photo_size": [picture.camera.width, picture.camera.height],
        "input_size": [picture.depth_lr.shape[-1], picture.depth_lr.shape[-2]],
        "input_holes": round(1 - float(picture.depth_lr.isfinite().float().mean()), 6),
        "camera": asdict(picture.camera),
        "pose": None if picture.pose is None else picture.pose.tolist(),
        "up": picture.up,
        "time": picture.time,
        "input_depth": _plain(picture.encoding),
        "depth_file": _plain(encoding),
        "depth_metres": {"file": METRES, **_plain(IN_METRES)},
    }


def _plain(encoding: Encoding) -> dict[str, Any]:
    """Return an encoding as values for JSON, which has no NaN."""
    entries = asdict(encoding)
    return entries if math.isfinite(encoding.hole) else {**entries, "hole": str(encoding.hole)}
