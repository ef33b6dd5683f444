"""Parts of layouts: the shell and the contents of rooms, backdrops, things on a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dsr.synthetic.procedural import furniture as f
from dsr.synthetic.procedural.organic import branches, creature, figure, pebble, plant
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.reliefs import RELIEFS, blanket, curtain, relief
from dsr.synthetic.procedural.shape import Shape, about, box, merged, quad, surface
from dsr.synthetic.procedural.solids import any_solid, bowl, letter, vase
from dsr.synthetic.procedural.stage import MaterialSampler
from dsr.synthetic.surfaces import Array


def shell(rng: np.random.Generator, wear: MaterialSampler, size: Array) -> list[Body]:
    """Return floor, ceiling and walls of a room of ``size`` (3,) around the origin of its floor."""
    x, y, z = size
    low = [-x / 2, -y / 2, 0.0]
    walls = [quad(low, [x, 0, 0], [0, 0, z]), quad([-x / 2, y / 2, 0], [x, 0, 0], [0, 0, z])]
    walls += [quad([side * x / 2, -y / 2, 0], [0, y, 0], [0, 0, z]) for side in (-1, 1)]
    bodies = [wear.dress(quad(low, [x, 0, 0], [0, y, 0]), "wood", 1.2)]
    bodies.append(wear.dress(quad([-x / 2, -y / 2, z], [x, 0, 0], [0, y, 0]), "white", 1.0))
    if rng.random() < 0.6:
        bodies.append(wear.dress(merged(walls), "wall", 1.2))
    else:
        bodies += [wear.dress(wall, "wall", 1.2) for wall in walls]
    if rng.random() < 0.6:  # skirting board
        tall = rng.uniform(0.06, 0.15)
        boards = [box([x, 0.02, tall]).moved([0, y / 2 - 0.01, 0])]
        boards += [box([0.02, y, tall]).moved([side * (x / 2 - 0.01), 0, 0]) for side in (-1, 1)]
        bodies.append(wear.dress(merged(boards), "white", 1.0))
    if rng.random() < 0.25:  # the back wall is masonry
        stone = relief(rng, RELIEFS[rng.integers(4)], 1.0, 320).turned(about(0, 90)).moved([0, 0, 0.5])
        bodies.append(wear.dress(stone.stretched([x, 2.0, z]).moved([0, y / 2 - 0.002, 0]), "brick", 1.0))
    return bodies


def fill_room(rng: np.random.Generator, wear: MaterialSampler, size: Array) -> list[Body]:
    """Return furniture along the back and side walls and on the floor, and what hangs on the walls."""
    bodies: list[Body] = []
    for wall, (turn, length) in enumerate(((0, size[0]), (90, size[1]), (-90, size[1]))):
        out = (size[1] if wall == 0 else size[0]) / 2
        x = -length / 2 + rng.uniform(0.1, 0.8)
        while x < length / 2 - 0.6:
            parts, families = _wall_piece(rng)
            low, high = _extent(parts)
            if x + high[0] - low[0] < length / 2 - 0.05:
                shift = np.array([x - low[0], out - high[1] - rng.uniform(0.025, 0.1), 0.0])
                bodies += _dressed(wear, parts, families, about(2, turn), shift)
            x += high[0] - low[0] + rng.uniform(0.05, 1.0)
        bodies += _hangings(rng, wear, about(2, turn), length, out, size[2])
    bodies += _middle(rng, wear, size)
    return bodies


def _extent(parts: Sequence[Shape]) -> tuple[Array, Array]:
    """Return the corners of the box around the shapes."""
    points = np.concatenate([s.vertices for s in parts])
    return points.min(0), points.max(0)


def _dressed(
    wear: MaterialSampler, parts: Sequence[Shape], families: Sequence[str], turn: Array, shift: Array | Sequence[float]
) -> list[Body]:
    """Return the parts, moved by ``shift`` and then turned, each in its material."""
    last = families[-1]
    names = [*families, *[last] * len(parts)]
    return [wear.dress(s.moved(shift).turned(turn), name, 0.6) for s, name in zip(parts, names, strict=False)]


def _wall_piece(rng: np.random.Generator) -> tuple[list[Shape], list[str]]:
    """Return a piece of furniture for the wall, its front to -y, and the families of its materials."""
    pieces: tuple[tuple[Callable[[], list[Shape]], list[str]], ...] = (
        (lambda: f.shelf(rng), ["wood", "any", "print", "cloth", "any"]),
        (lambda: f.cabinet(rng), ["wood", "metal"]),
        (lambda: f.sofa(rng), ["cloth", "cloth"]),
        (lambda: _set_table(rng), ["wood", "metal", "any"]),
        (lambda: f.lamp(rng, rng.uniform(1.2, 1.7)), ["white", "metal"]),
        (lambda: f.pot_plant(rng, rng.uniform(0.6, 1.6)), ["plant", "plant", "stone"]),
        (lambda: [s.turned(about(2, 25.0)) for s in f.chair(rng)], ["cloth", "wood"]),
        (lambda: f.bed(rng), ["wood", "cloth"]),
        (lambda: _boxes(rng), ["any", "print"]),
    )
    make, families = pieces[rng.integers(len(pieces))]
    return make(), families


def _boxes(rng: np.random.Generator) -> list[Shape]:
    """Return a box on a box."""
    boxes = [box(rng.uniform(0.25, 0.6, 3)).turned(about(2, rng.uniform(-30, 30))) for _ in range(2)]
    return [boxes[0], boxes[1].moved([0, 0, boxes[0].vertices[:, 2].max() + 1e-3])]


def _set_table(rng: np.random.Generator) -> list[Shape]:
    """Return a table with things on it: [top, legs, things...]."""
    parts = f.table(rng)
    low, high = _extent(parts[:1])
    for spot in scattered(rng, high[:2] - low[:2] - 0.2, int(rng.integers(1, 6)), 0.28):
        size = rng.uniform(0.12, 0.4)
        things = f.lamp(rng, 0.5) if rng.random() < 0.15 else [any_solid(rng).stretched(size)]
        parts += [s.moved([*spot, high[2]]) for s in things]
    return parts


def _hangings(
    rng: np.random.Generator, wear: MaterialSampler, turn: Array, length: float, out: float, high: float
) -> list[Body]:
    """Return what hangs on a wall at y = ``out``, then turned: pictures, a window with a curtain or blinds, a rail."""
    bodies: list[Body] = []
    x = -length / 2 + rng.uniform(0.3, 1.0)
    while x < length / 2 - 1.0:
        kind, wide = rng.random(), rng.uniform(0.6, 1.5)
        if kind < 0.5:
            at = [x + 0.4, out - 0.004, rng.uniform(1.3, 1.8)]
            bodies += _dressed(wear, f.picture(rng), ["print", "wood"], turn, at)
            wide = 0.9
        elif kind < 0.75 and x + wide < length / 2:
            sill, tall = rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.2)
            bodies += _dressed(wear, f.window(rng, wide, tall), ["white", "white"], turn, [x, out - 0.003, sill])
            if rng.random() < 0.4:
                bodies += _dressed(wear, f.blinds(rng, wide, tall), ["white"], turn, [x, out - 0.1, sill])
            if rng.random() < 0.6:
                for side in (x - 0.35, x + wide - 0.1):
                    sheet = [curtain(rng, 0.45, min(high - 0.15, sill + tall + 0.2))]
                    bodies += _dressed(wear, sheet, ["cloth"], turn, [side, out - 0.16, 0.03])
        elif kind < 0.85:
            board = [box([wide, 0.2, 0.025]).moved([0, -0.1, 0])]
            board += [
                s.stretched(rng.uniform(0.12, 0.25)).moved([rng.uniform(-0.4, 0.4) * wide, -0.1, 0.026])
                for s in (any_solid(rng), vase(rng))
            ]
            bodies += _dressed(wear, board, ["wood", "any"], turn, [x + wide / 2, out - 0.003, rng.uniform(1.1, 1.7)])
        x += wide + rng.uniform(0.2, 1.2)
    return bodies


def _middle(rng: np.random.Generator, wear: MaterialSampler, size: Array) -> list[Body]:
    """Return a carpet, and a table with chairs or single things in the middle of the room."""
    bodies: list[Body] = []
    spot = rng.uniform([-0.2, -0.05], [0.2, 0.2]) * size[:2]
    if rng.random() < 0.5:
        rug = blanket(rng, rng.uniform([1.2, 1.0], [2.4, 1.8]), rng.uniform(0.008, 0.03), 120)
        bodies += _dressed(wear, [rug], ["cloth"], np.eye(3), [*spot, 0.001])
    turn = about(2, rng.uniform(0, 360))
    if rng.random() < 0.55:
        bodies += _dressed(wear, _set_table(rng), ["wood", "metal", "any"], np.eye(3), [*spot, 0.005])
        for k in range(int(rng.integers(0, 4))):
            seat = [s.moved([0, 0.75, 0]).turned(about(2, 90 * k + rng.uniform(-20, 20))) for s in f.chair(rng)]
            bodies += _dressed(wear, seat, ["cloth", "wood"], np.eye(3), [*spot, 0.003])
    for _ in range(rng.integers(0, 4)):
        things = [any_solid(rng).stretched(rng.uniform(0.2, 0.6))]
        if rng.random() < 0.15:
            things = [figure(rng, 80).stretched(rng.uniform(0.8, 1.6))]
        at = rng.uniform([-0.4, -0.15], [0.4, 0.35]) * size[:2]
        bodies += _dressed(wear, [s.turned(turn) for s in things], ["any"], np.eye(3), [*at, 0.004])
    return bodies


def scattered(rng: np.random.Generator, size: Array, count: int, apart: float) -> list[Array]:
    """Return up to ``count`` points (2,) in a rectangle of ``size`` (2,), ``apart`` metres from each other."""
    spots: list[Array] = []
    for _ in range(6 * count):
        spot = rng.uniform(-0.5, 0.5, 2) * size
        if len(spots) < count and all(np.hypot(*(spot - s)) > apart for s in spots):
            spots.append(spot)
    return spots


def tableware(rng: np.random.Generator, wear: MaterialSampler, size: Array) -> list[Body]:
    """Return things on a table of ``size`` (2,) whose top is z = 0."""
    bodies: list[Body] = []
    pitch = rng.uniform(0.11, 0.3)
    for spot in scattered(rng, size - 0.1, int(rng.integers(3, 24)), 1.05 * pitch):
        kind = rng.random()
        large = pitch * rng.uniform(0.6, 1.15)
        family = "any"
        if kind < 0.1:
            thing = pebble(rng).stretched(large)
        elif kind < 0.16:
            thing = creature(rng, 56).stretched(large)
        elif kind < 0.2:
            thing = figure(rng, 64).stretched(1.6 * large)
        elif kind < 0.3:
            thing, family = _books(rng, large), "print"
        elif kind < 0.36:
            for part, name in zip(f.pot_plant(rng, 1.6 * large), ("plant", "plant", "stone"), strict=True):
                bodies.append(wear.dress(part.moved([*spot, 0]), name, 0.1))
            continue
        elif kind < 0.5:
            thing = (bowl if rng.random() < 0.6 else letter)(rng).stretched(large)
        else:
            thing = any_solid(rng).stretched(large)
        bodies.append(wear.dress(thing.turned(about(2, rng.uniform(0, 360))).moved([*spot, 1e-4]), family, large))
    return bodies


def _books(rng: np.random.Generator, large: float) -> Shape:
    """Return a pile of books."""
    z, books = 0.0, []
    for _ in range(rng.integers(1, 6)):
        book = box(large * rng.uniform([0.6, 0.8, 0.08], [0.8, 1.0, 0.22])).turned(about(2, rng.uniform(-25, 25)))
        books.append(book.moved([0, 0, z]))
        z = books[-1].vertices[:, 2].max() + 1e-4
    return merged(books)


def oddment(rng: np.random.Generator) -> tuple[list[Shape], list[str]]:
    """Return a thing of 0.1 to 0.6 metres that stands on z = 0, as shapes and the families of their materials."""
    size = rng.uniform(0.12, 0.6)
    things: tuple[tuple[float, Callable[[], list[Shape]], list[str]], ...] = (
        (0.50, lambda: [any_solid(rng).stretched(size)], ["any"]),
        (0.08, lambda: [s.stretched(1.3 * size) for s in plant(rng)], ["plant", "plant"]),
        (0.10, lambda: [branches(rng).stretched(1.6 * size)], ["wood"]),
        (0.08, lambda: [_books(rng, size)], ["print"]),
        (0.03, lambda: [pebble(rng).stretched(size)], ["stone"]),
        (0.05, lambda: [creature(rng, 64).stretched(size)], ["stone"]),
        (0.04, lambda: [figure(rng, 80).stretched(1.3 * size)], ["stone"]),
        (0.06, lambda: [blanket(rng, rng.uniform(0.3, 0.7, 2), rng.uniform(0.05, 0.2), 110)], ["cloth"]),
        (0.06, lambda: [s.stretched(0.6) for s in f.chair(rng)], ["wood", "cloth"]),
    )
    _, make, families = things[rng.choice(len(things), p=[weight for weight, _, _ in things])]
    return make(), families


def heap(rng: np.random.Generator, count: int) -> list[Array]:
    """Return ``count`` places (3,) around the origin for large shapes."""
    if count == 1:
        return [rng.uniform(-0.1, 0.1, 3)]
    return [
        np.array([*spot[:1], rng.uniform(-0.4, 0.4), *spot[1:]])
        for spot in scattered(rng, np.full(2, 1.5), count, 0.45)
    ]


def backdrop(rng: np.random.Generator, wear: MaterialSampler, back: float, floor: float) -> list[Body]:
    """Return what closes the view: a wall and a floor, a sweep, a curved wall, folds, or a relief."""
    kind = rng.integers(5)
    ground = wear.dress(box([30, 30, 0.1]).moved([0, 0, floor - 0.101]), "wood", 1.0)
    far = wear.dress(quad([-25, back + 6, -10], [50, 0, 0], [0, 0, 40]), "wall", 2.0)
    if kind == 0:
        turn = about(2, rng.uniform(-25, 25))
        wall = box([24, 0.1, 24]).moved([0, 0.05, -12]).turned(turn)
        return [ground, far, wear.dress(wall.moved([0, back, 0]), "wall", 0.8)]
    if kind == 1:  # a photographer's sweep
        s = np.linspace(0, np.pi / 2, 24)
        radius = rng.uniform(0.3, 1.2)
        y = np.concatenate(([-14], back - radius + radius * np.sin(s), [back]))
        z = floor + np.concatenate(([0], radius * (1 - np.cos(s)), [16]))
        x = np.linspace(-12, 12, 3)
        points = np.stack([np.broadcast_to(a, (26, 3)) for a in (x, y[:, None], z[:, None])], axis=-1)
        slope = np.concatenate(([0], s, [np.pi / 2]))[:, None]
        normals = np.stack([np.broadcast_to(a, (26, 3)) for a in (0 * slope, -np.sin(slope), np.cos(slope))], axis=-1)
        return [far, wear.dress(surface(points, normals), "wall", 0.8)]
    if kind == 2:  # a bent wall
        angle, radius = np.linspace(-np.pi, 0, 121) + np.pi / 2, rng.uniform(2.2, 6.0)
        x, y = radius * np.sin(angle), back - radius + radius * np.cos(angle)
        points = np.stack([np.broadcast_to(a, (2, 121)) for a in (x, y, np.array([[-14.0], [14.0]]))], axis=-1)
        return [ground, far, wear.dress(surface(points), "wall", 0.8)]
    if kind == 3:
        sheet = curtain(rng, 5.0, 4.0).stretched([1, float(rng.uniform(0.5, 2.5)), 1])
        return [ground, far, wear.dress(sheet.moved([-2.5, back, floor]), "cloth", 0.5)]
    wall = relief(rng, RELIEFS[rng.integers(len(RELIEFS))], 5.0, 340).turned(about(0, 90))
    return [ground, far, wear.dress(wall.moved([0, back, 1.0]), "brick", 0.8)]
