"""The light directions of all renderings, without importing torch, which takes seconds.

A direction is a unit vector from the surface to the light in the camera frame: x right, y down, z forward. Metrics,
pictures, the pages' scripts and the command lines take names and directions from here.
"""

import math
from typing import NamedTuple

Direction = tuple[float, float, float]


class Light(NamedTuple):
    """A light: its direction, and the same as a formula for Matplotlib."""

    direction: Direction
    formula: str


BASIS: tuple[Direction, ...] = (
    (0.0, -math.sqrt(2 / 3), -1 / math.sqrt(3)),
    (-1 / math.sqrt(2), 1 / math.sqrt(6), -1 / math.sqrt(3)),
    (1 / math.sqrt(2), 1 / math.sqrt(6), -1 / math.sqrt(3)),
)  # three orthonormal directions: the shadings under them are the normal map in another basis
LIGHTS = {
    "e1": Light(BASIS[0], r"$-(0,\,\sqrt{2/3},\,1/\sqrt{3})$"),
    "e2": Light(BASIS[1], r"$-(1/\sqrt{2},\,-1/\sqrt{6},\,1/\sqrt{3})$"),
    "e3": Light(BASIS[2], r"$-(-1/\sqrt{2},\,-1/\sqrt{6},\,1/\sqrt{3})$"),
    "e4": Light((0.0, 0.0, -1.0), r"$-(0,\,0,\,1)$"),
}  # the paper's four lights: three orthonormal ones, and a frontal one
LIGHT_NAMES: tuple[str, ...] = tuple(LIGHTS)
LIGHT_CHOICES = f"{', '.join(LIGHT_NAMES[:-1])} or {LIGHT_NAMES[-1]}"  # the names as words
# the lights of figures and of a user study unless another is chosen
FIGURE_LIGHT, STUDY_LIGHT = LIGHT_NAMES[0], LIGHT_NAMES[-1]
# A light at the upper left of the viewer, for surfaces to look at; a light that the reader moves begins there
VIEWING_LIGHT: Direction = (-0.4, -0.7, -math.sqrt(1 - 0.4**2 - 0.7**2))


def direction_of(light: str) -> Direction:
    """Return the direction of a light."""
    if light not in LIGHTS:
        raise ValueError(f"light: expected one of {', '.join(LIGHT_NAMES)}, got {light!r}")
    return LIGHTS[light].direction
