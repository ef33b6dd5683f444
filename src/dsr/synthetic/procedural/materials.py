"""Materials of random scenes: paints and highlights, sampled for each shape."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsr.synthetic.procedural import paints as p
from dsr.synthetic.procedural.paints import PAINTS, Paint
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.pictures import picture_paint
from dsr.synthetic.procedural.shape import Shape, random_rotation

_USUAL_PAINTS: dict[str, tuple[Callable[[np.random.Generator, str, float], Paint], ...]] = {
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


class MaterialSampler:
    """Samples the materials of one scene, whose paints range from plain to patterned; some scenes have a single paint.

    Args:
        rng: source of random numbers.

    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._pattern_probability = float(rng.choice([0.0, 0.25, 0.6, 0.95], p=[0.12, 0.33, 0.35, 0.2]))
        self._any_colour_probability = float(rng.choice([0.08, 0.3, 0.8]))
        self._shared: Paint | None = None
        kind = rng.random()
        if kind < 0.07:  # camouflage: one pattern continues from object to object
            self._shared = PAINTS[rng.integers(len(PAINTS))](rng, "any", 1.0)
        elif kind < 0.13:
            self._shared = p.solid_colour(rng, str(rng.choice(["white", "stone", "wall"])), 1.0)
        self._turn = random_rotation(rng)

    def sample_body(self, shape: Shape, family: str, scale: float = 1.0) -> Body:
        """Return ``shape`` in a random material of ``family`` with a pattern for objects of ``scale`` metres."""
        rng = self._rng
        gloss = float(rng.choice([0.0, 0.0, 0.1, 0.5])) * (2.5 if family == "metal" else 1.0)
        shine = float(np.exp(rng.uniform(2, 5)))
        if self._shared is not None and not (family == "print" and rng.random() < 0.5):
            return Body(self._with_scene_coordinates(shape), self._shared, gloss, shine)
        return Body(shape, self.paint(family, scale), gloss, shine)

    def paint(self, family: str, scale: float) -> Paint:
        """Return a random paint: nearly one colour, of a kind that is usual for the family, or of any kind."""
        rng = self._rng
        colours = "any" if family in ("cloth", "print") or rng.random() < self._any_colour_probability else family
        if family == "print":
            return picture_paint(rng, "any", scale)
        if rng.random() > self._pattern_probability:
            return p.solid_colour(rng, colours, scale)
        if rng.random() < 0.65:
            usual = _USUAL_PAINTS.get(family, PAINTS)
            return usual[rng.integers(len(usual))](rng, colours, scale)
        if rng.random() < 0.2:
            return picture_paint(rng, "any", scale)
        return PAINTS[rng.integers(len(PAINTS))](rng, colours, scale)

    def _with_scene_coordinates(self, shape: Shape) -> Shape:
        """Return the shape with the coordinates of the scene as its paint coordinates."""
        place = shape.vertices @ self._turn.T
        chart = np.column_stack((place[:, :2], shape.chart[:, 2]))
        return Shape(shape.vertices, shape.faces, shape.normals, chart, place)
