"""What a layout makes: dressed bodies, where the camera may stand, where lamps may hang."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dsr.synthetic.procedural import paints as p
from dsr.synthetic.procedural.paints import PAINTS, Paint
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.pictures import picture_paint
from dsr.synthetic.procedural.shape import Shape, any_turn, unit
from dsr.synthetic.surfaces import Array

_USUAL: dict[str, tuple[Callable[[np.random.Generator, str, float], Paint], ...]] = {
    "wood": (p.grain, p.grain, p.grain, p.solid_colour),
    "stone": (p.veins, p.clouds, p.speckles, p.toned, p.solid_colour),
    "wall": (p.solid_colour, p.solid_colour, p.clouds, p.stripes, p.dots),
    "brick": (p.bricks, p.toned, p.clouds),
    "plant": (p.solid_colour, p.toned, p.clouds),
    "metal": (p.solid_colour, p.speckles, p.clouds),
    "earth": (p.clouds, p.speckles, p.toned),
    "white": (p.solid_colour,),
    "cloth": (p.woven, p.stripes, p.solid_colour, p.dots, p.toned, p.clouds),
    "print": (picture_paint,),
}


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera in a layout.

    Args:
        eye, target: (3,) where it stands and what is in the middle of the picture, z up, in metres.
        focal: focal length in image widths.
        roll: degrees.
        centre: (2,) the principal point in image widths from the left and upper edge.

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


def looking(rng: np.random.Generator, eye: Array, target: Array, low: float = 0.6, high: float = 1.8) -> Viewpoint:
    """Return a camera at ``eye`` with a random lens between two focal lengths, mostly upright."""
    roll = rng.normal(0, 2) if rng.random() < 0.75 else rng.uniform(-25, 25)
    centre = 0.5 + rng.normal(0, 0.015, 2)
    return Viewpoint(eye, target, float(np.exp(rng.uniform(np.log(low), np.log(high)))), float(roll), centre)


@dataclass(frozen=True, eq=False)
class SceneLayout:
    """A layout.

    Args:
        bodies: they enclose the cameras' views.
        views: makes a random camera.
        low, high: (3,) corners of the room for lamps.

    """

    bodies: Sequence[Body]
    views: Callable[[np.random.Generator], Viewpoint]
    low: Array
    high: Array


class MaterialSampler:
    """The materials of one scene: from bare plaster to everything patterned; now and then one paint over all."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._busy = float(rng.choice([0.0, 0.25, 0.6, 0.95], p=[0.12, 0.33, 0.35, 0.2]))
        self._odd = float(rng.choice([0.08, 0.3, 0.8]))
        self._shared: Paint | None = None
        kind = rng.random()
        if kind < 0.07:  # camouflage: paint runs on from thing to thing
            self._shared = PAINTS[rng.integers(len(PAINTS))](rng, "any", 1.0)
        elif kind < 0.13:
            self._shared = p.solid_colour(rng, str(rng.choice(["white", "stone", "wall"])), 1.0)
        self._turn = any_turn(rng)

    def dress(self, shape: Shape, family: str, scale: float = 1.0) -> Body:
        """Return ``shape`` in a material of ``family``, patterns made for a thing of ``scale`` metres."""
        rng = self._rng
        gloss = float(rng.choice([0.0, 0.0, 0.1, 0.5])) * (2.5 if family == "metal" else 1.0)
        shine = float(np.exp(rng.uniform(2, 5)))
        if self._shared is not None and not (family == "print" and rng.random() < 0.5):
            return Body(self._in_space(shape), self._shared, gloss, shine)
        return Body(shape, self.paint(family, scale), gloss, shine)

    def paint(self, family: str, scale: float) -> Paint:
        """Return a paint: of the kind usual for the family, any kind, or nearly one colour."""
        rng = self._rng
        colours = "any" if family in ("cloth", "print") or rng.random() < self._odd else family
        if family == "print":
            return picture_paint(rng, "any", scale)
        if rng.random() > self._busy:
            return p.solid_colour(rng, colours, scale)
        if rng.random() < 0.65:
            usual = _USUAL.get(family, PAINTS)
            return usual[rng.integers(len(usual))](rng, colours, scale)
        if rng.random() < 0.2:
            return picture_paint(rng, "any", scale)
        return PAINTS[rng.integers(len(PAINTS))](rng, colours, scale)

    def _in_space(self, shape: Shape) -> Shape:
        """Return the shape with paint coordinates that are those of the scene."""
        place = shape.vertices @ self._turn.T
        chart = np.column_stack((place[:, :2], shape.chart[:, 2]))
        return Shape(shape.vertices, shape.faces, shape.normals, chart, place)
