"""Parts of layouts: the walls and contents of rooms, backdrops, objects on a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dsr.synthetic.procedural import furniture as f
from dsr.synthetic.procedural.materials import SceneBuilder
from dsr.synthetic.procedural.organic import branches, creature, figure, pebble, plant
from dsr.synthetic.procedural.reliefs import RELIEFS, blanket, curtain, relief
from dsr.synthetic.procedural.shape import Shape, bowl, box, grid, letter, merge, quad, random_solid, surface, vase
from dsr.synthetic.raycast import Array


def shell(rng: np.random.Generator, scene: SceneBuilder, size: Array) -> None:
    """Add floor, ceiling and walls of a room of ``size`` (3,) around the origin of its floor."""
    x, y, z = size
    low = [-x / 2, -y / 2, 0.0]
    walls = [quad(low, [x, 0, 0], [0, 0, z]), quad([-x / 2, y / 2, 0], [x, 0, 0], [0, 0, z])]
    walls += [quad([side * x / 2, -y / 2, 0], [0, y, 0], [0, 0, z]) for side in (-1, 1)]
    scene.add(quad(low, [x, 0, 0], [0, y, 0]), "wood", 1.2)
    scene.add(quad([-x / 2, -y / 2, z], [x, 0, 0], [0, y, 0]), "white", 1.0)
    scene.add_all([merge(walls)] if rng.random() < 0.6 else walls, ["wall"], 1.2)
    if rng.random() < 0.6:  # skirting board
        tall = rng.uniform(0.06, 0.15)
        boards = [box([x, 0.02, tall]).translate(0, y / 2 - 0.01, 0)]
        boards += [box([0.02, y, tall]).translate(side * (x / 2 - 0.01), 0, 0) for side in (-1, 1)]
        scene.add(merge(boards), "white", 1.0)
    if rng.random() < 0.25:  # the back wall is masonry
        stone = relief(rng, RELIEFS[rng.integers(4)], 1.0, 320).turn(0, 90).translate(0, 0, 0.5)
        scene.add(stone.scale([x, 2.0, z]).translate(0, y / 2 - 0.002, 0), "brick", 1.0)


def fill_room(rng: np.random.Generator, scene: SceneBuilder, size: Array) -> None:
    """Add furniture along the back and side walls and in the middle, and what hangs on the walls."""
    pieces = (
        (lambda: f.shelf(rng), ["wood", "any", "print", "cloth", "any"]),
        (lambda: f.cabinet(rng), ["wood", "metal"]),
        (lambda: f.sofa(rng), ["cloth", "cloth"]),
        (lambda: _set_table(rng), ["wood", "metal", "any"]),
        (lambda: f.lamp(rng, rng.uniform(1.2, 1.7)), ["white", "metal"]),
        (lambda: f.pot_plant(rng, rng.uniform(0.6, 1.6)), ["plant", "plant", "stone"]),
        (lambda: [s.turn(2, 25.0) for s in f.chair(rng)], ["cloth", "wood"]),
        (lambda: f.bed(rng), ["wood", "cloth"]),
        (lambda: _boxes(rng), ["any", "print"]),
    )
    for turn, length, out in ((0, size[0], size[1] / 2), (90, size[1], size[0] / 2), (-90, size[1], size[0] / 2)):
        x = -length / 2 + rng.uniform(0.1, 0.8)
        while x < length / 2 - 0.6:
            make, families = pieces[rng.integers(len(pieces))]
            parts = make()
            points = np.concatenate([part.vertices for part in parts])
            low, high = points.min(0), points.max(0)
            if x + high[0] - low[0] < length / 2 - 0.05:
                y = out - high[1] - rng.uniform(0.025, 0.1)
                _place(scene, parts, families, (x - low[0], y, 0.0), turn)
            x += high[0] - low[0] + rng.uniform(0.05, 1.0)
        _hang(rng, scene, turn, length, out, size[2])
    _fill_middle(rng, scene, size)


def _place(
    scene: SceneBuilder, parts: Sequence[Shape], families: Sequence[str], at: Sequence[float], turn: float = 0
) -> None:
    """Add the parts, shifted to ``at`` and then rotated by ``turn`` degrees, each in a material of its family."""
    scene.add_all([part.translate(*at).turn(2, turn) for part in parts], families, 0.6)


def _boxes(rng: np.random.Generator) -> list[Shape]:
    """Return two boxes, one on the other."""
    boxes = [box(rng.uniform(0.25, 0.6, 3)).turn(2, rng.uniform(-30, 30)) for _ in range(2)]
    return [boxes[0], boxes[1].translate(0, 0, boxes[0].vertices[:, 2].max() + 1e-3)]


def _set_table(rng: np.random.Generator) -> list[Shape]:
    """Return [top, legs, objects...] of a table with objects on it."""
    parts = f.table(rng)
    low, high = parts[0].vertices.min(0), parts[0].vertices.max(0)
    for spot in scatter(rng, high[:2] - low[:2] - 0.2, int(rng.integers(1, 6)), 0.28):
        size = rng.uniform(0.12, 0.4)
        things = f.lamp(rng, 0.5) if rng.random() < 0.15 else [random_solid(rng).scale(size)]
        parts += [s.translate(spot[0], spot[1], high[2]) for s in things]
    return parts


def _hang(rng: np.random.Generator, scene: SceneBuilder, turn: float, length: float, out: float, high: float) -> None:
    """Add pictures, windows with curtains or blinds, and shelves on a wall at y = ``out``, rotated by ``turn``."""
    x = -length / 2 + rng.uniform(0.3, 1.0)
    while x < length / 2 - 1.0:
        kind, wide = rng.random(), rng.uniform(0.6, 1.5)
        if kind < 0.5:
            at = x + 0.4, out - 0.004, rng.uniform(1.3, 1.8)
            _place(scene, f.picture(rng), ["print", "wood"], at, turn)
            wide = 0.9
        elif kind < 0.75 and x + wide < length / 2:
            sill, tall = rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.2)
            _place(scene, f.window(rng, wide, tall), ["white"], (x, out - 0.003, sill), turn)
            if rng.random() < 0.4:
                _place(scene, f.blinds(rng, wide, tall), ["white"], (x, out - 0.1, sill), turn)
            if rng.random() < 0.6:
                for side in (x - 0.35, x + wide - 0.1):
                    sheet = curtain(rng, 0.45, min(high - 0.15, sill + tall + 0.2))
                    _place(scene, [sheet], ["cloth"], (side, out - 0.16, 0.03), turn)
        elif kind < 0.85:
            board = [box([wide, 0.2, 0.025]).translate(0, -0.1, 0)]
            for thing in (random_solid(rng), vase(rng)):
                small = thing.scale(rng.uniform(0.12, 0.25))
                board.append(small.translate(rng.uniform(-0.4, 0.4) * wide, -0.1, 0.026))
            at = x + wide / 2, out - 0.003, rng.uniform(1.1, 1.7)
            _place(scene, board, ["wood", "any"], at, turn)
        x += wide + rng.uniform(0.2, 1.2)


def _fill_middle(rng: np.random.Generator, scene: SceneBuilder, size: Array) -> None:
    """Add a carpet, a table with chairs, and single objects in the middle of the room."""
    spot = rng.uniform([-0.2, -0.05], [0.2, 0.2]) * size[:2]
    if rng.random() < 0.5:
        rug = blanket(rng, rng.uniform([1.2, 1.0], [2.4, 1.8]), rng.uniform(0.008, 0.03), 120)
        _place(scene, [rug], ["cloth"], (*spot, 0.001))
    turn = rng.uniform(0, 360)
    if rng.random() < 0.55:
        _place(scene, _set_table(rng), ["wood", "metal", "any"], (*spot, 0.005))
        for k in range(int(rng.integers(0, 4))):
            seat = [s.translate(0, 0.75, 0).turn(2, 90 * k + rng.uniform(-20, 20)) for s in f.chair(rng)]
            _place(scene, seat, ["cloth", "wood"], (*spot, 0.003))
    for _ in range(rng.integers(0, 4)):
        thing = random_solid(rng).scale(rng.uniform(0.2, 0.6))
        if rng.random() < 0.15:
            thing = figure(rng, 80).scale(rng.uniform(0.8, 1.6))
        at = rng.uniform([-0.4, -0.15], [0.4, 0.35]) * size[:2]
        _place(scene, [thing.turn(2, turn)], ["any"], (*at, 0.004))


def scatter(rng: np.random.Generator, size: Array, count: int, apart: float) -> list[Array]:
    """Return up to ``count`` points (2,) in a rectangle of ``size`` (2,), ``apart`` metres from each other."""
    spots: list[Array] = []
    for _ in range(6 * count):
        spot = rng.uniform(-0.5, 0.5, 2) * size
        if len(spots) < count and all(np.hypot(*(spot - s)) > apart for s in spots):
            spots.append(spot)
    return spots


def tableware(rng: np.random.Generator, scene: SceneBuilder, wide: float, deep: float) -> None:
    """Add objects on a table of ``wide`` x ``deep`` metres whose top is at z = 0."""
    pitch = rng.uniform(0.11, 0.3)
    for spot in scatter(rng, np.array([wide, deep]) - 0.1, int(rng.integers(3, 24)), 1.05 * pitch):
        kind = rng.random()
        large = pitch * rng.uniform(0.6, 1.15)
        if 0.3 <= kind < 0.36:
            parts = [part.translate(spot[0], spot[1], 0) for part in f.pot_plant(rng, 1.6 * large)]
            scene.add_all(parts, ["plant", "plant", "stone"], 0.1)
            continue
        family = "any"
        if kind < 0.1:
            thing = pebble(rng).scale(large)
        elif kind < 0.16:
            thing = creature(rng, 56).scale(large)
        elif kind < 0.2:
            thing = figure(rng, 64).scale(1.6 * large)
        elif kind < 0.3:
            thing, family = _books(rng, large), "print"
        elif kind < 0.5:
            thing = (bowl if rng.random() < 0.6 else letter)(rng).scale(large)
        else:
            thing = random_solid(rng).scale(large)
        scene.add(thing.turn(2, rng.uniform(0, 360)).translate(spot[0], spot[1], 1e-4), family, large)


def _books(rng: np.random.Generator, large: float) -> Shape:
    """Return a pile of books."""
    z, books = 0.0, []
    for _ in range(rng.integers(1, 6)):
        book = box(large * rng.uniform([0.6, 0.8, 0.08], [0.8, 1.0, 0.22])).turn(2, rng.uniform(-25, 25))
        books.append(book.translate(0, 0, z))
        z = books[-1].vertices[:, 2].max() + 1e-4
    return merge(books)


def random_object(rng: np.random.Generator) -> tuple[list[Shape], list[str]]:
    """Return an object of 0.1 to 0.6 metres that stands on z = 0: its shapes and the families of their materials."""
    size = rng.uniform(0.12, 0.6)
    things = (
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


def backdrop(rng: np.random.Generator, scene: SceneBuilder, back: float, floor: float) -> None:
    """Add a background that fills the view: wall and floor, a sweep, a curved wall, a curtain or a relief."""
    kind = rng.integers(5)
    scene.add(box([30, 30, 0.1]).translate(0, 0, floor - 0.101), "wood", 1.0)
    if kind == 1:  # a sweep is the floor, too; the ground is taken back, as its draws are part of a scene's numbers
        scene.bodies.pop()
    scene.add(quad([-25, back + 6, -10], [50, 0, 0], [0, 0, 40]), "wall", 2.0)
    if kind == 0:
        wall = box([24, 0.1, 24]).translate(0, 0.05, -12).turn(2, rng.uniform(-25, 25))
        scene.add(wall.translate(0, back, 0), "wall", 0.8)
    elif kind == 1:  # a photographer's sweep
        s = np.linspace(0, np.pi / 2, 24)
        radius = rng.uniform(0.3, 1.2)
        y = np.concatenate(([-14], back - radius + radius * np.sin(s), [back]))
        z = floor + np.concatenate(([0], radius * (1 - np.cos(s)), [16]))
        slope = np.concatenate(([0], s, [np.pi / 2]))[:, None]
        points = grid(np.linspace(-12, 12, 3), y[:, None], z[:, None])
        scene.add(surface(points, grid(np.zeros(3), -np.sin(slope), np.cos(slope))), "wall", 0.8)
    elif kind == 2:  # a bent wall
        angle, radius = np.linspace(-np.pi, 0, 121) + np.pi / 2, rng.uniform(2.2, 6.0)
        x, y = radius * np.sin(angle), back - radius + radius * np.cos(angle)
        scene.add(surface(grid(x, y, np.array([[-14.0], [14.0]]))), "wall", 0.8)
    elif kind == 3:
        sheet = curtain(rng, 5.0, 4.0).scale([1, float(rng.uniform(0.5, 2.5)), 1])
        scene.add(sheet.translate(-2.5, back, floor), "cloth", 0.5)
    else:
        wall = relief(rng, RELIEFS[rng.integers(len(RELIEFS))], 5.0, 340).turn(0, 90)
        scene.add(wall.translate(0, back, 1.0), "brick", 0.8)
