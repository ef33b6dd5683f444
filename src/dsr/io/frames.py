"""Frames of captures: where an app keeps photos, depth and confidence maps, and what it says about the camera."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from dsr.geometry.camera import Camera
from dsr.io.encoding import Assumption

Record = dict[str, str | int]
"""What identifies an input in ``info.json``: its name, its SHA-256, and a frame's number if it has one."""


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


class Geometry(NamedTuple):
    """What a capture says of a frame's camera.

    ``camera``: of a size of its own, which is scaled to the photo's; None if it does not say. ``pose``: camera to
    world, (4, 4) float64 in metres, rigid, of the camera's frame x right, y down, z forward; the world's frame is the
    capture's own. None if it does not say. ``assumptions``: what was assumed for them.
    """

    camera: Camera | None = None
    pose: np.ndarray | None = None
    assumptions: tuple[Assumption, ...] = ()


@dataclass(frozen=True)
class CaptureFrame:
    """One frame of a capture.

    Args:
        app: name of the app or data set, for messages.
        geometry: returns camera and pose for a photo of (height, width) pixels, or raises a ValueError that names the
            file.
        told_by: file that describes camera and pose.
        told: the part of it that this frame depends on, which identifies it in ``info.json``.
        photo: where the photo is, if it is no file of its own.
        depth: where the depth map is, if it is no file of its own.

    """

    app: str
    geometry: Callable[[tuple[int, int]], Geometry]
    told_by: Path
    told: bytes
    photo: Source | None = None
    depth: Source | None = None

    def record(self) -> Record:
        """Return what identifies the description of the camera."""
        return {"file": self.told_by.name, "sha256": hashlib.sha256(self.told).hexdigest()}
