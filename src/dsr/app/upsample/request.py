"""The request of a user of ``dsr upsample``, and the settings and inputs that a result depends on."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dsr.app.requests import check_method
from dsr.app.upsample.parts import Results
from dsr.inference import DEFAULT, WIDEST, Fill
from dsr.io.reading import Reading, Shard, parse_shard
from dsr.utils.options import OptionError, Options, Rule, at_least, group, option, positive, recorded
from dsr.utils.versions import file_hash, hash_outside_code

if TYPE_CHECKING:
    from dsr.inference.any_ratio import AnyRatio
    from dsr.io.frames import Record, Source
    from dsr.io.pairs import Pair

SHORTCUTS = ("noise", "smooth")  # arguments of the method that have an option of their own


def _parse_settings(texts: list[str]) -> tuple[tuple[str, Any], ...]:
    """Return arguments of a method, of which each text is ``KEY=VALUE``, with values read as YAML."""
    from omegaconf import OmegaConf  # noqa: PLC0415 - few commands need OmegaConf
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415
    from yaml import YAMLError  # noqa: PLC0415

    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.isidentifier():
            raise OptionError(text, "expected KEY=VALUE")
        try:
            settings |= OmegaConf.to_container(OmegaConf.from_dotlist([f"{key}={value}"]), resolve=True)  # type: ignore[arg-type]
        except (YAMLError, OmegaConfBaseException) as error:
            raise OptionError(key, f"expected a value as in a YAML file, got {value!r}") from error
    return tuple(settings.items())


@dataclass(frozen=True, kw_only=True)
class FrameChoice(Options):
    """Which frames to work on, and how many at a time."""

    folders: tuple[Path, ...] = option(
        (), "folders of photos and depth maps, or captures", "FOLDER", flags="folders", recorded=False
    )
    rgb: tuple[Path, ...] = option((), "photos, or a folder of them", "PHOTO", recorded=False)
    depth: tuple[Path, ...] = option((), "depth maps, one for each photo", "MAP", recorded=False)
    mask: tuple[Path, ...] = option((), "pictures, 0 where depth is missing", "MASK", recorded=False)
    confidence: tuple[Path, ...] = option((), "confidence maps, or a folder of them", "MAP", recorded=False)
    shard: Shard | None = option(
        None,
        "only the K-th of N blocks of the frames, for an array job; see docs/clusters.md",
        "K/N",
        parse=parse_shard,
        recorded=False,
    )
    neighbours: int = option(
        0,
        "frames of a folder that vote on each frame's depth, 4 for two on either side; needs poses",
        "N",
        rule=Rule("0 or a positive number of frames", lambda count: count >= 0),
    )
    steady: bool = option(False, "average successive results of a camera that stands still", recorded=False)
    poses: Path | None = option(
        None,
        "camera poses: TUM's format, 4 x 4 matrices, or a model of COLMAP with its cameras",
        "FILE",
        recorded=False,
    )
    workers: int = option(
        1, "pictures at a time, each in its own process (default: 1)", "N", rule=at_least(1), recorded=False
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if bool(self.folders) == bool(self.rgb or self.depth) or bool(self.rgb) != bool(self.depth):
            raise ValueError("expected --rgb and --depth, or folders that hold both")
        if self.folders and self.mask:
            raise OptionError("mask", "expected --rgb and --depth with it, got folders")
        if self.steady and (self.workers > 1 or self.shard is not None):
            raise OptionError("steady", "expected one process for all frames, got --workers or --shard")
        if self.poses is not None and len(self.folders) > 1:
            raise OptionError("poses", f"expected the frames of one folder, got {len(self.folders)} folders")

    @functools.cached_property
    def model(self) -> Path | None:
        """The images of a model of COLMAP, whose poses, cameras and lenses the frames have; or None."""
        from dsr.io.captures.colmap import model_file  # noqa: PLC0415 - few commands have poses

        return None if self.poses is None else model_file(self.poses)

    @property
    def trajectory(self) -> Path | None:
        """The file of poses alone, or None."""
        return self.poses if self.model is None else None


@dataclass(frozen=True, kw_only=True)
class Upsampling(Options):
    """The method, and how it works; see :func:`dsr.inference.upsampler`."""

    method: str = option(
        DEFAULT, "facets (default), for clean and noisy depth; or another: tgv, guided_filter, dip_v, ...", "NAME"
    )
    noise: float | None = option(
        None, "standard deviation of the depth map's noise (default: estimated)", "METRES", recorded=False
    )
    smooth: float | None = option(
        None, "0 keeps what may be noise, 1 is neutral, 2 smooths more", "0..2", recorded=False
    )
    settings: tuple[tuple[str, Any], ...] = option(
        (),
        "an argument of the method, as in its file in conf/method: data_weight=30; may be repeated",
        "KEY=VALUE",
        flags="--set",
        parse=_parse_settings,
        repeated=True,
        recorded=False,
    )
    directories: tuple[Path, ...] = option(
        (),
        "a folder with a method/ of your own YAML files; may be repeated",
        "DIR",
        flags="--config-dir",
        repeated=True,
        recorded=False,
    )
    scale: int | None = option(None, "upsampling factor (default: from the sizes)", "N")
    device: str = option("auto", "auto (default), cpu, cuda, cuda:1, ...", "DEVICE", recorded=False)
    fill: Fill = option("small", "which of the input's holes are filled")
    max_hole: float = option(
        WIDEST,
        f"width of the widest hole that --fill small fills, degrees of view (default: {WIDEST:g})",
        "DEGREES",
        rule=positive("number of degrees"),
    )
    size: Literal["auto", "1", "2", "4", "8", "16"] = option(
        "auto",
        "divide the map's size by this before facets works on it; auto: by its noise",
        flags="--working-size",
    )
    sensor: str = option(
        "auto",
        "the camera that measured the depth, such as 'RealSense D435'; auto: recognised by depth values or files",
        "auto|none|NAME",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_method(self.method, self.directories)
        for name, value in self.settings:
            if name in SHORTCUTS and getattr(self, name) is not None:
                raise OptionError(name, f"expected it once, got --set {name}={value}, too")

    @functools.cached_property
    def arguments(self) -> dict[str, Any]:
        """Arguments of the method that are given."""
        given = {name: getattr(self, name) for name in SHORTCUTS}
        return dict(self.settings) | {name: value for name, value in given.items() if value is not None}

    def check_slowly(self) -> None:
        """Run the checks that take seconds: that the method accepts its arguments, and the name of the sensor."""
        if self.arguments or self.size != "auto":
            run = replace(self, device="cpu").upsampler
            try:
                run.check_working_size()
                run.first()
            except ValueError as error:
                key = str(error).partition(":")[0]
                flags = {name: f"--set {name}" for name in self.arguments}
                flags |= {"working_size": "--working-size", "noise": "--noise", "smooth": "--smooth"}
                raise ValueError(f"{flags.get(key, key)}{str(error).removeprefix(key)}") from error
        if self.sensor not in ("auto", "none"):
            from dsr.degradation.sensors import sensor_named  # noqa: PLC0415 - other values are refused without torch

            try:
                sensor_named(self.sensor)
            except ValueError as error:
                raise ValueError(f"--{error}") from error

    @functools.cached_property
    def upsampler(self) -> AnyRatio:
        """The method, which loads its weights once; a ValueError if there is no such device."""
        from dsr.inference.any_ratio import upsampler  # noqa: PLC0415 - other values are refused without torch

        return upsampler(
            self.method,
            self.scale,
            settings=self.arguments,
            directories=self.directories,
            device=self.device,
            fill=self.fill,
            max_hole=self.max_hole,
            working_size=None if self.size == "auto" else int(self.size),
        )


@dataclass(frozen=True, kw_only=True)
class UpsampleRequest(Options):
    """Upsample the depth maps of your own photos to the photos' resolution.

    Give --rgb and --depth, or folders that hold both. The depth map has to be registered to the photo: the same view,
    the same field of view, any size up to the photo's. What is not given is read from the files or assumed, and
    reported.
    """

    frames: FrameChoice = group(FrameChoice, "what to work on")
    reading: Reading = group(
        Reading, "how to read the files (if not given: read from the files, or assumed and reported)"
    )
    upsampling: Upsampling = group(Upsampling, "method")
    results: Results = group(Results, "what is written")

    def __post_init__(self) -> None:
        if self.frames.confidence and self.reading.min_confidence is None:
            expected = "expected --min-confidence with it, the fraction below which pixels are holes"
            raise OptionError("confidence", expected)
        if self.frames.steady and not {"depth", "confidence"} <= {part.name for part in self.results.of_frame}:
            raise OptionError("steady", "expected depth and confidence among the parts, which the next frame needs")
        self.upsampling.check_slowly()

    @functools.cached_property
    def settings(self) -> Mapping[str, Any]:
        """The settings that a result depends on, as values for JSON; the method's files are read for them."""
        from dsr.methods.recipe import read_recipe  # noqa: PLC0415 - it imports torch

        recipe = read_recipe(self.upsampling.method, None, self.upsampling.directories)
        return {
            **recorded(self),
            "max_error": self.results.max_error / 100,
            **({"certain": True} if self.results.certain else {}),
            **({"steady": True} if self.frames.steady else {}),
            "registered_by": None if self.reading.rig is None else "extrinsics",
            "set": self.upsampling.arguments,
            "code": hash_outside_code(list(recipe.targets())),
        }


def inputs_of(pair: Pair, reading: Reading) -> dict[str, Path | Source]:
    """Return what a result depends on: files, or in captures what is no file of its own."""
    given = reading.camera.fov is not None or reading.camera.intrinsics is not None
    camera = reading.camera.file or (None if given else pair.camera)
    found: dict[str, Path | Source | None] = {"rgb": pair.rgb, "depth": pair.depth, "camera": camera, "mask": pair.mask}
    if pair.confidence is not None and reading.min_confidence is not None:
        found["confidence"] = pair.confidence.source or pair.confidence.path
    if reading.rig is not None:
        found |= {"depth_camera": reading.rig.camera, "extrinsics": reading.rig.extrinsics}
    if pair.capture is not None:
        found["rgb"] = pair.capture.photo or pair.rgb
        found["depth"] = pair.capture.depth or pair.depth
    return {name: each for name, each in found.items() if each is not None}


def _records_of(pair: Pair, reading: Reading) -> dict[str, Record]:
    """Return the names and hashes of :func:`inputs_of`."""
    inputs: dict[str, Record] = {}
    for name, each in inputs_of(pair, reading).items():
        if not isinstance(each, Path):
            inputs[name] = each.record()
        elif each.is_file():
            inputs[name] = {"file": each.name, "sha256": file_hash(each)}
        else:
            raise ValueError(f"{each}: there is no such file")
    return inputs if pair.capture is None else {**inputs, "capture": pair.capture.record()}


def inputs_with_neighbours(request: UpsampleRequest, pair: Pair, neighbours: Sequence[Pair]) -> dict[str, Record]:
    """Return the inputs of a frame, its neighbours and its pose, and their hashes, as values for JSON."""
    inputs = _records_of(pair, request.reading)
    for number, other in enumerate(neighbours, 1):
        inputs |= {f"neighbour_{number}_{name}": each for name, each in _records_of(other, request.reading).items()
                   if name not in ("rgb", "depth_camera", "extrinsics")}  # fmt: skip
    poses = request.frames.model or request.frames.poses
    if poses is not None:
        inputs["poses"] = {"file": poses.name, "sha256": file_hash(poses)}
    return inputs
