"""The records of a layout: its bodies, where cameras may stand, and where lamps may hang."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.shape import unit
from dsr.synthetic.surfaces import Array


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The pose and the intrinsics of a camera in a layout.

    Args:
        eye: (3,) position of the camera in metres, z up.
        target: (3,) point in the middle of the picture in metres.
        focal: focal length in image widths.
        roll: rotation about the viewing direction in degrees.
        centre: (2,) principal point in image widths from the left and upper edge.

    """

    eye: Array
    target: Array
    focal: float
    roll: float
    centre: Array

    def axes(self) -> Array:
        """Return the camera's right, down and forward axes as rows (3, 3)."""
        forward = unit((self.target - self.eye)[None])[0]
        right = unit(np.cross(forward, [0.0, 0.0, 1.0])[None])[0]
        down = np.cross(forward, right)
        c, s = np.cos(np.deg2rad(self.roll)), np.sin(np.deg2rad(self.roll))
        return np.stack((c * right + s * down, c * down - s * right, forward))


def aim_camera(rng: np.random.Generator, eye: Array, target: Array, low: float = 0.6, high: float = 1.8) -> Viewpoint:
    """Return a camera at ``eye`` that looks at ``target``, with a random focal length from ``low`` to ``high``."""
    roll = rng.normal(0, 2) if rng.random() < 0.75 else rng.uniform(-25, 25)
    centre = 0.5 + rng.normal(0, 0.015, 2)
    return Viewpoint(eye, target, float(np.exp(rng.uniform(np.log(low), np.log(high)))), float(roll), centre)


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """The bodies of a scene, and where its cameras and lamps may be.

    Args:
        bodies: bodies that fill the view of every camera.
        views: function that makes a random camera.
        low, high: (3,) corners of the box in which lamps may hang, in metres.

    """

    bodies: Sequence[Body]
    views: Callable[[np.random.Generator], Viewpoint]
    low: Array
    high: Array
