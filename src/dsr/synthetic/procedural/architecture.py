"""Columns and walls with arches."""

from __future__ import annotations

import numpy as np

from dsr.synthetic.procedural.shape import Shape, box, extrusion, merge, rotation_about
from dsr.synthetic.procedural.solids import frustum, hollow


def column(rng: np.random.Generator, high: float) -> Shape:
    """Return a round, fluted or square column with base and capital, ``high`` metres tall."""
    radius = rng.uniform(0.16, 0.32)
    kind = rng.integers(3)
    angle = np.arange(192) * 2 * np.pi / 192
    flutes = radius * (1 - 0.07 * np.abs(np.sin(angle * 10)))
    if kind == 0:
        shaft = hollow(radius * np.array([1.0, 1.03, 0.98, 0.85]), high - 0.4, 0.02)
    elif kind == 1:
        shaft = extrusion([np.column_stack((flutes * np.cos(angle), flutes * np.sin(angle)))], high - 0.4)
    else:
        shaft = box([1.7 * radius, 1.7 * radius, high - 0.4])
    plates = [
        box([2.8 * radius, 2.8 * radius, 0.12]),
        box([2.8 * radius, 2.8 * radius, 0.12]).translate([0, 0, high - 0.121]),
    ]
    rings = [frustum(1.3 * radius, 1.05 * radius, 0.1).translate([0, 0, 0.12])]
    rings.append(frustum(radius, 1.35 * radius, 0.15).translate([0, 0, high - 0.27]))
    return merge([shaft.translate([0, 0, 0.2]), *plates, *rings])


def arched_wall(rng: np.random.Generator, wide: float, high: float, back: float) -> list[Shape]:
    """Return a wall with a row of arched openings at y = ``back``, and the wall behind it."""
    count, thick = int(rng.integers(1, 6)), rng.uniform(0.15, 0.6)
    pitch = wide / count
    half, rise = pitch * rng.uniform(0.15, 0.36), rng.uniform(1.2, 2.4)
    bow = np.linspace(0, np.pi, 25)
    holes = []
    for k in range(count):
        x, sill = (k + 0.5) * pitch - wide / 2, 0.001 if rng.random() < 0.5 else 0.8
        arc = np.column_stack((x + half * np.cos(bow), rise + half * np.sin(bow) * rng.choice([1.0, 0.3])))
        holes.append(np.concatenate((arc, [[x - half, sill], [x + half, sill]]))[::-1])
    outline = np.array([[-wide, -1], [wide, -1], [wide, high], [-wide, high]], dtype=np.float64)
    wall = extrusion([outline, *holes], thick).rotate(rotation_about(0, 90)).translate([0, back, 0])
    return [wall, box([2 * wide, 0.05, high + 1]).translate([0, back + 0.05, -1])]
