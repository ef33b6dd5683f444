"""A frame: a photo and a depth map of one size, the camera, and where it stood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.data.formats.files import read_pixels
from dsr.geometry.camera import Camera
from dsr.geometry.poses import is_rotation
from dsr.io.photos import write_png
from dsr.utils.files import open_array
from dsr.utils.limits import pixels_beside

MILLIMETRES = 1000
MOST_MILLIMETRES = 65535
_RIGID = 1e-3
"""Largest difference of R R' from the identity."""


@dataclass(frozen=True)
class Frame:
    """A photo and a depth map of one size.

    Args:
        name: the frame's, perhaps with folders: ``kitchen/000012``.
        camera: of the pixels.
        pose: (4, 4) float64 camera-to-world transform in metres, of a camera with x right, y down, z forward; None if
            it is not known.
        colour: an 8-bit PNG.
        depth: an NPY of (H, W) orthogonal depth in metres, NaN in holes.

    """

    name: str
    camera: Camera
    pose: Tensor | None
    colour: Path
    depth: Path

    @property
    def stem(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", "_")

    def read_depth(self) -> np.ndarray:
        """Return the depth, (H, W) float32 in metres, NaN in holes.

        Raises:
            ValueError: the file is damaged, or not of the camera's size.

        """
        values = open_array(self.depth)
        if values.shape != (self.camera.height, self.camera.width):
            size = f"{self.camera.height} x {self.camera.width}"
            raise ValueError(f"{self.depth}: expected depth of {size} pixels (height x width), got {values.shape}")
        return np.array(values, np.float32)

    def read_colour(self) -> np.ndarray:
        """Return the photo, (H, W, 3) uint8, red first.

        Raises:
            ValueError: the file is damaged.

        """
        most = pixels_beside(self.camera.height, self.camera.width)
        return read_pixels(self.colour, cv2.IMREAD_COLOR, most)[..., ::-1]


def parse_pose(where: str, value: object) -> Tensor | None:
    """Return a camera-to-world transform, (4, 4) float64, that a file holds as a list of lists; None for none.

    Args:
        where: the file and the key, for the message.
        value: what the file holds there.

    Raises:
        ValueError: it is no rigid transform.

    """
    if value is None:
        return None
    try:
        pose = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        pose = torch.empty(0, dtype=torch.float64)
    rigid = pose.shape == (4, 4) and bool(pose.isfinite().all()) and pose[3].tolist() == [0, 0, 0, 1]
    if not rigid or not is_rotation(pose[:3, :3].numpy(), _RIGID):
        raise ValueError(f"{where}: expected a rigid transform of 4 x 4 numbers, got {value}")
    return pose


def one_camera(frames: Sequence[Frame]) -> Camera | None:
    """Return the camera of all frames, or None if they differ."""
    cameras = {frame.camera for frame in frames}
    return cameras.pop() if len(cameras) == 1 else None


def write_colour(path: Path, rgb: np.ndarray) -> None:
    """Write (H, W, 3) uint8, red first, as a PNG, atomically."""
    write_png(path, np.ascontiguousarray(rgb[..., ::-1]))


def write_sixteen_bits(path: Path, values: np.ndarray) -> None:
    """Write (H, W) uint16 as a PNG, atomically."""
    write_png(path, values)


def to_millimetres(depth: np.ndarray) -> tuple[np.ndarray, int]:
    """Return depth in metres as whole millimetres, (H, W) uint16 with 0 in holes, and how many pixels are too far.

    Depth of 65.535 m and more does not fit, and becomes a hole.
    """
    values = np.rint(depth.astype(np.float64) * MILLIMETRES)
    fits = (values > 0) & (values <= MOST_MILLIMETRES)
    return np.where(fits, values, 0).astype(np.uint16), int((values > MOST_MILLIMETRES).sum())
