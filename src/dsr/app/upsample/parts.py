"""The table of all outputs of ``dsr upsample``, which its options, checks and result folders are based on."""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from dsr.geometry.lights import LIGHT_NAMES
from dsr.utils.guards import MOST_FACES, MOST_POINTS
from dsr.utils.options import Options, Rule, at_least, one_of, option
from dsr.utils.versions import how_to_install

if TYPE_CHECKING:
    from torch import Tensor

    from dsr.io.encoding import Encoding
    from dsr.io.exports import Written
    from dsr.io.inputs import Picture
    from dsr.io.scene_files import Frame
    from dsr.methods.base import Surface
    from dsr.notes import Assumption

_SUFFIXES = ("png", "tiff", "npy", "npz", "pfm", "exr")
FORMATS = (*_SUFFIXES, "mm")
"""Formats of the depth: suffixes, of which png means whole millimetres where the input is something else; ``mm`` always
is a PNG of 16 bits in whole millimetres, 0 in holes."""
METRES = "depth_metres.tiff"
"""Depth to the bit, which is read back, stored as :data:`dsr.io.encoding.IN_METRES` says."""
ERRORS = "confidence.npz"
_ERROR_STEPS = 2**6
"""Expected errors are stored with so many steps below each power of two: off by less than 2 %."""
_WORTH_SAYING = 1e-3
"""Smallest fraction of the pixels that is reported as left out."""


@dataclass(frozen=True)
class Result:
    """A result to write, and the parts that are requested.

    Args:
        picture: the input.
        surface: the depth with its expected errors, see :func:`as_stored`.
        encoding: how the depth file stores it.
        title: the title of the before-and-after picture.
        wanted: the options of the results.

    """

    picture: Picture
    surface: Surface
    encoding: Encoding
    title: str
    wanted: Results

    @functools.cached_property
    def shares(self) -> dict[str, float]:
        """The shares of the pixels, see :meth:`dsr.methods.base.Surface.shares`."""
        return self.surface.shares(self.wanted.max_error / 100)

    @functools.cached_property
    def certain(self) -> tuple[Tensor | None, tuple[Assumption, ...]]:
        """The depth, (1, H, W), without pixels that are likely to be wrong, None if none is left; and notes."""
        from dsr.notes import Assumption

        limit, notes = self.wanted.max_error / 100, list[Assumption]()
        depth, share = self.surface.without_dubious(limit).depth, self.shares.get("dubious", 0.0)
        if share >= _WORTH_SAYING:
            text = f"{share:.1%} of the pixels, expected to be off by more than {limit:.1%} of their depth"
            notes.append(Assumption("left out of cloud and mesh", text))
        if bool(depth.isfinite().any()):
            return depth, tuple(notes)
        return None, (*notes, Assumption("no cloud and no mesh", "no pixel is left"))


class Output(NamedTuple):
    """What a part wrote: the names of the files, notes for the user, and how much of a shape."""

    files: Sequence[str]
    notes: Sequence[Assumption] = ()
    shape: Written | None = None


class Cost(NamedTuple):
    """What a part takes: bytes for each pixel of the photo, and seconds for a million of them, as measured on frames.

    A part that draws reduced pictures takes no more for more than some ``pixels``.
    """

    bytes: float
    seconds: float
    pixels: float = math.inf


class Part(NamedTuple):
    """A part of the results.

    Args:
        name: its name in the options.
        files: names of all files or folders that it may write.
        write: writes it into a picture's folder; None as the result stands for all ``files``.
        write_all: writes it of all frames together to a path.
        needs: parts of each frame that it is made of.
        cost: what it takes.
        dense: what it takes with a mesh of all pixels, if that is more.
        usual: whether it is written unless something else is asked for.
        large: whether ``--keep all`` writes it, too.
        shape: whether it takes as long as all the rest, and is written beside it.
        errors: whether it depends on the expected errors.
        poses: whether it needs a pose of each frame, where there are several.
        library: a module that it needs, its package, and the extra of dsr that installs it.

    """

    name: str
    files: tuple[str, ...]
    write: Callable[[Path, Result], Output | None] | None = None
    write_all: Callable[[Path, Sequence[Frame]], list[Path]] | None = None
    needs: tuple[str, ...] = ()
    cost: Cost = Cost(1.5, 0.5)
    dense: Cost | None = None
    usual: bool = True
    large: bool = False
    shape: bool = False
    errors: bool = False
    poses: bool = False
    library: tuple[str, str, str] | None = None

    def check_library(self) -> None:
        """Raise ValueError if the library is not installed."""
        if self.library is not None and importlib.util.find_spec(self.library[0]) is None:
            _, package, extra = self.library
            raise ValueError(f"--with {self.name}: expected the library {package}; {how_to_install(extra)}")


def _depth(folder: Path, result: Result) -> Output:
    """Write the depth in metres without loss, and in the output's encoding if that is another one."""
    import numpy as np

    from dsr.io.depth_files import write_depth_file
    from dsr.io.encoding import IN_METRES, encode
    from dsr.notes import Assumption

    depth, encoding = result.surface.depth, result.encoding
    write_depth_file(folder / METRES, depth[0].float().cpu().numpy())
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


def _renderings(folder: Path, result: Result) -> None:
    from dsr.io.exports import write_renderings

    write_renderings(folder / "renderings", result.surface.depth, result.picture.camera)


def _normals(folder: Path, result: Result) -> None:
    from dsr.io.exports import write_normals

    write_normals(folder / "normals.png", result.surface.depth, result.picture.camera)


def _cloud(folder: Path, result: Result) -> Output:
    from dsr.io.exports import write_cloud

    depth, notes = result.certain
    if depth is None:
        return Output((), notes)
    picture, most = result.picture, result.wanted.max_points
    filled = result.surface.filled
    shape = write_cloud(folder / "cloud.ply", picture.rgb, depth, picture.camera, most=most, filled=filled)
    return Output(("cloud.ply",), (*notes, *_fewer("cloud", "points", "--max-points", shape)), shape)


def _mesh(folder: Path, result: Result) -> Output:
    """Write the meshes that are asked for."""
    from dsr.geometry.mesh import ERROR_SHARE, FLATNESS
    from dsr.io.exports import write_mesh
    from dsr.notes import Assumption

    depth, notes = result.certain
    if depth is None:
        return Output((), notes)
    picture, wanted, filled = result.picture, result.wanted, result.surface.filled
    files = [PARTS[name].files[0] for name in ("mesh", "mesh_ply") if name in wanted.names]
    tolerance = None
    if wanted.keep != "all":
        tolerance = FLATNESS * depth
        if (error := result.surface.depth_error) is not None:
            tolerance = tolerance.maximum(ERROR_SHARE * error)
    paths = [folder / name for name in files]
    try:
        shape = write_mesh(
            paths, picture.rgb, depth, picture.camera, most=wanted.max_faces, tolerance=tolerance, filled=filled
        )
    except ValueError as error:
        return Output((), (*notes, Assumption("no mesh", str(error))))
    return Output(files, (*notes, *_fewer("mesh", "triangles", "--max-faces", shape)), shape)


def _mesh_ply(folder: Path, result: Result) -> Output:
    return Output(()) if "mesh" in result.wanted.names else _mesh(folder, result)


def _fewer(part: str, what: str, option: str, shape: Written) -> list[Assumption]:
    """Return a note on a shape that a limit has made smaller."""
    from dsr.io.exports import FLAT
    from dsr.notes import Assumption

    text = f"the {part} has fewer {what} than the depth map gives ({option})"
    return [Assumption(text, str(shape))] if shape.how not in ("", FLAT) else []


def _before_after(folder: Path, result: Result) -> None:
    from dsr.pictures.before_after import write_before_after

    picture, depth = result.picture, result.surface.depth
    path = folder / "before_after.png"
    write_before_after(path, picture.rgb, picture.depth_lr, depth, picture.camera, result.title)


def _confidence(folder: Path, result: Result) -> Output | None:
    import numpy as np

    from dsr.pictures.expected_errors import write_confidence
    from dsr.utils.files import replacing

    surface = result.surface
    if surface.depth_error is None or surface.angle_error is None:
        return Output(())
    write_confidence(folder / "confidence.png", surface.depth, surface.depth_error, surface.angle_error)
    with replacing(folder / ERRORS) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **surface.error_arrays())
    return None


def _filled(folder: Path, result: Result) -> Output | None:
    from dsr.io.exports import write_mask

    if result.surface.filled is None:
        return Output(())
    write_mask(folder / "filled.png", result.surface.filled)
    return None


def _input(folder: Path, result: Result) -> None:
    from dsr.io.exports import INPUT, write_input

    write_input(folder / INPUT, result.picture.rgb, result.picture.depth_lr)


def _rgbd(folder: Path, result: Result) -> Output:
    from dsr.io.open3d import write_rgbd
    from dsr.io.scene_files import RGBD

    notes = write_rgbd(folder / "rgbd", result.picture.rgb, result.surface.depth, result.picture.camera)
    return Output([f"rgbd/{name}" for name in RGBD], notes)


def _open3d(path: Path, frames: Sequence[Frame]) -> list[Path]:
    from dsr.io.open3d import write_open3d

    return write_open3d(path, frames)


def _nerfstudio(path: Path, frames: Sequence[Frame]) -> list[Path]:
    from dsr.io.scene_files import write_transforms

    return write_transforms(path, frames)


def _gaussian(path: Path, frames: Sequence[Frame]) -> list[Path]:
    from dsr.io.scene_files import write_splatting

    return write_splatting(path, frames)


def _rerun(path: Path, frames: Sequence[Frame]) -> list[Path]:
    from dsr.io.scene_files import write_rerun

    return write_rerun(path, frames)


_OF_DEPTH = ("depth", "rgbd")
PARTS: dict[str, Part] = {
    part.name: part
    for part in (
        Part("depth", (*(f"depth.{suffix}" for suffix in (*_SUFFIXES, "tif")), METRES), _depth,
              cost=Cost(2.0, 0.25)),
        Part("renderings", tuple(f"renderings/{light}.png" for light in LIGHT_NAMES), _renderings,
              cost=Cost(1.0, 0.4)),
        Part("normals", ("normals.png",), _normals, cost=Cost(0.8, 0.4)),
        Part("mesh", ("mesh.glb",), _mesh, shape=True, errors=True, cost=Cost(2.5, 0.6), dense=Cost(43, 1.5)),
        Part("before_after", ("before_after.png",), _before_after, cost=Cost(3.3, 2.5, 7.5e5)),
        Part("confidence", ("confidence.png", ERRORS), _confidence, errors=True, cost=Cost(2.3, 1.0)),
        Part("filled", ("filled.png",), _filled, cost=Cost(0.02, 0.02)),
        Part("input", ("input.npz",), _input, cost=Cost(0.8, 0.1, 6e5)),
        Part("mesh_ply", ("mesh.ply",), _mesh_ply, usual=False, large=True, shape=True, errors=True,
              cost=Cost(2.5, 0.2), dense=Cost(53, 1.0)),
        Part("cloud", ("cloud.ply",), _cloud, usual=False, large=True, shape=True, errors=True,
              cost=Cost(27.0, 1.4)),
        Part("rgbd", ("rgbd/color.png", "rgbd/depth.png", "rgbd/intrinsic.json"), _rgbd, usual=False),
        Part("open3d", ("open3d",), write_all=_open3d, needs=_OF_DEPTH, usual=False),
        Part("nerfstudio", ("transforms.json", "nerfstudio"), write_all=_nerfstudio, needs=_OF_DEPTH, usual=False,
             poses=True),
        Part("gaussian", ("gaussian",), write_all=_gaussian, needs=_OF_DEPTH, usual=False, poses=True),
        Part("rerun", ("scene.rrd",), write_all=_rerun, needs=_OF_DEPTH, usual=False,
             library=("rerun", "rerun-sdk", "rerun")),
    )
}  # fmt: skip
"""All parts by their names, in the order in which they are listed."""
_MORE = tuple(part.name for part in PARTS.values() if not part.usual)
FILES = tuple(name for part in PARTS.values() if part.write is not None for name in part.files)
"""All files that may be in the folder of a picture's results beside ``info.json``."""
EXPECTED_ERROR = Rule("a positive percentage of the depth", lambda percent: percent > 0)


def _words(text: str) -> tuple[str, ...]:
    """Return the words between commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


@dataclass(frozen=True, kw_only=True)
class Results(Options):
    """What is written, and where."""

    output: Path = option(..., "folder of the results", "OUT", flags="-o --output", recorded=False, writes="folder")
    format: str | None = option(
        None,
        f"of the depth: {', '.join(_SUFFIXES)} (the input's); mm: 16-bit PNG in millimetres, 0 in holes",
        "FORMAT",
        rule=one_of(FORMATS),
    )
    only: tuple[str, ...] | None = option(
        None, f"some of {','.join(PARTS)}", "PARTS", parse=_words, alone="parts", recorded=False
    )
    without: tuple[str, ...] = option((), "all but these", "PARTS", parse=_words, alone="parts", recorded=False)
    more: tuple[str, ...] = option(
        (), f"also these: {','.join(_MORE)}; see docs/results.md", "PARTS", flags="--with", parse=_words, recorded=False
    )
    keep: Literal["usual", "all"] = option(
        "usual", "all: also mesh.ply and cloud.ply, and a mesh of every pixel, ten times the size", recorded=False
    )
    max_error: float = option(
        2.0,
        "leave pixels out of cloud and mesh whose depth is expected to be off by more (default: 2)",
        "PERCENT",
        rule=EXPECTED_ERROR,
    )
    certain: bool = option(
        False, "make holes of these pixels in the depth, too, and in all that is made of it", recorded=False
    )
    purpose: Literal["robot"] | None = option(
        None,
        "robot: nothing is filled, dubious pixels are holes, depth.png is in 16-bit millimetres with 0 for holes, its "
        "expected errors are in confidence.npz (--fill none --certain --format mm)",
        "robot",
        flags="--for",
        recorded=False,
        presets={"robot": {"fill": "none", "certain": True, "format": "mm"}},
    )
    max_faces: int = option(
        MOST_FACES,
        f"simplify the mesh beyond N triangles (default: {MOST_FACES // 10**6} million)",
        "N",
        rule=at_least(100),
    )
    max_points: int = option(
        MOST_POINTS,
        f"thin the cloud beyond N points (default: {MOST_POINTS // 10**6} million)",
        "N",
        rule=at_least(100),
    )
    overwrite: bool = option(False, "redo existing results, replace other ones", recorded=False)
    dry_run: bool = option(False, "say what would be done, and how long it takes", recorded=False)

    def __post_init__(self) -> None:
        """Check the values, and that there is something to write."""
        super().__post_init__()
        for name in (*(self.only or ()), *self.without, *self.more):
            if name not in PARTS:
                known = ", ".join(PARTS)
                raise ValueError(f"--only, --with, --without: expected some of {known}, got {name!r}")
        if not self.names:
            raise ValueError("--only, --without: expected something to be left to write, got nothing")
        for part in self.of_all:
            part.check_library()

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parts that are asked for, in the table's order."""
        kept = (part for part in PARTS.values() if part.usual or (part.large and self.keep == "all"))
        usual = tuple(part.name for part in kept if part.name not in self.without) if self.only is None else self.only
        return tuple(name for name in PARTS if name in (*usual, *self.more))

    @functools.cached_property
    def of_frame(self) -> tuple[Part, ...]:
        """Parts that are written for each frame, including those that other parts need."""
        needed = {need for name in self.names for need in PARTS[name].needs}
        return tuple(part for part in PARTS.values() if part.write and part.name in {*self.names, *needed})

    @functools.cached_property
    def of_all(self) -> tuple[Part, ...]:
        """Parts of all frames together."""
        return tuple(PARTS[name] for name in self.names if PARTS[name].write_all)

    def cost(self, pixels: int) -> tuple[float, float]:
        """Return about how many bytes the results of a frame take, and how many seconds it takes to write them."""
        each = [(self.keep == "all" and part.dense) or part.cost for part in (*self.of_frame, *self.of_all)]
        sizes = [min(pixels, cost.pixels) for cost in each]
        total = sum(cost.bytes * size for cost, size in zip(each, sizes, strict=True))
        return total, sum(cost.seconds * size for cost, size in zip(each, sizes, strict=True)) / 1e6


def write_parts(folder: Path, result: Result) -> dict[str, Output]:
    """Write the parts of a picture's result, and return a description of each.

    Args:
        folder: the result's folder, created if it is missing.
        result: the result.

    """
    parts = result.wanted.of_frame
    with ThreadPoolExecutor(1) as beside:  # shapes take as long as all the rest
        shapes = {part.name: beside.submit(_write, part, folder, result) for part in parts if part.shape}
        others = {part.name: _write(part, folder, result) for part in parts if not part.shape}
        written = others | {name: shape.result() for name, shape in shapes.items()}
    return {part.name: written[part.name] for part in parts}


def _write(part: Part, folder: Path, result: Result) -> Output:
    """Write a part."""
    output = part.write(folder, result) if part.write is not None else None
    return Output(part.files) if output is None else output


def as_stored(surface: Surface) -> Surface:
    """Return a surface with expected errors that are stored to the bit, so that parts added later are the same."""
    import torch

    def rounded(values: Tensor | None) -> Tensor | None:
        if values is None:
            return None
        mantissa, exponent = torch.frexp(values.float())
        return torch.ldexp((_ERROR_STEPS * mantissa).round() / _ERROR_STEPS, exponent)

    rough = surface._replace(depth_error=rounded(surface.depth_error), angle_error=rounded(surface.angle_error))
    stored = {name: torch.from_numpy(values)[None].float() for name, values in rough.error_arrays().items()}
    return surface._replace(depth_error=stored.get("depth_error"), angle_error=stored.get("angle_error"))
