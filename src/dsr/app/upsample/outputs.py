"""The folder of one result: its parts are written, and what it depends on is compared with an earlier run's."""

import functools
import json
import math
import platform
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from dsr.app.upsample.parts import ERRORS, FILES, METRES, PARTS, Results
from dsr.app.upsample.stored import INFO, read_depth, read_info
from dsr.geometry.camera import Camera
from dsr.geometry.mesh import ERROR_SHARE, FLATNESS
from dsr.inference.resizing import Plan
from dsr.io.depth_files import IN_METRES, Encoding, encode, storable, write_depth_file
from dsr.io.exports import (
    FLAT,
    INPUT,
    Written,
    write_cloud,
    write_input,
    write_mesh,
    write_normals,
    write_renderings,
    write_rgbd_picture,
    write_stereo,
)
from dsr.io.inputs import Picture
from dsr.io.photos import write_png
from dsr.io.posed_frames import read_errors
from dsr.io.scene_files import write_rgbd
from dsr.methods.base import Surface
from dsr.notes import CHECKS, Assumption
from dsr.utils.files import expect_targets, replacing, write_text
from dsr.utils.versions import package_versions

Values = Mapping[str, Any]  # for JSON
_ERROR_STEPS = 2**6  # expected errors are stored with so many steps below each power of two: off by less than 2 %
_WORTH_SAYING = 1e-3  # smallest fraction of the pixels that is reported as left out
_PACKAGES = ("dsr", "torch", "numpy", "opencv-python-headless")


@dataclass(frozen=True)
class Result:
    """A result to write, and the parts that are requested."""

    picture: Picture
    surface: Surface  # the depth with its expected errors, see :func:`as_stored`
    plan: Plan
    wanted: Results
    name: str = ""  # of the picture, in titles

    @functools.cached_property
    def encoding(self) -> Encoding:
        """How the result is stored: as the input in the input's format, else in metres, or in whole millimetres."""
        encoding, chosen = self.picture.encoding, self.wanted.format
        of_metres = replace(encoding, suffix=IN_METRES.suffix, hole=0.0) == replace(IN_METRES, hole=0.0)
        if chosen is None and of_metres and math.isnan(encoding.hole):
            return IN_METRES
        own = "tiff" if encoding.suffix == ".tif" else encoding.suffix[1:]
        if chosen in (None, own):  # whole numbers of 64 bits, which a TIFF may have and no writer writes, become 32
            return replace(encoding, dtype=str(storable(encoding.suffix, np.dtype(encoding.dtype))))
        if chosen in ("png", "mm"):
            return Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal")
        return Encoding(f".{chosen}", "float32", 1.0, math.nan, "orthogonal")

    @functools.cached_property
    def shares(self) -> dict[str, float]:
        """The shares of the pixels, see :meth:`dsr.methods.base.Surface.shares`."""
        return self.surface.shares(self.wanted.max_error / 100)


class Output(NamedTuple):
    """What a part wrote: the names of the files, notes for the user, and how much of a shape."""

    files: Sequence[str]
    notes: Sequence[Assumption] = ()
    shape: Written | None = None


class ResultFolder:
    """The folder of a result, what the result depends on, and ``earlier``: the ``info.json`` of the run before."""

    def __init__(self, path: Path, inputs: Values, settings: Values, wanted: Results, *, strict: bool = False) -> None:
        self.path, self.inputs, self.settings = path, inputs, settings
        self._wanted, self._strict = wanted, strict
        self.look()

    def look(self) -> None:
        """Read what an earlier run has left; a ValueError if that is not of ``dsr upsample``."""
        self.earlier: Values = read_info(self.path) or {}

    @property
    def same(self) -> bool:
        """Whether the earlier run had the same inputs and settings."""
        return (self.earlier.get("inputs"), self.earlier.get("settings")) == (self.inputs, self.settings)

    @property
    def size(self) -> int:
        """The bytes of ``info.json`` and of those files that have not been removed since."""
        paths = [self.path / name for name in (*self.earlier["files"], INFO)]
        return sum(path.stat().st_size for path in paths if path.is_file())

    @property
    def reusable(self) -> bool:
        """Whether the earlier run is complete and had the same inputs and settings, and is to be kept."""
        return self.same and self.earlier["complete"] and not self._wanted.overwrite

    def expect_agreement(self, cure: str = "take another -o, or --overwrite") -> None:
        """Raise ValueError, with a cure, if the folder holds a complete result of other inputs or settings."""
        earlier = self.earlier
        if not earlier.get("complete") or self.same or self._wanted.overwrite:
            return
        if earlier["inputs"] != self.inputs:
            names = (str(entry.get("file", name)) for name, entry in earlier["inputs"].items())
            what = f"other inputs: {', '.join(names)}"
        else:
            before = {**dict.fromkeys(self.settings), **earlier["settings"]}
            changed = [name for name, value in before.items() if value != self.settings.get(name)]
            said = (f"no {name}" if before[name] is None else f"{name} {before[name]}" for name in changed)
            what = f"other settings: {', '.join(said)}"
        raise ValueError(f"{self.path}: holds a result of {what}; {cure}")

    def expect_free(self, sources: Iterable[Path] = ()) -> None:
        """Check that a result would not overwrite its sources, files that no earlier run wrote, or a link or device."""
        expect_targets(self.path, (*FILES, INFO))
        there = [self.path / name for name in (*FILES, INFO) if (self.path / name).exists()]
        for path in there:
            if any(path.samefile(source) for source in sources):
                raise ValueError(f"{path}: the result would overwrite its input; take another -o")
        if there and not self.earlier and not self._wanted.overwrite:
            raise ValueError(f"{there[0]}: is there already and not of an earlier run; take another -o, or --overwrite")

    @property
    def done(self) -> bool:
        """Whether all requested parts exist as wanted, if ``strict`` by a run with the checks of today."""
        if not self.reusable or (self._strict and self.earlier.get("checks") != CHECKS):
            return False
        wanted = self._wanted
        there = {name for name in self.earlier["files"] if (self.path / name).is_file()}
        if METRES not in there and any(part.name == "depth" for part in wanted.of_frame):
            return False
        shapes = [self.earlier.get(part.name) for part in wanted.of_frame if part.shape]
        large = any(isinstance(shape, dict) and shape.get("how") == FLAT for shape in shapes)
        if wanted.keep == "all" and large:  # which wants every pixel; a mesh of these serves for both
            return False
        return all(there & set(part.files) for part in wanted.of_frame)

    def surface(self, camera: Camera, *, errors: bool) -> Surface | None:
        """Return the stored result if it is reusable; None if a file of it, that of the errors if needed, is lost."""
        if not self.reusable:
            return None
        try:
            surface = Surface(torch.from_numpy(read_depth(self.path, camera))[None])
            if errors or (self.path / ERRORS).is_file():
                stored = read_errors(self.path / ERRORS, camera)
                depth_error, angle_error = (torch.from_numpy(each)[None] for each in stored)
                surface = surface._replace(depth_error=depth_error, angle_error=angle_error)
        except (OSError, ValueError):
            return None
        return surface

    def store(self, result: Result, seconds: Mapping[str, float], *, reused: bool = False) -> list[Assumption]:
        """Write the parts of a result and ``info.json``, which says when it is complete; return notes on the parts.

        Files of an earlier run with the same inputs and settings stay. ``seconds`` are those of the stages before; if
        the depth of the earlier run is ``reused``, its stages count, too.
        """
        started, kept = time.perf_counter(), dict(self.earlier) if self.same else {}
        for name in () if kept else self.earlier.get("files", ()):
            if name in FILES:
                (self.path / name).unlink(missing_ok=True)
        depends_on = {"inputs": self.inputs, "settings": self.settings}
        self._write({"complete": False, **depends_on, "files": kept.get("files", [])})
        picture, surface = result.picture, result.surface
        with ThreadPoolExecutor(1) as beside:  # shapes take as long as all the rest
            shapes = beside.submit(_write_shapes, self.path, result)
            written = _write_maps(self.path, result) | shapes.result()
        files = dict.fromkeys(name for output in written.values() for name in output.files)  # each once
        facts = dict.fromkeys(note for output in written.values() for note in output.notes)
        counts = {name: output.shape._asdict() for name, output in written.items() if output.shape is not None}
        others = [name for name in kept.get("files", ()) if name not in files]
        notes = (*picture.assumptions, *facts)
        known = ("warning: ", *(note.text for note in notes))
        said = [each for each in (kept.get("assumptions", ()) if others else ()) if not each.startswith(known)]
        before = kept["seconds"] if reused else {}
        stages = {**seconds, "writing": time.perf_counter() - started}
        stages = {name: round(before.get(name, 0.0) + each, 3) for name, each in stages.items()}
        if surface.outliers is not None:
            counts["outliers"] = surface.outliers._asdict()
        self._write(
            {
                **{name: each for name, each in kept.items() if name not in written},
                "complete": True,
                **depends_on,
                "method": result.plan.method,
                "scale": result.plan.scale,
                "plan": result.plan.text,
                "noise": surface.noise._asdict() if surface.noise else kept.get("noise"),
                **_described(picture, result.encoding),
                **counts,
                "shares": kept.get("shares", {}) | {name: round(share, 6) for name, share in result.shares.items()},
                "assumptions": [*map(str, notes), *said],
                "checks": CHECKS,
                "warnings": [note.record() for note in notes if note.code],
                "seconds": {**stages, "total": round(sum(stages.values()), 3)},
                "versions": {"python": platform.python_version(), **package_versions(_PACKAGES)},
                "files": [*files, *others],
            }
        )
        return list(facts)

    def _write(self, info: dict[str, Any]) -> None:
        write_text(self.path / INFO, json.dumps(info, indent=2) + "\n")
        self.earlier = info


def _described(picture: Picture, encoding: Encoding) -> dict[str, Any]:
    encodings = {"input_depth": picture.encoding, "depth_file": encoding, "depth_metres": IN_METRES}
    plain = {name: asdict(each) for name, each in encodings.items()}
    for entries in plain.values():
        if not math.isfinite(entries["hole"]):  # which JSON has not
            entries["hole"] = str(entries["hole"])
    return {
        "photo_size": [picture.camera.width, picture.camera.height],
        "input_size": [picture.depth_lr.shape[-1], picture.depth_lr.shape[-2]],
        "input_holes": round(1 - float(picture.depth_lr.isfinite().float().mean()), 6),
        "camera": asdict(picture.camera),
        "pose": None if picture.pose is None else picture.pose.tolist(),
        "up": picture.up,
        "time": picture.time,
        **plain,
        "depth_metres": {"file": METRES, **plain["depth_metres"]},
    }


def as_stored(surface: Surface) -> Surface:
    """Return a surface with expected errors that are stored to the bit, so that parts added later are the same."""
    rounded: dict[str, Any] = {}
    for name, values in (("depth_error", surface.depth_error), ("angle_error", surface.angle_error)):
        if values is not None:
            mantissa, exponent = torch.frexp(values.float())
            rounded[name] = torch.ldexp((_ERROR_STEPS * mantissa).round() / _ERROR_STEPS, exponent)
    for name, stored in surface._replace(**rounded).error_arrays().items():
        rounded[name] = torch.from_numpy(stored)[None].float()
    return surface._replace(**rounded)


def _write_maps(folder: Path, result: Result) -> dict[str, Output]:
    """Write what is no shape."""
    names = [part.name for part in result.wanted.of_frame]
    picture, surface, camera = result.picture, result.surface, result.picture.camera
    written = {name: Output(PARTS[name].files) for name in names}
    if "depth" in names:
        written["depth"] = _write_depth(folder, result)
    if "renderings" in names:
        write_renderings(folder / "renderings", surface.depth, camera)
    if "normals" in names:
        write_normals(folder / "normals.png", surface.depth, camera)
    if "before_after" in names:
        from dsr.pictures.panels import write_before_after  # noqa: PLC0415 - Matplotlib, which takes a second

        title = ", ".join(filter(None, (result.name, f"{result.plan.method} x{result.plan.scale}")))
        path = folder / "before_after.png"
        write_before_after(path, picture.rgb, picture.depth_lr, surface.depth, camera, title)
    if "confidence" in names and surface.depth_error is not None and surface.angle_error is not None:
        from dsr.pictures.panels import write_confidence  # noqa: PLC0415 - as above

        write_confidence(folder / "confidence.png", surface.depth, surface.depth_error, surface.angle_error)
        with replacing(folder / ERRORS) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **surface.error_arrays())
    if "filled" in names and surface.filled is not None:
        write_png(folder / "filled.png", 255 * surface.filled[0].byte().cpu().numpy())
    if "input" in names:
        write_input(folder / INPUT, picture.rgb, picture.depth_lr)
    for name, place, write in (
        ("rgbd", "rgbd", write_rgbd),
        ("stereo", "stereo_2x1.jpg", write_stereo),
        ("rgbd_picture", "rgbd_2x1.png", write_rgbd_picture),
    ):
        if name in names:
            written[name] = Output(PARTS[name].files, write(folder / place, picture.rgb, surface.depth, camera))
    return written


def _write_depth(folder: Path, result: Result) -> Output:
    """Write the depth in metres without loss, and in the output's encoding if that is another one."""
    depth, encoding = result.surface.depth, result.encoding
    write_depth_file(folder / METRES, depth[0].numpy())
    if encoding is IN_METRES:
        return Output((METRES,))
    values, lost = encode(depth, encoding, result.picture.camera)
    name = f"depth{encoding.suffix}"
    notes = []
    if lost:
        text = f"{name}: what {encoding.dtype} values of this unit cannot hold is written as a hole; {METRES} has all"
        notes.append(Assumption(text, f"{lost} pixels"))
    write_depth_file(folder / name, values)
    if np.dtype(encoding.dtype).kind in "iu":
        notes.append(Assumption(f"{name} is in whole numbers like the input; {METRES} is not rounded"))
    return Output((name, METRES), notes)


def _write_shapes(folder: Path, result: Result) -> dict[str, Output]:
    """Write the meshes and the cloud, of the pixels that are not likely to be wrong."""
    names = [part.name for part in result.wanted.of_frame if part.shape]
    if not names:
        return {}
    limit, notes = result.wanted.max_error / 100, list[Assumption]()
    if (share := result.shares.get("dubious", 0.0)) >= _WORTH_SAYING:
        text = f"{share:.1%} of the pixels, expected to be off by more than {limit:.1%} of their depth"
        notes.append(Assumption("left out of cloud and mesh", text))
    depth = result.surface.without_dubious(limit).depth
    if not bool(depth.isfinite().any()):
        notes.append(Assumption("no cloud and no mesh", "no pixel is left"))
        return {name: Output((), notes) for name in names}
    written: dict[str, Output] = {}
    picture, wanted, filled = result.picture, result.wanted, result.surface.filled
    if meshes := [name for name in names if name != "cloud"]:
        files = [PARTS[name].files[0] for name in meshes]
        tolerance = None
        if wanted.keep != "all":
            tolerance = FLATNESS * depth
            if (error := result.surface.depth_error) is not None:
                tolerance = tolerance.maximum(ERROR_SHARE * error)
        try:
            shape = write_mesh(
                [folder / name for name in files], picture.rgb, depth, picture.camera, most=wanted.max_faces,
                tolerance=tolerance, filled=filled,
            )  # fmt: skip
            of_mesh = (*notes, *_fewer("mesh", "triangles", "--max-faces", shape))
            written |= {name: Output(files, of_mesh, shape) for name in meshes}
        except ValueError as error:
            written |= {name: Output((), (*notes, Assumption("no mesh", str(error)))) for name in meshes}
    if "cloud" in names:
        shape = write_cloud(
            folder / "cloud.ply", picture.rgb, depth, picture.camera, most=wanted.max_points, filled=filled
        )
        written["cloud"] = Output(("cloud.ply",), (*notes, *_fewer("cloud", "points", "--max-points", shape)), shape)
    return written


def _fewer(part: str, what: str, option: str, shape: Written) -> list[Assumption]:
    text = f"the {part} has fewer {what} than the depth map gives ({option})"
    return [Assumption(text, str(shape))] if shape.how not in ("", FLAT) else []
