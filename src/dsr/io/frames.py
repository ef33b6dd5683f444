"""Frames of captures: where an app keeps photos, depth and confidence maps, and what it says about the camera.

A reader in :mod:`dsr.io.captures` makes a :class:`~dsr.io.pairs.Pair` of each frame. What is known when a recording is
opened is stated in its :class:`Geometry`; what is in a file of each frame is read with the frame.
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, ParamSpec

import numpy as np

from dsr.geometry.camera import Camera, Lens
from dsr.geometry.poses import Matrix
from dsr.io.depth_files import DEPTH_SUFFIXES
from dsr.io.images import Size, read_array
from dsr.notes import Assumption
from dsr.utils.guards import expect_size, naming, pixels_beside
from dsr.utils.versions import hash_once

Record = dict[str, str | int]  # identifies an input in info.json: name, SHA-256, and a frame's number if it has one
HIGHEST_LEVEL = 2  # of ARKit's confidence: 0 (low), 1 (medium) and 2 (high)
SLACK = 0.002  # fractions count as equal within this: 127 of 255 is a half
CONFIDENCE_SUFFIXES = (*DEPTH_SUFFIXES, ".bmp")
UPS = ("", "y", "z")  # axes of a capture's world that point up; "" where it does not say
_Arguments = ParamSpec("_Arguments")


@dataclass(frozen=True)
class Source(ABC):
    """A photo or a map inside a file, such as a frame of a video; other processes get it pickled and read it anew."""

    file: Path
    name: str  # within the file

    @abstractmethod
    def read(self) -> np.ndarray:
        """Return the pixels: (H, W, 3) uint8 RGB of a photo, (h, w) stored values of a map."""

    def record(self) -> Record:
        """Return what identifies the content: where it is, and a hash of the file."""
        return {"file": f"{self.file.name}/{self.name}", "sha256": hash_once(self.file)}


@dataclass(frozen=True)
class Part(Source):
    """Bytes of a file that ``fetch`` returns, and of which ``decode`` makes pixels; both can be pickled."""

    fetch: Callable[[], bytes]
    decode: Callable[[bytes], np.ndarray]

    def read(self) -> np.ndarray:
        """Return the pixels."""
        content = self.fetch()
        with naming(self.file / self.name):
            return self.decode(content)

    def record(self) -> Record:
        """Return the name and a hash of the bytes."""
        return {"file": f"{self.file.name}/{self.name}", "sha256": hashlib.sha256(self.fetch()).hexdigest()}


class Rig(NamedTuple):
    """A depth camera, of the depth map's pixels, the transform from it to the photo camera in metres, and its lens."""

    camera: Camera
    transform: Matrix
    lens: Lens | None = None


class Geometry(NamedTuple):
    """Cameras, lenses and poses of a frame as its capture states them; None where it does not."""

    camera: Camera | None = None  # of a size of its own, which is scaled to the photo's
    pose: np.ndarray | None = None  # camera (x right, y down, z forward) to the capture's world, (4, 4), rigid, metres
    assumptions: tuple[Assumption, ...] = ()
    lens: Lens | None = None  # of the photo, and of a depth map without a rig, which lies in the photo's pixels
    rig: Rig | None = None  # the depth map's camera, of a size of its own as well; None if it is in the photo's view
    up: str = ""  # the axis of the world that points up, one of UPS
    damage: str = ""  # what is wrong with the capture's cameras, which does not matter if others are given
    apart: str = ""  # why a depth map that is not in the photo's view is of no use without a given rig


def stated(read: Callable[_Arguments, Geometry], *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Geometry:
    """Return what a reader finds stated, or what is damaged of it: that ends nothing if cameras are given."""
    try:
        return read(*args, **kwargs)
    except ValueError as error:
        return Geometry(damage=str(error))


def accuracy_notes(*, absolute: bool, stated: bool) -> list[Assumption]:
    """Return a note on depth that a photo's file does not state to be absolute, if it states anything."""
    known = "is relative, as the file states" if stated else "may be relative, the file does not say"
    return [] if absolute else [Assumption(f"the depth {known}: sizes and distances mean little")]


@dataclass(frozen=True)
class CaptureFrame:
    """What a capture states of one frame."""

    app: str  # or data set, for messages
    geometry: Geometry | Callable[[Size], Geometry]  # or for a photo of (height, width), if it depends on it or a file
    description: Path  # file that describes camera and pose
    content: bytes  # the part of it that this frame depends on, which identifies it in info.json
    photo: Source | None = None  # if it is no file of its own
    depth: Source | None = None  # likewise
    apart: bool = False  # whether depth may be of a camera beside the photo's, and of no use without that

    def geometry_of(self, size: Size) -> Geometry:
        """Return cameras and pose for a photo of (height, width), of which some may be damaged."""
        geometry = self.geometry
        return geometry if isinstance(geometry, Geometry) else stated(geometry, size)

    def record(self) -> Record:
        """Return what identifies the description of the camera."""
        return {"file": self.description.name, "sha256": hashlib.sha256(self.content).hexdigest()}


@dataclass(frozen=True)
class ConfidenceMap:
    """Where a confidence map is, and the value that stands for full confidence in it, 1 for fractions."""

    path: Path
    highest: float
    source: Source | None = None

    def read(self, size: Size) -> np.ndarray:
        """Return the confidence of a depth map of (h, w), float32 from 0 to 1."""
        values = _read_values(self.path, pixels_beside(*size)) if self.source is None else self.source.read()
        expect_size(f"{self.path}: expected confidence of the depth map's", values, size)
        outside = values[~((values >= 0) & (values <= self.highest))]
        if outside.size:
            raise ValueError(f"{self.path}: expected confidence from 0 to {self.highest:g}, got {outside[0]}")
        return values.astype(np.float32) / np.float32(self.highest)


def find_highest(paths: Sequence[Path]) -> float:
    """Return the value that stands for full confidence in maps that belong together.

    Floats are fractions. Whole numbers are levels from 0 to 2 if no map has a larger one; else they go up to 255, or up
    to 65535 in maps of 16 bits that have more than 255. Damaged maps are reported with their frames.
    """
    highest = float(HIGHEST_LEVEL)
    for path in paths:
        try:
            values = _read_values(path)
        except ValueError:
            continue
        if values.dtype.kind in "fb":
            return 1.0
        if values.max() > 255:
            return 65535.0
        if values.max() > HIGHEST_LEVEL:
            highest = 255.0
        if highest == 255 and values.dtype.itemsize == 1:
            break
    return highest


def _read_values(path: Path, most: int | None = None) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path}: expected a confidence map, there is no such file")
    values = read_array(path, most)
    if values.ndim != 2 or values.dtype.kind not in "fiub" or not values.size:
        raise ValueError(f"{path}: expected one channel of numbers, got {values.dtype} of shape {values.shape}")
    return values


def file_state(path: Path, kind: str) -> tuple[int, int]:
    """Return size and modification time of a file of some kind, which change if it is replaced."""
    if not path.is_file():
        raise ValueError(f"{path}: expected {kind}, there is none")
    return path.stat().st_size, path.stat().st_mtime_ns
