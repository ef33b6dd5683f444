"""Frames of captures: where an app keeps photos, depth and confidence maps, and what it says about the camera."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from dsr.geometry.camera import Camera, Lens
from dsr.geometry.poses import Matrix
from dsr.io.depth_files import DEPTH_SUFFIXES, read_array_file
from dsr.io.images import read_pixels
from dsr.notes import Assumption
from dsr.utils.guards import pixels_beside

Record = dict[str, str | int]
"""What identifies an input in ``info.json``: its name, its SHA-256, and a frame's number if it has one."""

HIGHEST_LEVEL = 2
"""ARKit's levels are 0 (low), 1 (medium) and 2 (high)."""
SLACK = 0.002
"""Fractions count as equal within this: 127 of 255 is a half."""
_ARRAYS = (".npy", ".npz", ".pfm", ".exr")
CONFIDENCE_SUFFIXES = (*DEPTH_SUFFIXES, ".bmp")
"""Of the files of confidence maps."""


UPS = ("", "y", "z")
"""Axes of a capture's world that point up; "" where it does not say."""


class Source(Protocol):
    """A photo or a map inside of a file: a frame of a video, a member of an archive, a message of a recording.

    Attributes:
        file: the file or folder on the disk.

    """

    @property
    def file(self) -> Path:
        """The file or folder on the disk."""
        ...

    def read(self) -> np.ndarray:
        """Return the pixels: (H, W, 3) uint8 RGB of a photo, (h, w) stored values of a map.

        Raises:
            ValueError: the file is damaged, or ends before the frame; the message names it.

        """
        ...

    def record(self) -> Record:
        """Return what identifies the content."""
        ...


class Rig(NamedTuple):
    """A depth camera, of the depth map's pixels, and the transform from its frame to the photo camera's, metres.

    ``lens``: its lens; None without distortion.
    """

    camera: Camera
    transform: Matrix
    lens: Lens | None = None


class Geometry(NamedTuple):
    """Cameras, lenses and poses of a frame as its capture states them.

    ``camera``: of a size of its own, which is scaled to the photo's; None if it does not say. ``pose``: camera to
    world, (4, 4) float64 in metres, rigid, of the camera's frame x right, y down, z forward; the world's frame is the
    capture's own. None if it does not say. ``assumptions``: what was assumed for them. ``lens``: of the photo, and of a
    depth map without a rig, which lies in the photo's pixels; None without distortion. ``rig``: the depth map's own
    camera, of a size of its own as well; None if the map is in the photo's view. ``up``: the axis of the world that
    points up, one of :data:`UPS`. ``damage``: what is wrong with the capture's cameras where others take their place,
    and no rig is known therefore; empty if nothing is. ``apart``: why a depth map that is not in the photo's view is of
    no use without a given rig; empty if it is.
    """

    camera: Camera | None = None
    pose: np.ndarray | None = None
    assumptions: tuple[Assumption, ...] = ()
    lens: Lens | None = None
    rig: Rig | None = None
    up: str = ""
    damage: str = ""
    apart: str = ""


@dataclass(frozen=True)
class CaptureFrame:
    """One frame of a capture.

    Args:
        app: name of the app or data set, for messages.
        geometry: returns camera and pose for a photo of (height, width) pixels, or raises a ValueError that names the
            file.
        description: file that describes camera and pose.
        content: the part of it that this frame depends on, which identifies it in ``info.json``.
        photo: where the photo is, if it is no file of its own.
        depth: where the depth map is, if it is no file of its own.
        time: of the frame, in seconds; None if the capture does not say.
        apart: whether the depth map may be that of a camera beside the photo's, so that it is of no use without that.

    """

    app: str
    geometry: Callable[[tuple[int, int]], Geometry]
    description: Path
    content: bytes
    photo: Source | None = None
    depth: Source | None = None
    time: float | None = None
    apart: bool = False

    def record(self) -> Record:
        """Return what identifies the description of the camera."""
        return {"file": self.description.name, "sha256": hashlib.sha256(self.content).hexdigest()}


@dataclass(frozen=True)
class ConfidenceMap:
    """Where a confidence map is, and how it counts.

    Args:
        path: the file, or the name of the place in one.
        highest: value that stands for full confidence; 1 for fractions.
        source: where the map is, if it is no file of its own.

    """

    path: Path
    highest: float
    source: Source | None = None

    def read(self, size: tuple[int, int]) -> np.ndarray:
        """Return the confidence of a depth map of (h, w), float32 from 0 to 1.

        Raises:
            ValueError: it is missing, damaged, of another size, or has values out of range.

        """
        values = read_values(self.path, pixels_beside(*size)) if self.source is None else self.source.read()
        if values.shape != size:
            raise ValueError(
                f"{self.path}: expected confidence of the depth map's {size[1]} x {size[0]} pixels (width x height), "
                f"got {values.shape[1]} x {values.shape[0]}"
            )
        if not ((values >= 0) & (values <= self.highest)).all():
            wrong = values[~((values >= 0) & (values <= self.highest))][0]
            raise ValueError(f"{self.path}: expected confidence from 0 to {self.highest:g}, got {wrong}")
        return values.astype(np.float32) / np.float32(self.highest)


def read_values(path: Path, most: int | None = None) -> np.ndarray:
    """Return a confidence map as it is stored, (h, w).

    Args:
        most: largest number of pixels; None for what the size of the file explains.

    Raises:
        ValueError: it is missing, damaged, too large, or has several channels.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected a confidence map, there is no such file")
    array = path.suffix.lower() in _ARRAYS
    values = read_array_file(path, most) if array else read_pixels(path, cv2.IMREAD_UNCHANGED, most)
    if values.ndim != 2 or values.dtype.kind not in "fiub" or not values.size:
        raise ValueError(f"{path}: expected one channel of numbers, got {values.dtype} of shape {values.shape}")
    return values


def file_state(path: Path, kind: str) -> tuple[int, int]:
    """Return size and modification time of a file, which change if it is replaced.

    Args:
        kind: what it should be, for the message.

    Raises:
        ValueError: there is no such file.

    """
    if not path.is_file():
        raise ValueError(f"{path}: expected {kind}, there is none")
    return path.stat().st_size, path.stat().st_mtime_ns


def find_highest(paths: Sequence[Path]) -> float:
    """Return the value that stands for full confidence in maps that belong together.

    Floats are fractions. Whole numbers are levels from 0 to 2 if no map has a larger one; else they go up to 255, or up
    to 65535 in maps of 16 bits that have more than 255. Maps that cannot be read do not count; that is said when their
    frame is read.
    """
    highest = float(HIGHEST_LEVEL)
    for path in paths:
        try:
            values = read_values(path)
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
