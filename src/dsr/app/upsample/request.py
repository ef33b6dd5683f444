"""The request of a user of ``dsr upsample``, and the settings and inputs that a result depends on."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsr.app.upsample.limits import LARGEST_ERROR, Limits
from dsr.app.upsample.parts import FORMATS, MORE_PARTS, PARTS, SCENE_PARTS, check_libraries
from dsr.inference.options import DEFAULT, USUAL_SCALE, WIDEST, Fill
from dsr.io.reading import Reading
from dsr.io.shards import Shard
from dsr.utils.config_files import config_directories, list_choices
from dsr.utils.hashing import file_hash, hash_outside_code
from dsr.utils.limits import MOST_FACES, MOST_POINTS

if TYPE_CHECKING:
    from dsr.io.frames import Record, Source
    from dsr.io.pairs import Pair

SHORTCUTS = ("noise", "smooth")
"""Settings of the method that have an option of their own."""


@dataclass(frozen=True)
class UpsampleRequest:
    """What to upsample, how, and which results to write.

    Args:
        output: the folder of the results.
        folders: the folders that are searched for pairs.
        rgb, depth, mask: files, or one folder each of the first two.
        confidence: files of confidence maps, or a folder of them.
        reading: how to read the files.
        method, settings, directories, scale, device, fill, max_hole, working_size, sensor: see
            :func:`dsr.inference.engine.upsample_surface`.
        max_error: expected relative error of the depth from which a pixel is left out of cloud and mesh.
        max_faces: triangles from which a mesh is simplified.
        max_points: points from which a cloud is thinned.
        depth_format: the result's format; None for the input's.
        shard: the block of the frames to work on; None for all.
        workers: number of processes that work at a time.
        register: whether to move each depth map to the photo's edges.
        neighbours: number of frames beside itself that vote on each frame's depth.
        poses: file of the frames' poses; None for those of the capture.
        parts: what to write, some of :data:`dsr.app.upsample.parts.PARTS` and ``MORE_PARTS``.
        overwrite: whether to replace existing results.
        dry_run: whether to show only what would be done.

    """

    output: Path
    folders: tuple[Path, ...] = ()
    rgb: tuple[Path, ...] = ()
    depth: tuple[Path, ...] = ()
    mask: tuple[Path, ...] = ()
    confidence: tuple[Path, ...] = ()
    reading: Reading = field(default_factory=Reading)
    method: str = DEFAULT
    settings: Mapping[str, Any] = field(default_factory=dict)
    directories: tuple[Path, ...] = ()
    scale: int | None = None
    device: str = "auto"
    fill: Fill = "small"
    max_hole: float = WIDEST
    working_size: int | None = None
    sensor: str = "auto"
    max_error: float = LARGEST_ERROR
    max_faces: int = MOST_FACES
    max_points: int = MOST_POINTS
    depth_format: str | None = None
    shard: Shard | None = None
    workers: int = 1
    register: bool = False
    neighbours: int = 0
    poses: Path | None = None
    parts: tuple[str, ...] = PARTS
    overwrite: bool = False
    dry_run: bool = False

    def __post_init__(self) -> None:
        """Check everything that does not depend on the files."""
        for name, value, choices in (
            ("--method", self.method, list_choices("method", config_directories(self.directories))),
            ("--format", self.depth_format, FORMATS),
        ):
            if value is not None and value not in choices:
                raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
        for part in self.parts:
            if part not in (*PARTS, *MORE_PARTS):
                known = ", ".join((*PARTS, *MORE_PARTS))
                raise ValueError(f"--only, --with, --without: expected some of {known}, got {part!r}")
        if not self.parts:
            raise ValueError("--only, --without: expected something to be left to write, got nothing")
        if bool(self.folders) == bool(self.rgb or self.depth) or bool(self.rgb) != bool(self.depth):
            raise ValueError("expected --rgb and --depth, or folders that hold both")
        if self.folders and self.mask:
            raise ValueError("--mask: expected --rgb and --depth with it, got folders")
        if self.confidence and self.reading.min_confidence is None:
            raise ValueError(
                "--confidence: expected --min-confidence with it, the fraction below which pixels are holes"
            )
        if not 0 < self.max_hole < math.inf:
            raise ValueError(f"--max-hole: expected a positive number of degrees, got {self.max_hole:g}")
        self.limits.check()
        check_libraries(self.scene_parts)
        self._check_frames()
        self._check_method()
        self._check_sensor()

    @property
    def limits(self) -> Limits:
        """What cloud and mesh leave out."""
        return Limits(self.max_error, self.max_faces, self.max_points)

    @property
    def scene_parts(self) -> tuple[str, ...]:
        """Parts of all frames together."""
        return tuple(part for part in self.parts if part in SCENE_PARTS)

    @functools.cached_property
    def wanted(self) -> tuple[str, ...]:
        """Parts of each frame; those of all frames are made of its depth and ``rgbd``."""
        needed = ("depth", "rgbd") if self.scene_parts else ()
        return tuple(dict.fromkeys((*(part for part in self.parts if part not in SCENE_PARTS), *needed)))

    def _check_frames(self) -> None:
        """Check what is said about a sequence."""
        if self.workers < 1:
            raise ValueError(f"--workers: expected 1 or more, got {self.workers}")
        if self.neighbours < 0:
            raise ValueError(f"--neighbours: expected 0 or a positive number of frames, got {self.neighbours}")
        if self.poses is not None and len(self.folders) > 1:
            raise ValueError(f"--poses: expected the frames of one folder, got {len(self.folders)} folders")

    def _check_sensor(self) -> None:
        """Check the name of the sensor."""
        if self.sensor in ("auto", "none"):
            return
        from dsr.degradation.sensors import sensor_named  # noqa: PLC0415 - other values are refused without torch

        try:
            sensor_named(self.sensor)
        except ValueError as error:
            raise ValueError(f"--{error}") from error

    def _check_method(self) -> None:
        """Check that the method accepts the settings."""
        if not self.settings and self.working_size is None:
            return
        from dsr.inference import (  # noqa: PLC0415 - other values are refused without torch
            MethodChoice,
            check_settings,
            check_working_size,
        )

        choice = MethodChoice(self.method, self.settings, self.directories)
        try:
            check_working_size(choice, self.scale, self.working_size)
        except ValueError as error:
            raise ValueError(f"--working-size{str(error).removeprefix('working_size')}") from error
        try:
            check_settings(choice)
        except ValueError as error:
            key = str(error).partition(":")[0]
            option = f"--{error}" if key in SHORTCUTS else f"--set {error}"
            raise ValueError(option if key in self.settings else str(error)) from error


def settings_of(request: UpsampleRequest) -> dict[str, Any]:
    """Return the settings that a result depends on, as values for JSON."""
    reading = asdict(request.reading)
    choice = reading.pop("camera")
    rig = reading.pop("rig")
    return {
        "method": request.method,
        "scale": request.scale,
        "fill": request.fill,
        "max_hole": request.max_hole,
        **({} if request.working_size is None else {"working_size": request.working_size}),
        **({} if request.sensor == "auto" else {"sensor": request.sensor}),
        "max_error": request.max_error,
        "format": request.depth_format,
        **reading,
        "fov": choice["fov"],
        "intrinsics": None if choice["intrinsics"] is None else list(choice["intrinsics"]),
        **({"max_faces": request.max_faces} if request.max_faces != MOST_FACES else {}),
        **({"max_points": request.max_points} if request.max_points != MOST_POINTS else {}),
        **({"registered_by": "extrinsics"} if rig is not None else {}),
        **({"register": True} if request.register else {}),
        **({"neighbours": request.neighbours} if request.neighbours else {}),
        **({"set": dict(request.settings)} if request.settings else {}),
        **({"code": code} if (code := hash_outside_code(_targets(request))) else {}),
    }


def _targets(request: UpsampleRequest) -> list[str]:
    """Return the dotted paths of the code that the method's file names."""
    from dsr.methods.registry import read_method, target_paths  # noqa: PLC0415 - see _check_method

    return list(
        target_paths(read_method(request.method, USUAL_SCALE, directories=request.directories), request.directories)
    )


def files_of(pair: Pair, reading: Reading) -> dict[str, Path]:
    """Return the files that a result depends on."""
    given = reading.camera.fov is not None or reading.camera.intrinsics is not None
    camera = reading.camera.file or (None if given else pair.camera)
    found = {"rgb": pair.rgb, "depth": pair.depth, "camera": camera, "mask": pair.mask}
    if pair.confidence is not None and reading.min_confidence is not None:
        found["confidence"] = pair.confidence.path
    if reading.rig is not None:
        found |= {"depth_camera": reading.rig.camera, "extrinsics": reading.rig.extrinsics}
    return {name: path for name, path in found.items() if path is not None} | {
        name: source.file for name, source in _sources(pair, reading).items()
    }


def inputs_of(pair: Pair, reading: Reading) -> dict[str, Record]:
    """Return the inputs and their hashes, as values for JSON."""
    inputs: dict[str, Record] = {}
    sources = _sources(pair, reading)
    for name, path in files_of(pair, reading).items():
        if name in sources:
            inputs[name] = sources[name].record()
            continue
        if not path.is_file():
            raise ValueError(f"{path}: there is no such file")
        inputs[name] = {"file": path.name, "sha256": file_hash(path)}
    return inputs if pair.capture is None else {**inputs, "capture": pair.capture.record()}


def inputs_with_neighbours(request: UpsampleRequest, pair: Pair, neighbours: Sequence[Pair]) -> dict[str, Record]:
    """Return the inputs of a frame, its neighbours and its pose, and their hashes, as values for JSON."""
    inputs = inputs_of(pair, request.reading)
    for number, other in enumerate(neighbours, 1):
        inputs |= {f"neighbour_{number}_{name}": each for name, each in inputs_of(other, request.reading).items()
                   if name not in ("rgb", "depth_camera", "extrinsics")}  # fmt: skip
    if request.poses is not None:
        inputs["poses"] = {"file": request.poses.name, "sha256": file_hash(request.poses)}
    return inputs


def _sources(pair: Pair, reading: Reading) -> dict[str, Source]:
    """Return the inputs of a capture that are no files of their own."""
    found: dict[str, Source | None] = {}
    if pair.capture is not None:
        found = {"rgb": pair.capture.photo, "depth": pair.capture.depth}
    if pair.confidence is not None and reading.min_confidence is not None:
        found["confidence"] = pair.confidence.source
    return {name: source for name, source in found.items() if source is not None}
