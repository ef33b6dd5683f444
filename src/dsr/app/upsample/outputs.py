"""The folder of one result: the files of a result, those of an earlier run, and ``info.json``."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsr.app.upsample.limits import Limits
from dsr.evaluation.store import load_errors
from dsr.geometry.camera import Camera
from dsr.geometry.shading import LIGHT_NAMES
from dsr.io.depth_files import DEPTH_SUFFIXES, write_depth_file
from dsr.io.encoding import Assumption, Encoding, encode
from dsr.io.exports import Written, write_cloud, write_mesh, write_normals, write_renderings
from dsr.io.input_files import INPUT, write_input
from dsr.io.inputs import Picture
from dsr.io.scene_files.open3d import RGBD, write_rgbd
from dsr.methods.base import Surface
from dsr.sample import FARTHEST, NEAREST
from dsr.utils.files import open_array, replacing, write_text
from dsr.utils.limits import read_limited
from dsr.utils.parsing import parse_json
from dsr.viz.before_after import write_before_after
from dsr.viz.confidence import write_confidence

INFO = "info.json"
METRES = "depth_metres.npy"
ERRORS = "confidence.npz"
_FILES: Mapping[str, tuple[str, ...]] = {
    "depth": (*(f"depth{suffix}" for suffix in DEPTH_SUFFIXES), METRES),
    "renderings": tuple(f"renderings/{name}.png" for name in LIGHT_NAMES),
    "normals": ("normals.png",),
    "cloud": ("cloud.ply",),
    "mesh": ("mesh.ply", "mesh.glb"),
    "before_after": ("before_after.png",),
    "confidence": ("confidence.png", ERRORS),
    "rgbd": tuple(f"rgbd/{name}" for name in RGBD),
    "input": (INPUT,),
}
_WORTH_SAYING = 1e-3
"""Smallest fraction of the pixels that is reported as left out."""


@dataclass(frozen=True)
class PreviousRun:
    """An earlier run, as recorded in ``info.json``.

    Args:
        complete: whether it finished.
        settings, inputs: those of the run, as JSON has them.
        files: names of the files that it wrote.
        noise: that of its input, as JSON has it; None if it was not estimated.
        shapes: numbers of points and triangles of its cloud and mesh.

    """

    complete: bool
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    files: tuple[str, ...]
    noise: Mapping[str, Any] | None = None
    shapes: Mapping[str, Any] = field(default_factory=dict)


def output_encoding(encoding: Encoding, chosen: str | None) -> Encoding:
    """Return how the result is stored: as the input in the input's format, else in metres, or in whole millimetres.

    Args:
        encoding: the input's.
        chosen: one of :data:`dsr.app.upsample.parts.FORMATS`; None for the input's.

    """
    own = "tiff" if encoding.suffix == ".tif" else encoding.suffix[1:]
    if chosen in (None, own):
        return encoding
    if chosen == "png":
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
            {part: entries[part] for part in ("cloud", "mesh") if part in entries},
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected a file of `dsr upsample`, got something else; take another -o") from error


def expect_free(folder: Path, inputs: Iterable[Path], *, ours: bool) -> None:
    """Check that a result would not overwrite its input, or files that no earlier run wrote.

    Args:
        folder: the result's folder.
        inputs: files that must not be overwritten.
        ours: whether existing results may be replaced.

    Raises:
        ValueError: it would overwrite one of them.

    """
    names = [name for names in _FILES.values() for name in names] + [INFO]
    there = [folder / name for name in names if (folder / name).exists()]
    for path in there:
        if any(path.samefile(other) for other in inputs):
            raise ValueError(f"{path}: the result would overwrite its input; take another -o")
    if there and not ours:
        raise ValueError(f"{there[0]}: is there already and not of an earlier run; take another -o, or --overwrite")


def write_parts(
    folder: Path,
    picture: Picture,
    surface: Surface,
    parts: Sequence[str],
    encoding: Encoding,
    title: str,
    limits: Limits | None = None,
) -> tuple[list[str], list[Assumption], dict[str, Written]]:
    """Write the parts of a result.

    Args:
        folder: the result's folder, created if it is missing.
        picture: the input.
        surface: the result.
        parts: some of :data:`dsr.app.upsample.parts.PARTS`, and ``rgbd``.
        encoding: the depth file's encoding.
        title: the title of the before-and-after picture.
        limits: what cloud and mesh leave out.

    Returns:
        The names of the files, notes for the user, and the numbers of points and triangles by part.

    """
    rgb, camera, depth = picture.rgb, picture.camera, surface.depth
    facts: list[Assumption] = []
    shapes: dict[str, Written] = {}
    files: list[str] = []
    with ThreadPoolExecutor(1) as beside:  # shapes take as long as all the rest
        wanted = {"cloud", "mesh"} & set(parts)
        shaping = beside.submit(_write_shapes, folder, picture, surface, parts, limits or Limits()) if wanted else None
        if "depth" in parts:
            files, facts = _write_depth(folder, depth, camera, encoding)
        if "renderings" in parts:
            write_renderings(folder / "renderings", depth, camera)
        if "normals" in parts:
            write_normals(folder / "normals.png", depth, camera)
        if "before_after" in parts:
            write_before_after(folder / "before_after.png", rgb, picture.depth_lr, depth, camera, title)
        if "input" in parts:
            write_input(folder / INPUT, rgb, picture.depth_lr)
        if "confidence" in parts and not _write_errors(folder, surface):
            parts = [part for part in parts if part != "confidence"]
        rgbd_facts = write_rgbd(folder / "rgbd", rgb, depth, camera) if "rgbd" in parts else []
        if shaping is not None:
            missing, notes, shapes = shaping.result()
            parts = [part for part in parts if part not in missing]
            facts += notes
    files += [name for part in parts if part != "depth" for name in _FILES[part]]
    return files, [*facts, *rgbd_facts], shapes


def _write_shapes(
    folder: Path, picture: Picture, surface: Surface, parts: Sequence[str], limits: Limits
) -> tuple[list[str], list[Assumption], dict[str, Written]]:
    """Write cloud and mesh without pixels that are likely to be wrong; return what could not be, notes and numbers."""
    facts: list[Assumption] = []
    shapes: dict[str, Written] = {}
    depth = surface.depth
    if surface.depth_error is not None:
        doubtful = surface.depth_error > limits.error * depth
        depth = depth.masked_fill(doubtful, torch.nan)
        share = float(doubtful.float().mean())
        if share >= _WORTH_SAYING:
            text = f"expected to be off by more than {limits.error:.1%} of their depth"
            facts.append(Assumption("left out of cloud and mesh", f"{share:.1%} of the pixels, {text}"))
    if not bool(depth.isfinite().any()):
        return ["cloud", "mesh"], [*facts, Assumption("no cloud and no mesh", "no pixel is left")], shapes
    rgb, camera = picture.rgb, picture.camera
    if "cloud" in parts:
        shapes["cloud"] = write_cloud(folder / "cloud.ply", rgb, depth, camera, most=limits.points)
    missing = []
    if "mesh" in parts:
        files = [folder / name for name in _FILES["mesh"]]
        try:
            shapes["mesh"] = write_mesh(files, rgb, depth, camera, most=limits.faces)
        except ValueError as error:
            missing.append("mesh")
            facts.append(Assumption("no mesh", str(error)))
    facts += _describe_reduction(shapes)
    return missing, facts, shapes


def _describe_reduction(shapes: Mapping[str, Written]) -> list[Assumption]:
    """Return notes on cloud and mesh, by part, that have less than the depth map gives."""
    words = {"cloud": ("points", "--max-points"), "mesh": ("triangles", "--max-faces")}
    return [
        Assumption("the {} has fewer {} than the depth map gives ({})".format(part, *words[part]), str(written))
        for part, written in shapes.items()
        if written.how
    ]


def _write_errors(folder: Path, surface: Surface) -> bool:
    """Write the expected errors as a picture and as arrays; return whether there are any."""
    if surface.depth_error is None or surface.angle_error is None:
        return False
    write_confidence(folder / "confidence.png", surface.depth, surface.depth_error, surface.angle_error)
    with replacing(folder / ERRORS) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **surface.error_arrays())
    return True


def _write_depth(folder: Path, depth: Tensor, camera: Camera, encoding: Encoding) -> tuple[list[str], list[Assumption]]:
    """Write the depth in the output's encoding, and also in metres if that is a different one."""
    values, lost = encode(depth, encoding, camera)
    name = f"depth{encoding.suffix}"
    facts = []
    if lost:
        text = f"{name}: what {encoding.dtype} values of this unit cannot hold is written as a hole; {METRES} has all"
        facts.append(Assumption(text, f"{lost} pixels"))
    write_depth_file(folder / name, values)
    if replace(encoding, hole=0.0) == Encoding(".npy", "float32", 1.0, 0.0, "orthogonal") and math.isnan(encoding.hole):
        return [name], facts
    with replacing(folder / METRES) as temporary:
        np.save(temporary, depth[0].float().cpu().numpy())
    if np.dtype(encoding.dtype).kind in "iu":
        facts.append(Assumption(f"{name} is in whole numbers like the input; {METRES} is not rounded"))
    return [name, METRES], facts


def kept_surface(folder: Path, camera: Camera, *, errors: bool) -> Surface | None:
    """Load the result of an earlier complete run; None if a file of it is missing.

    Args:
        folder: the result's folder.
        camera: the photo's.
        errors: whether its expected errors are needed.

    """
    size = (camera.height, camera.width)
    with contextlib.suppress(OSError, ValueError):
        values = open_array(folder / METRES)
        if values.shape != size or values.dtype != np.float32:
            return None
        depth = torch.from_numpy(np.array(values))[None]
        if not bool((depth > 0).any()) or bool(((depth < NEAREST) | (depth > FARTHEST)).any()):
            return None
        if not errors:
            return Surface(depth)
        expected = load_errors(folder / ERRORS)
        if expected is not None and all(each.shape == depth.shape for each in expected):
            return Surface(depth, *expected)
    return None


def begin(folder: Path, settings: Mapping[str, Any], inputs: Mapping[str, Any], files: Sequence[str]) -> None:
    """Mark a folder as that of an unfinished run."""
    entries = {"complete": False, "inputs": inputs, "settings": settings, "files": files}
    write_text(folder / INFO, json.dumps(entries, indent=2) + "\n")


def finish(folder: Path, earlier: PreviousRun | None, entries: Mapping[str, Any], files: Sequence[str]) -> None:
    """Write ``info.json`` of a finished run, and remove files of an earlier run that do not belong to it."""
    for name in () if earlier is None else earlier.files:
        if name not in files and any(name in names for names in _FILES.values()):
            (folder / name).unlink(missing_ok=True)
    write_text(folder / INFO, json.dumps({"complete": True, **entries, "files": list(files)}, indent=2) + "\n")


def described(picture: Picture, encoding: Encoding) -> dict[str, Any]:
    """Return the sizes, the camera with its pose, and the files' encodings for ``info.json``."""
    return {
        "photo_size": [picture.camera.width, picture.camera.height],
        "input_size": [picture.depth_lr.shape[-1], picture.depth_lr.shape[-2]],
        "input_holes": round(1 - float(picture.depth_lr.isfinite().float().mean()), 6),
        "camera": asdict(picture.camera),
        "pose": None if picture.pose is None else picture.pose.tolist(),
        "input_depth": _plain(picture.encoding),
        "depth_file": _plain(encoding),
    }


def _plain(encoding: Encoding) -> dict[str, Any]:
    """Return an encoding as values for JSON, which has no NaN."""
    entries = asdict(encoding)
    return entries if math.isfinite(encoding.hole) else {**entries, "hole": str(encoding.hole)}
