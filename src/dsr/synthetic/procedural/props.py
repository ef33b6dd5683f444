"""Parts of layouts: the walls and contents of rooms, backdrops, objects on a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dsr.synthetic.procedural import furniture as f
from dsr.synthetic.procedural.materials import MaterialSampler
from dsr.synthetic.procedural.organic import branches, creature, figure, pebble, plant
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.reliefs import RELIEFS, blanket, curtain, relief
from dsr.synthetic.procedural.shape import Shape, box, merge, quad, rotation_about, surface
from dsr.synthetic.procedural.solids import bowl, letter, random_solid, vase
from dsr.synthetic.ray_surfaces import Array


def shell(rng: np.random.Generator, materials: MaterialSampler, size: Array) -> list[Body]:
    """Return floor, ceiling and walls of a room of ``size`` (3,) around the origin of its floor."""
    x, y, z = size
    low = [-x / 2, -y / 2, 0.0]
    walls = [quad(low, [x, 0, 0], [0, 0, z]), quad([-x / 2, y / 2, 0], [x, 0, 0], [0, 0, z])]
    walls += [quad([side * x / 2, -y / 2, 0], [0, y, 0], [0, 0, z]) for side in (-1, 1)]
    bodies = [materials.sample_body(quad(low, [x, 0, 0], [0, y, 0]), "wood", 1.2)]
    bodies.append(materials.sample_body(quad([-x / 2, -y / 2, z], [x, 0, 0], [0, y, 0]), "white", 1.0))
    if rng.random() < 0.6:
        bodies.append(materials.sample_body(merge(walls), "wall", 1.2))
    else:
        bodies += [materials.sample_body(wall, "wall", 1.2) for wall in walls]
    if rng.random() < 0.6:  # skirting board
        tall = rng.uniform(0.06, 0.15)
        boards = [box([x, 0.02, tall]).translate([0, y / 2 - 0.01, 0])]
        boards += [box([0.02, y, tall]).translate([side * (x / 2 - 0.01), 0, 0]) for side in (-1, 1)]
        bodies.append(materials.sample_body(merge(boards), "white", 1.0))
    if rng.random() < 0.25:  # the back wall is masonry
        stone = relief(rng, RELIEFS[rng.integers(4)], 1.0, 320).rotate(rotation_about(0, 90)).translate([0, 0, 0.5])
        bodies.append(materials.sample_body(stone.scale([x, 2.0, z]).translate([0, y / 2 - 0.002, 0]), "brick", 1.0))
    return bodies


def fill_room(rng: np.random.Generator, materials: MaterialSampler, size: Array) -> list[Body]:
    """Return furniture along the back and side walls and in the middle, and what hangs on the walls."""
    bodies: list[Body] = []
    for wall, (turn, length) in enumerate(((0, size[0]), (90, size[1]), (-90, size[1]))):
        out = (size[1] if wall == 0 else size[0]) / 2
        x = -length / 2 + rng.uniform(0.1, 0.8)
        while x < length / 2 - 0.6:
            parts, families = _wall_piece(rng)
            low, high = _extent(parts)
            if x + high[0] - low[0] < length / 2 - 0.05:
                shift = np.array([x - low[0], out - high[1] - rng.uniform(0.025, 0.1), 0.0])
                bodies += _sample_bodies(materials, parts, families, rotation_about(2, turn), shift)
            x += high[0] - low[0] + rng.uniform(0.05, 1.0)
        bodies += _hangings(rng, materials, rotation_about(2, turn), length, out, size[2])
    bodies += _middle(rng, materials, size)
    return bodies


def _extent(parts: Sequence[Shape]) -> tuple[Array, Array]:
    """Return the corners of the box around the shapes."""
    points = np.concatenate([s.vertices for s in parts])
    return points.min(0), points.max(0)


def _sample_bodies(
    materials: MaterialSampler,
    parts: Sequence[Shape],
    families: Sequence[str],
    turn: Array,
    shift: Array | Sequence[float],
) -> list[Body]:
    """Return the parts, translated by ``shift`` and then rotated, each in a material of its family."""
    last = families[-1]
    names = [*families, *[last] * len(parts)]
    return [
        materials.sample_body(s.translate(shift).rotate(turn), name, 0.6) for s, name in zip(parts, names, strict=False)
    ]


def _wall_piece(rng: np.random.Generator) -> tuple[list[Shape], list[str]]:
    """Return a piece of furniture whose front faces -y, and the families of its materials."""
    pieces: tuple[tuple[Callable[[], list[Shape]], list[str]], ...] = (
        (lambda: f.shelf(rng), ["wood", "any", "print", "cloth", "any"]),
        (lambda: f.cabinet(rng), ["wood", "metal"]),
        (lambda: f.sofa(rng), ["cloth", "cloth"]),
        (lambda: _set_table(rng), ["wood", "metal", "any"]),
        (lambda: f.lamp(rng, rng.uniform(1.2, 1.7)), ["white", "metal"]),
        (lambda: f.pot_plant(rng, rng.uniform(0.6, 1.6)), ["plant", "plant", "stone"]),
        (lambda: [s.rotate(rotation_about(2, 25.0)) for s in f.chair(rng)], ["cloth", "wood"]),
        (lambda: f.bed(rng), ["wood", "cloth"]),
        (lambda: _boxes(rng), ["any", "print"]),
    )
    make, families = pieces[rng.integers(len(pieces))]
    return make(), families


def _boxes(rng: np.random.Generator) -> list[Shape]:
    """Return two boxes, one on the other."""
    boxes = [box(rng.uniform(0.25, 0.6, 3)).rotate(rotation_about(2, rng.uniform(-30, 30))) for _ in range(2)]
    return [boxes[0], boxes[1].translate([0, 0, boxes[0].vertices[:, 2].max() + 1e-3])]


def _set_table(rng: np.random.Generator) -> list[Shape]:
    """Return [top, legs, objects...] of a table with objects on it."""
    parts = f.table(rng)
    low, high = _extent(parts[:1])
    for spot in scatter(rng, high[:2] - low[:2] - 0.2, int(rng.integers(1, 6)), 0.28):
        size = rng.uniform(0.12, 0.4)
        things = f.lamp(rng, 0.5) if rng.random() < 0.15 else [random_solid(rng).scale(size)]
        parts += [s.translate([*spot, high[2]]) for s in things]
    return parts


def _hangings(
    rng: np.random.Generator, materials: MaterialSampler, turn: Array, length: float, out: float, high: float
) -> list[Body]:
    """Return pictures, windows with curtains or blinds, and shelves on a wall at y = ``out``, rotated by ``turn``."""
    bodies: list[Body] = []
    x = -length / 2 + rng.uniform(0.3, 1.0)
    while x < length / 2 - 1.0:
        kind, wide = rng.random(), rng.uniform(0.6, 1.5)
        if kind < 0.5:
            at = [x + 0.4, out - 0.004, rng.uniform(1.3, 1.8)]
            bodies += _sample_bodies(materials, f.picture(rng), ["print", "wood"], turn, at)
            wide = 0.9
        elif kind < 0.75 and x + wide < length / 2:
            sill, tall = rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.2)
            bodies += _sample_bodies(
                materials, f.window(rng, wide, tall), ["white", "white"], turn, [x, out - 0.003, sill]
            )
            if rng.random() < 0.4:
                bodies += _sample_bodies(materials, f.blinds(rng, wide, tall), ["white"], turn, [x, out - 0.1, sill])
            if rng.random() < 0.6:
                for side in (x - 0.35, x + wide - 0.1):
                    sheet = [curtain(rng, 0.45, min(high - 0.15, sill + tall + 0.2))]
                    bodies += _sample_bodies(materials, sheet, ["cloth"], turn, [side, out - 0.16, 0.03])
        elif kind < 0.85:
            board = [box([wide, 0.2, 0.025]).translate([0, -0.1, 0])]
            board += [
                s.scale(rng.uniform(0.12, 0.25)).translate([rng.uniform(-0.4, 0.4) * wide, -0.1, 0.026])
                for s in (random_solid(rng), vase(rng))
            ]
            bodies += _sample_bodies(
                materials, board, ["wood", "any"], turn, [x + wide / 2, out - 0.003, rng.uniform(1.1, 1.7)]
            )
        x += wide + rng.uniform(0.2, 1.2)
    return bodies


def _middle(rng: np.random.Generator, materials: MaterialSampler, size: Array) -> list[Body]:
    """Return a carpet, a table with chairs, and single objects in the middle of the room."""
    bodies: list[Body] = []
    spot = rng.uniform([-0.2, -0.05], [0.2, 0.2]) * size[:2]
    if rng.random() < 0.5:
        rug = blanket(rng, rng.uniform([1.2, 1.0], [2.4, 1.8]), rng.uniform(0.008, 0.03), 120)
        bodies += _sample_bodies(materials, [rug], ["cloth"], np.eye(3), [*spot, 0.001])
    turn = rotation_about(2, rng.uniform(0, 360))
    if rng.random() < 0.55:
        bodies += _sample_bodies(materials, _set_table(rng), ["wood", "metal", "any"], np.eye(3), [*spot, 0.005])
        for k in range(int(rng.integers(0, 4))):
            seat = [
                s.translate([0, 0.75, 0]).rotate(rotation_about(2, 90 * k + rng.uniform(-20, 20))) for s in f.chair(rng)
            ]
            bodies += _sample_bodies(materials, seat, ["cloth", "wood"], np.eye(3), [*spot, 0.003])
    for _ in range(rng.integers(0, 4)):
        things = [random_solid(rng).scale(rng.uniform(0.2, 0.6))]
        if rng.random() < 0.15:
            things = [figure(rng, 80).scale(rng.uniform(0.8, 1.6))]
        at = rng.uniform([-0.4, -0.15], [0.4, 0.35]) * size[:2]
        bodies += _sample_bodies(materials, [s.rotate(turn) for s in things], ["any"], np.eye(3), [*at, 0.004])
    return bodies


def scatter(rng: np.random.Generator, size: Array, count: int, apart: float) -> list[Array]:
    """Return up to ``count`` points (2,) in a rectangle of ``size`` (2,), ``apart`` metres from each other."""
    spots: list[Array] = []
    for _ in range(6 * count):
        spot = rng.uniform(-0.5, 0.5, 2) * size
        if len(spots) < count and all(np.hypot(*(spot - s)) > apart for s in spots):
            spots.append(spot)
    return spots


def tableware(rng: np.random.Generator, materials: MaterialSampler, size: Array) -> list[Body]:
    """Return objects on a table of ``size`` (2,) metres whose top is at z = 0."""
    bodies: list[Body] = []
    pitch = rng.uniform(0.11, 0.3)
    for spot in scatter(rng, size - 0.1, int(rng.integers(3, 24)), 1.05 * pitch):
        kind = rng.random()
        large = pitch * rng.uniform(0.6, 1.15)
        family = "any"
        if kind < 0.1:
            thing = pebble(rng).scale(large)
        elif kind < 0.16:
            thing = creature(rng, 56).scale(large)
        elif kind < 0.2:
            thing = figure(rng, 64).scale(1.6 * large)
        elif kind < 0.3:
            thing, family = _books(rng, large), "print"
        elif kind < 0.36:
            for part, name in zip(f.pot_plant(rng, 1.6 * large), ("plant", "plant", "stone"), strict=True):
                bodies.append(materials.sample_body(part.translate([*spot, 0]), name, 0.1))
            continue
        elif kind < 0.5:
            thing = (bowl if rng.random() < 0.6 else letter)(rng).scale(large)
        else:
            thing = random_solid(rng).scale(large)
        bodies.append(
            materials.sample_body(
                thing.rotate(rotation_about(2, rng.uniform(0, 360))).translate([*spot, 1e-4]), family, large
            )
        )
    return bodies


def _books(rng: np.random.Generator, large: float) -> Shape:
    """Return a pile of books."""
    z, books = 0.0, []
    for _ in range(rng.integers(1, 6)):
        book = box(large * rng.uniform([0.6, 0.8, 0.08], [0.8, 1.0, 0.22])).rotate(
            rotation_about(2, rng.uniform(-25, 25))
        )
        books.append(book.translate([0, 0, z]))
        z = books[-1].vertices[:, 2].max() + 1e-4
    return merge(books)


def random_object(rng: np.random.Generator) -> tuple[list[Shape], list[str]]:
    """Return an object of 0.1 to 0.6 metres that stands on z = 0: its shapes and the families of their materials."""
    size = rng.uniform(0.12, 0.6)
    things: tuple[tuple[float, Callable[[], list[Shape]], list[str]], ...] = (
        (0.50, lambda: [random_solid(rng).scale(size)], ["any"]),
        (0.08, lambda: [s.scale(1.3 * size) for s in plant(rng)], ["plant", "plant"]),
        (0.10, lambda: [branches(rng).scale(1.6 * size)], ["wood"]),
        (0.08, lambda: [_books(rng, size)], ["print"]),
        (0.03, lambda: [pebble(rng).scale(size)], ["stone"]),
        (0.05, lambda: [creature(rng, 64).scale(size)], ["stone"]),
        (0.04, lambda: [figure(rng, 80).scale(1.3 * size)], ["stone"]),
        (0.06, lambda: [blanket(rng, rng.uniform(0.3, 0.7, 2), rng.uniform(0.05, 0.2), 110)], ["cloth"]),
        (0.06, lambda: [s.scale(0.6) for s in f.chair(rng)], ["wood", "cloth"]),
    )
    _, make, families = things[rng.choice(len(things), p=[weight for weight, _, _ in things])]
    return make(), families


def random_positions(rng: np.random.Generator, count: int) -> list[Array]:
    """Return ``count`` random positions (3,) around the origin for large shapes."""
    if count == 1:
        return [rng.uniform(-0.1, 0.1, 3)]
    return [
        np.array([*spot[:1], rng.uniform(-0.4, 0.4), *spot[1:]]) for spot in scatter(rng, np.full(2, 1.5), count, 0.45)
    ]


def backdrop(rng: np.random.Generator, materials: MaterialSampler, back: float, floor: float) -> list[Body]:
    """Return a background that fills the view: wall and floor, a sweep, a curved wall, a curtain or a relief."""
    kind = rng.integers(5)
    ground = materials.sample_body(box([30, 30, 0.1]).translate([0, 0, floor - 0.101]), "wood", 1.0)
    far = materials.sample_body(quad([-25, back + 6, -10], [50, 0, 0], [0, 0, 40]), "wall", 2.0)
    if kind == 0:
        turn = rotation_about(2, rng.uniform(-25, 25))
        wall = box([24, 0.1, 24]).translate([0, 0.05, -12]).rotate(turn)
        return [ground, far, materials.sample_body(wall.translate([0, back, 0]), "wall", 0.8)]
    if kind == 1:  # a photographer's sweep
        s = np.linspace(0, np.pi / 2, 24)
        radius = rng.uniform(0.3, 1.2)
        y = np.concatenate(([-14], back - radius + radius * np.sin(s), [back]))
        z = floor + np.concatenate(([0], radius * (1 - np.cos(s)), [16]))
        x = np.linspace(-12, 12, 3)
        points = np.stack([np.broadcast_to(a, (26, 3)) for a in (x, y[:, None], z[:, None])], axis=-1)
        slope = np.concatenate(([0], s, [np.pi / 2]))[:, None]
        normals = np.stack([np.broadcast_to(a, (26, 3)) for a in (0 * slope, -np.sin(slope), np.cos(slope))], axis=-1)
        return [far, materials.sample_body(surface(points, normals), "wall", 0.8)]
    if kind == 2:  # a bent wall
        angle, radius = np.linspace(-np.pi, 0, 121) + np.pi / 2, rng.uniform(2.2, 6.0)
        x, y = radius * np.sin(angle), back - radius + radius * np.cos(angle)
        points = np.stack([np.broadcast_to(a, (2, 121)) for a in (x, y, np.array([[-14.0], [14.0]]))], axis=-1)
        return [ground, far, materials.sample_body(surface(points), "wall", 0.8)]
    if kind == 3:
        sheet = curtain(rng, 5.0, 4.0).scale([1, float(rng.uniform(0.5, 2.5)), 1])
        return [ground, far, materials.sample_body(sheet.translate([-2.5, back, floor]), "cloth", 0.5)]
    wall = relief(rng, RELIEFS[rng.integers(len(RELIEFS))], 5.0, 340).rotate(rotation_about(0, 90))
    return [ground, far, materials.sample_body(wall.translate([0, back, 1.0]), "brick", 0.8)]
