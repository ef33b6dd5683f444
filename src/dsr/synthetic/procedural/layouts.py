"""Layouts of random scenes: rooms, tables, shelves, statues, walls, ground, porticoes, and shapes before a wall."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsr.synthetic.procedural.architecture import arched_wall, column
from dsr.synthetic.procedural.furniture import blinds, shelf, table
from dsr.synthetic.procedural.organic import branches, creature, figure, pebble, plant
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.props import backdrop, fill_room, heap, oddment, shell, tableware
from dsr.synthetic.procedural.reliefs import RELIEFS, blanket, crumple, curtain, folds, ground, relief
from dsr.synthetic.procedural.shape import about, any_turn, box, merged
from dsr.synthetic.procedural.solids import any_solid, frustum, grounded, prism
from dsr.synthetic.procedural.stage import MaterialSampler, SceneLayout, Viewpoint, looking
from dsr.synthetic.surfaces import Array

Layout = Callable[[np.random.Generator, MaterialSampler], SceneLayout]


def _vector(*values: float) -> Array:
    return np.array(values, dtype=np.float64)


def room(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a furnished room, seen from eye height towards a corner or a wall."""
    size = rng.uniform([2.6, 2.8, 2.2], [5.5, 6.0, 3.2])
    bodies = [*shell(rng, wear, size), *fill_room(rng, wear, size)]

    def views(draw: np.random.Generator) -> Viewpoint:
        eye = draw.uniform([-0.42, -0.47, 0], [0.42, -0.2, 0]) * size
        eye[2] = draw.uniform(0.7, 1.9)
        target = draw.uniform([-0.4, 0.3, 0], [0.4, 0.5, 0]) * size
        target[2] = draw.uniform(0.3, 1.3)
        return looking(draw, eye, target, 0.6, 1.3)

    margin = _vector(0.3, 0.3, 0.2)
    return SceneLayout(bodies, views, _vector(-size[0] / 2, -size[1] / 2, 0.9) + margin, size * [0.5, 0.5, 1] - margin)


def tabletop(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return many small things on a table before a wall or a backdrop."""
    wide, deep = rng.uniform([0.7, 0.5], [1.6, 0.9])
    bodies = tableware(rng, wear, _vector(wide, deep))
    if rng.random() < 0.35:
        sheet = relief(rng, (folds, crumple, ground)[rng.integers(3)], 1.0)
        bodies.append(wear.dress(sheet.stretched([wide, deep, 0.35]).moved([0, 0, -0.002]), "cloth", 0.5))
    high = rng.uniform(0.45, 0.8)
    board = box([wide, deep, 0.04]).moved([0, 0, -0.041])
    legs = table(rng, _vector(wide, deep), high)[1].moved([0, 0, -high - 0.03])
    bodies += [wear.dress(board, "wood", 0.6), wear.dress(legs, "wood", 0.3)]
    bodies += backdrop(rng, wear, deep / 2 + rng.uniform(0.02, 1.5), -high - 0.03)

    def views(draw: np.random.Generator) -> Viewpoint:
        rise, yaw, far = np.deg2rad(draw.uniform(12, 65)), draw.uniform(-0.6, 0.6), draw.uniform(0.55, 1.2)
        target = draw.uniform([-0.2, -0.1, 0.0], [0.2, 0.2, 0.12])
        way = _vector(np.sin(yaw) * np.cos(rise), -np.cos(yaw) * np.cos(rise), np.sin(rise))
        return looking(draw, target + far * way, target, 0.8, 1.8)

    return SceneLayout(bodies, views, _vector(-2, -2, 0.3), _vector(2, deep / 2, 2))


def statue(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return one or two organic bodies, close, on a plinth."""
    count = 1 if rng.random() < 0.65 else 2
    bodies = []
    for k in range(count):
        kind = rng.random()
        shape = figure(rng) if kind < 0.55 else creature(rng, 120) if kind < 0.92 else pebble(rng, 110)
        shape = shape.turned(about(2, rng.uniform(0, 360) if kind > 0.55 else rng.uniform(-50, 50)))
        place = [(k - (count - 1) / 2) * 0.7, rng.uniform(-0.1, 0.1), 0]
        bodies.append(wear.dress(shape.moved(place), "stone", 0.6))
    base = box([1.2, 0.8, 0.3]) if rng.random() < 0.5 else frustum(0.7, 0.6, 0.3)
    bodies.append(wear.dress(base.moved([0, 0, -0.3]), "stone", 0.6))
    bodies += backdrop(rng, wear, rng.uniform(0.5, 2.0), -0.29)
    aim, middle = rng.uniform(0.35, 0.8), 0.35 * (count - 1)

    def views(draw: np.random.Generator) -> Viewpoint:
        yaw, far = draw.uniform(-0.7, 0.7), draw.uniform(0.7, 1.9)
        target = _vector(draw.uniform(-0.1, 0.1) + middle * draw.choice([-1, 0, 1]), 0, aim)
        eye = target + far * _vector(np.sin(yaw), -np.cos(yaw), draw.uniform(-0.15, 0.5))
        return looking(draw, eye, target, 0.7, 1.6)

    return SceneLayout(bodies, views, _vector(-2, -2, 0.2), _vector(2, 0.3, 2.2))


def relief_wall(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a relief that fills the picture, straight or at a slant, flat or curved; things before it at times."""
    side = 3.0
    bend = rng.choice([0.0, 0.0, 0.12, -0.12, 0.3])
    sheet = relief(rng, RELIEFS[rng.integers(len(RELIEFS))], side, 340, bend)
    family = str(rng.choice(["stone", "brick", "wall", "cloth", "earth"]))
    bodies = [wear.dress(sheet.turned(about(0, 90)).moved([0, 0, 0]), family, 0.8)]
    bodies.append(wear.dress(box([9, 0.1, 9]).moved([0, 0.35, -4.5]), "wall", 1.0))
    for _ in range(rng.integers(0, 4) if rng.random() < 0.6 else 0):
        thing = any_solid(rng).stretched(rng.uniform(0.2, 0.6))
        thing = thing.turned(any_turn(rng)) if rng.random() < 0.5 else thing
        bodies.append(wear.dress(thing.moved(rng.uniform([-0.5, -0.9, -0.5], [0.5, -0.5, 0.3])), "any", 0.3))

    def views(draw: np.random.Generator) -> Viewpoint:
        slant, lift, far = draw.uniform(-0.8, 0.8), draw.uniform(-0.45, 0.45), draw.uniform(0.9, 1.9)
        target = draw.uniform([-0.4, 0, -0.4], [0.4, 0, 0.4])
        eye = target + far * _vector(np.sin(slant) * np.cos(lift), -np.cos(slant) * np.cos(lift), np.sin(lift))
        return looking(draw, eye, target, 1.0, 1.8)

    return SceneLayout(bodies, views, _vector(-3, -3, -2), _vector(3, -0.5, 3))


def landscape(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return ground or rumpled cloth seen at a slant, with stones, plants or things on it, before a backdrop."""
    maker = (ground, ground, crumple, folds)[rng.integers(4)]
    side = 4.0
    sheet = relief(rng, maker, side, 340).stretched([1, 1, 1.0 if maker is ground else 1.3])
    floor = sheet.moved([0, side / 2 - 0.6, -np.quantile(sheet.vertices[:, 2], 0.5)])
    cloth = maker in (crumple, folds)
    bodies = [wear.dress(floor, "cloth" if cloth else "earth", 0.9)]
    for _ in range(rng.integers(0, 14)):
        spot = rng.uniform([-1.1, 0.2], [1.1, 2.8])
        height = floor.vertices[np.argmin(((floor.vertices[:, :2] - spot) ** 2).sum(1)), 2]
        thing = any_solid(rng) if cloth or rng.random() < 0.25 else pebble(rng)
        size = rng.uniform(0.08, 0.5)
        thing = thing.stretched(size).turned(about(2, rng.uniform(0, 360)))
        bodies.append(wear.dress(thing.moved([*spot, height - 0.08 * size]), "stone", size))
    root = [rng.uniform(-0.6, 0.6), rng.uniform(0.9, 1.8), -0.1]
    if rng.random() < 0.5:
        greens = plant(rng) if rng.random() < 0.5 else [branches(rng)]
        bodies += [wear.dress(part.moved(root), "plant", 0.3) for part in greens]
    bodies += backdrop(rng, wear, 3.1, -0.4)

    def views(draw: np.random.Generator) -> Viewpoint:
        rise = draw.uniform(0.5, 2.0)
        eye = _vector(draw.uniform(-0.4, 0.4), -0.5, rise)
        return looking(draw, eye, _vector(draw.uniform(-0.3, 0.3), draw.uniform(0.9, 1.8), 0), 0.7, 1.5)

    return SceneLayout(bodies, views, _vector(-3, -2, 0.8), _vector(3, 2.6, 3.5))


def portico(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a portico or a facade: columns, steps, arches, railings, blocks; several metres away."""
    stone, count = wear.paint("stone", 1.5), int(rng.integers(2, 6))
    pitch, high = rng.uniform(1.2, 2.4), rng.uniform(2.6, 4.0)
    shaft = column(rng, high)
    spots = (np.arange(count) - (count - 1) / 2) * pitch
    span = pitch * (count + 1)
    shapes = [shaft.moved([x, 0, 0]) for x in spots]
    shapes.append(box([span, 0.7, 0.5]).moved([0, 0, high]))
    shapes += [box([span + 0.6 * k, 1.2 + 0.6 * k, 0.17]).moved([0, 0, -0.17 * (k + 1) - 0.001]) for k in range(4)]
    bodies = [Body(merged(shapes), stone)]
    back = rng.uniform(0.8, 3.0)
    bodies += [wear.dress(s, "wall", 1.5) for s in arched_wall(rng, span + 4, high + 1.5, back)]
    if rng.random() < 0.5:
        for x in spots[:-1]:
            rail = blinds(rng, pitch - 0.5, 0.9)[0]
            bodies.append(wear.dress(rail.moved([x + 0.25, 0, 0]), "metal", 0.3))
    for _ in range(rng.integers(0, 5)):
        thing = (prism if rng.random() < 0.5 else any_solid)(rng).stretched(rng.uniform(0.5, 1.1))
        bodies.append(wear.dress(thing.moved([*rng.uniform([-2.5, -3.0], [2.5, -1.6]), -0.68]), "stone", 0.8))
    floor = relief(rng, RELIEFS[rng.integers(2)], 16.0, 260) if rng.random() < 0.4 else box([30, 30, 0.1])
    bodies.append(wear.dress(floor.stretched([1, 1, 0.15]).moved([0, 0, -0.7]), "stone", 2.0))
    bodies.append(wear.dress(box([40, 0.1, 30]).moved([0, back + 3, -5]), "wall", 3.0))

    def views(draw: np.random.Generator) -> Viewpoint:
        eye = draw.uniform([-3.0, -7.0, 0.3], [3.0, -3.6, 2.6])
        return looking(draw, eye, draw.uniform([-1, 0, 0.6], [1, 0.5, 1.9]), 0.8, 1.5)

    return SceneLayout(bodies, views, _vector(-8, -12, 2), _vector(8, -2, 9))


def shapes(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a few large simple or organic shapes that float before a plane or a curved backdrop."""
    bodies = []
    for place in heap(rng, int(rng.integers(1, 6))):
        thing = any_solid(rng) if rng.random() < 0.8 else creature(rng, 72)
        thing = grounded(thing).moved([0, 0, -0.4]).turned(any_turn(rng)).stretched(rng.uniform(0.5, 1.0))
        bodies.append(wear.dress(thing.moved(place), "any", 0.5))
    bodies += backdrop(rng, wear, rng.uniform(0.7, 1.6), -1.2)

    def views(draw: np.random.Generator) -> Viewpoint:
        eye = draw.uniform([-0.8, -2.6, -0.3], [0.8, -1.7, 0.9])
        return looking(draw, eye, draw.uniform([-0.1, 0, -0.1], [0.1, 0, 0.1]), 0.9, 1.8)

    return SceneLayout(bodies, views, _vector(-2.5, -3, -0.5), _vector(2.5, -0.3, 2.5))


def clutter(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a crowd of things of all kinds at several depths that fills the picture: a lumber-room, a toy box."""
    bodies: list[Body] = []
    reach = rng.uniform(0.5, 1.0)
    for _ in range(rng.integers(14, 44)):
        place = rng.uniform([-1.1 * reach, -0.2, 0], [1.1 * reach, reach, 0])
        shapes, families = oddment(rng)
        turn = any_turn(rng) if rng.random() < 0.25 else about(2, rng.uniform(0, 360))
        place[2] = 0.55 * place[1] * rng.random() + (0.15 if rng.random() < 0.3 else 0.0)
        for shape, family in zip(shapes, families, strict=True):
            bodies.append(wear.dress(shape.turned(turn).moved(place), family, 0.3))
    for k in range(int(rng.integers(0, 4))):  # boxes behind that the rest stands on
        block = box(rng.uniform([0.4, 0.3, 0.2], [0.9, 0.5, 0.9])).turned(about(2, rng.uniform(-30, 30)))
        bodies.append(wear.dress(block.moved([(k - 1.5) * 0.6, reach * rng.uniform(0.5, 1.0), 0.0]), "print", 0.5))
    bodies += backdrop(rng, wear, reach + rng.uniform(0.3, 0.8), -0.002)

    def views(draw: np.random.Generator) -> Viewpoint:
        eye = draw.uniform([-0.7, -1.7, 0.3], [0.7, -0.9, 1.3])
        return looking(draw, eye, draw.uniform([-0.2, 0.2, 0.05], [0.2, 0.4, 0.3]), 1.0, 1.8)

    return SceneLayout(bodies, views, _vector(-2, -2, 0.4), _vector(2, 0.4, 2.2))


def shelves(rng: np.random.Generator, wear: MaterialSampler) -> SceneLayout:
    """Return a close look at a full bookcase, through a curtain's gap or a grille at times."""
    parts = shelf(rng)
    families = ["wood", "print", "any", "cloth", "any"]
    bodies = [wear.dress(s, f, 0.4) for s, f in zip(parts, families, strict=False)]
    bodies.append(wear.dress(box([9, 0.1, 9]).moved([0, 0.35, -3]), "wall", 1.0))
    bodies.append(wear.dress(box([9, 9, 0.1]).moved([0, 0, -0.11]), "wood", 1.0))
    if rng.random() < 0.3:
        cloth = curtain(rng, 0.5, 2.4).moved([rng.choice([-0.75, 0.25]), -0.32, 0])
        bodies.append(wear.dress(cloth, "cloth", 0.3))
    if rng.random() < 0.2:
        bodies.append(wear.dress(blinds(rng, 1.6, 2.4)[0].moved([-0.8, -0.3, 0]), "metal", 0.3))
    if rng.random() < 0.5:
        soft = blanket(rng, rng.uniform(0.4, 0.8, 2), 0.15).turned(about(0, rng.uniform(0, 30)))
        bodies.append(wear.dress(soft.moved([rng.uniform(-0.5, 0.5), -0.7, 0]), "cloth", 0.4))
    top = float(parts[0].vertices[:, 2].max())

    def views(draw: np.random.Generator) -> Viewpoint:
        target = _vector(draw.uniform(-0.2, 0.2), 0, draw.uniform(0.25, 0.8) * top)
        eye = target + draw.uniform([-0.7, -1.9, -0.2], [0.7, -0.9, 0.6])
        eye[2] = max(eye[2], 0.15)
        return looking(draw, eye, target, 0.8, 1.5)

    return SceneLayout(bodies, views, _vector(-2, -3, 0.4), _vector(2, -0.5, 2.6))


LAYOUTS: dict[str, tuple[Layout, float]] = {
    "room": (room, 0.25),
    "tabletop": (tabletop, 0.17),
    "clutter": (clutter, 0.09),
    "statue": (statue, 0.14),
    "relief_wall": (relief_wall, 0.10),
    "landscape": (landscape, 0.06),
    "portico": (portico, 0.06),
    "shapes": (shapes, 0.07),
    "shelves": (shelves, 0.06),
}
"""What there is, and how often."""
