"""The table of all parts of the results of ``dsr upsample``, and the options that choose among them."""

import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from dsr.geometry.lights import LIGHT_NAMES
from dsr.utils.guards import MOST_FACES, MOST_POINTS
from dsr.utils.options import Options, Rule, at_least, one_of, option
from dsr.utils.versions import how_to_install

_SUFFIXES = ("png", "tiff", "npy", "npz", "pfm", "exr")
# of the depth: suffixes, of which png means whole millimetres where the input is something else; ``mm`` always is a PNG
# of 16 bits in whole millimetres, 0 in holes
FORMATS = (*_SUFFIXES, "mm")
METRES = "depth_metres.tiff"  # depth to the bit, stored as :data:`dsr.io.depth_files.IN_METRES` says
ERRORS = "confidence.npz"


class Part(NamedTuple):
    """A part of the results; :mod:`dsr.app.upsample.outputs` has the functions that write them."""

    name: str  # in the options
    files: tuple[str, ...]  # all files or folders that it may write
    of_all: bool = False  # whether it is written of all frames together, of their depth and rgbd
    usual: bool = True  # whether it is written unless something else is asked for
    large: bool = False  # whether ``--keep all`` writes it, too
    shape: bool = False  # whether it takes as long as all the rest, and is written beside it
    errors: bool = False  # whether it depends on the expected errors
    poses: bool = False  # whether it needs a pose of each frame, where there are several
    library: str = ""  # module that it needs, and the extra that installs it


# by their names, in the order in which they are listed
PARTS: dict[str, Part] = {
    part.name: part
    for part in (
        Part("depth", (*(f"depth.{suffix}" for suffix in (*_SUFFIXES, "tif")), METRES)),
        Part("renderings", tuple(f"renderings/{light}.png" for light in LIGHT_NAMES)),
        Part("normals", ("normals.png",)),
        Part("mesh", ("mesh.glb",), shape=True, errors=True),
        Part("before_after", ("before_after.png",)),
        Part("confidence", ("confidence.png", ERRORS), errors=True),
        Part("filled", ("filled.png",)),
        Part("input", ("input.npz",)),
        Part("mesh_ply", ("mesh.ply",), usual=False, large=True, shape=True, errors=True),
        Part("cloud", ("cloud.ply",), usual=False, large=True, shape=True, errors=True),
        Part("rgbd", ("rgbd/color.png", "rgbd/depth.png", "rgbd/intrinsic.json"), usual=False),
        Part("stereo", ("stereo_2x1.jpg",), usual=False),
        Part("rgbd_picture", ("rgbd_2x1.png",), usual=False),
        Part("open3d", ("open3d",), of_all=True, usual=False),
        Part("nerfstudio", ("transforms.json", "nerfstudio", "normals_from_pretrain"), of_all=True, usual=False,
             poses=True),
        Part("gaussian", ("gaussian",), of_all=True, usual=False, poses=True),
        Part("rerun", ("scene.rrd",), of_all=True, usual=False, library="rerun"),
    )
}  # fmt: skip
_MORE = tuple(part.name for part in PARTS.values() if not part.usual)
# all files that may be in the folder of a picture's results beside info.json
FILES = tuple(name for part in PARTS.values() if not part.of_all for name in part.files)
EXPECTED_ERROR = Rule("a positive percentage of the depth", lambda percent: percent > 0)
# what the options of names of parts have in common
_NAMES: dict[str, Any] = {
    "metavar": "PARTS",
    "parse": lambda text: tuple(word.strip() for word in text.split(",") if word.strip()),
    "rule": Rule(f"some of {', '.join(PARTS)}", PARTS.__contains__, each=True, known=PARTS),
    "recorded": False,
}


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
    only: tuple[str, ...] | None = option(None, f"some of {','.join(PARTS)}", alone="parts", **_NAMES)
    without: tuple[str, ...] = option((), "all but these", alone="parts", **_NAMES)
    more: tuple[str, ...] = option((), f"also these: {','.join(_MORE)}; see docs/results.md", flags="--with", **_NAMES)
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
    dry_run: bool = option(False, "say what would be done and assumed", recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.names:
            raise ValueError("--only, --without: expected something to be left to write, got nothing")
        for part in self.of_all:
            if part.library and importlib.util.find_spec(part.library) is None:
                cure = how_to_install(part.library)
                raise ValueError(f"--with {part.name}: expected the library {part.library}; {cure}")

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parts that are asked for, in the table's order."""
        kept = (part for part in PARTS.values() if part.usual or (part.large and self.keep == "all"))
        usual = tuple(part.name for part in kept if part.name not in self.without) if self.only is None else self.only
        return tuple(name for name in PARTS if name in (*usual, *self.more))

    @functools.cached_property
    def of_frame(self) -> tuple[Part, ...]:
        """Parts that are written for each frame, including those that other parts need."""
        needed = {*self.names, "depth", "rgbd"} if self.of_all else set(self.names)
        return tuple(part for part in PARTS.values() if not part.of_all and part.name in needed)

    @functools.cached_property
    def of_all(self) -> tuple[Part, ...]:
        """Parts of all frames together."""
        return tuple(PARTS[name] for name in self.names if PARTS[name].of_all)
