"""Furniture, fittings and masonry, life-size, and what rooms, tables and backgrounds are filled with.

Furniture is made by functions from a generator to shapes on z = 0 (or hanging on y = 0), most of them a list of shapes,
one for each material. Fronts look along -y.
"""

from collections.abc import Sequence

import numpy as np

from dsr.synthetic.procedural import reliefs
from dsr.synthetic.procedural.materials import SceneBuilder
from dsr.synthetic.procedural.reliefs import blanket, branches, creature, curtain, figure, pebble, plant
from dsr.synthetic.procedural.shape import (
    Shape,
    bowl,
    box,
    extrusion,
    frustum,
    grid,
    hollow,
    lathe,
    letter,
    merge,
    quad,
    random_solid,
    ring,
    rounded_box,
    surface,
    tube,
    vase,
)
from dsr.synthetic.raycast import Array

Parts = list[Shape]


def _rod(start: Array | list[float], end: Array | list[float], radius: float) -> Shape:
    return tube(np.linspace(start, end, 3), radius, 14)


def table(rng: np.random.Generator, size: tuple[float, float] | None = None, height: float | None = None) -> Parts:
    """Return [top, legs] of a table, desk or stool."""
    wide, deep = rng.uniform([0.8, 0.5], [1.8, 1.0]) if size is None else size
    high = rng.uniform(0.4, 0.8) if height is None else height
    thick, inset = rng.uniform(0.02, 0.06), rng.uniform(0.03, 0.1)
    kind = rng.integers(4)
    if kind == 0:  # round, on one foot
        radius = min(wide, deep) / 2
        foot = merge([frustum(0.6 * radius, 0.55 * radius, 0.03), frustum(0.04, 0.04, high - thick)])
        return [frustum(radius, radius, thick).translate(0, 0, high - thick), foot]
    top = rounded_box(np.array([wide, deep, thick]), 0.3 * thick, 4).translate(0, 0, high - thick)
    spots = [(sx * (wide / 2 - inset), sy * (deep / 2 - inset)) for sx in (-1, 1) for sy in (-1, 1)]
    if kind == 1:  # slanted round legs
        legs = [_rod([0.9 * x, 0.9 * y, high - thick], [x, y, 0], rng.uniform(0.015, 0.03)) for x, y in spots]
        return [top, merge(legs)]
    if kind == 2:  # two side boards
        side = box([thick, 0.94 * deep, high - thick])
        return [top, merge([side.translate(s * (wide / 2 - inset), 0, 0) for s in (-1, 1)])]
    leg = box([*[rng.uniform(0.035, 0.08)] * 2, high - thick])
    rail = box([wide - 2 * inset, 0.02, 0.08])
    rails = [rail.translate(0, s * (deep / 2 - inset), high - thick - 0.08) for s in (-1, 1)]
    return [top, merge([leg.translate(x, y, 0) for x, y in spots] + rails)]


def chair(rng: np.random.Generator) -> Parts:
    """Return [seat and back, legs and slats] of a chair."""
    wide, deep, seat, back = rng.uniform([0.38, 0.38, 0.42, 0.4], [0.5, 0.5, 0.5, 0.65])
    pillow = rounded_box(np.array([wide, deep, 0.05]), 0.02, 5).translate(0, 0, seat - 0.05)
    radius = rng.uniform(0.012, 0.025)
    bars = []
    for s in (-1, 1):
        x = s * (wide / 2 - 0.03)
        bars.append(_rod([x, -deep / 2 + 0.03, seat - 0.03], [1.08 * x, -deep / 2, 0], radius))
        bars.append(_rod([x, deep / 2 - 0.03, seat + back], [x, deep / 2 - 0.02, 0], radius))
    if rng.random() < 0.5:  # slats or spindles
        for k in range(int(rng.integers(3, 7))):
            x = (k + 0.5) / 6.5 * wide - wide / 2 + 0.03
            bars.append(_rod([x, deep / 2 - 0.03, seat], [x, deep / 2 - 0.03, seat + 0.92 * back], 0.4 * radius))
        board = box([wide - 0.04, 0.02, 0.08])
        return [merge([pillow, board.translate(0, deep / 2 - 0.03, seat + back - 0.1)]), merge(bars)]
    panel = rounded_box(np.array([wide - 0.03, 0.035, 0.7 * back]), 0.015, 4)
    return [merge([pillow, panel.translate(0, deep / 2 - 0.03, seat + 0.28 * back)]), merge(bars)]


def sofa(rng: np.random.Generator) -> Parts:
    """Return [body, cushions] of an armchair or a sofa."""
    seats = int(rng.integers(1, 4))
    width, deep, seat = 0.62 * seats, rng.uniform(0.6, 0.75), rng.uniform(0.36, 0.45)
    arm, r = rng.uniform(0.12, 0.22), rng.uniform(0.02, 0.07)
    body = [rounded_box(np.array([width + 2 * arm, deep, seat - 0.12]), 0.02).translate(0, 0, 0.03)]
    high = seat + rng.uniform(0.1, 0.25)
    body += [rounded_box(np.array([arm, deep, high]), r).translate(s * (width + arm) / 2, 0, 0.02) for s in (-1, 1)]
    body += [rounded_box(np.array([width + 1.6 * arm, 0.2, seat + 0.42]), r).translate(0, deep / 2 - 0.08, 0.02)]
    soft = []
    for k in range(seats):
        x = (k - (seats - 1) / 2) * 0.62
        soft.append(rounded_box(np.array([0.6, deep - 0.18, 0.16]), 0.05).translate(x, -0.07, seat - 0.1))
        pillow = blanket(rng, np.array([0.5, 0.45]), 0.13, 60).turn(0, 68 + rng.uniform(-8, 8))
        soft.append(pillow.turn(2, rng.uniform(-15, 15)).translate(x, deep / 2 - 0.3, seat + 0.28))
    return [merge(body), merge(soft)]


def shelf(rng: np.random.Generator) -> Parts:
    """Return [boards, and one shape for each group of things] of a bookcase with its back at the largest y."""
    wide, deep = rng.uniform(0.6, 1.6), rng.uniform(0.25, 0.4)
    rows = int(rng.integers(3, 6))
    pitch, thick = rng.uniform(0.28, 0.4), rng.uniform(0.015, 0.035)
    boards = [box([wide - thick, deep - 0.005, thick]).translate(0, 0, k * pitch) for k in range(rows + 1)]
    side = box([thick, deep, rows * pitch + thick])
    boards += [side.translate(s * wide / 2, 0, 0.001) for s in (-1, 1)]
    if rng.random() < 0.7:
        boards.append(box([wide - thick, 0.01, rows * pitch]).translate(0, deep / 2 - 0.006, 0.002))
    groups: list[Parts] = [[], [], [], []]
    for k in range(rows):
        x = -wide / 2 + 2 * thick
        while x < wide / 2 - 0.12:
            step = _shelf_item(rng, groups, np.array([x, deep, k * pitch + thick]), pitch - 2 * thick)
            x += step
    return [merge(boards), *[merge(group) for group in groups if group]]


def _shelf_item(rng: np.random.Generator, groups: list[Parts], at: Array, room: float) -> float:
    """Add a book, a thing or a gap at ``at`` = (x, depth of the board, z) and return its width."""
    kind = rng.random()
    group = groups[rng.integers(4)]
    if kind < 0.78:
        wide, high, deep = rng.uniform(0.015, 0.06), rng.uniform(0.55, 0.95) * room, rng.uniform(0.5, 0.85) * at[1]
        book = box([wide - 0.002, deep, high])
        if rng.random() < 0.08:
            lean = rng.uniform(5, 14)
            book = book.turn(1, lean)
            book = book.translate(0, 0, -book.vertices[:, 2].min())
            wide += 0.25 * high
        group.append(book.translate(at[0] + wide / 2, -at[1] / 2 + deep / 2 + rng.uniform(0.01, 0.04), at[2]))
        return float(wide)
    if kind < 0.9:
        size = rng.uniform(0.1, 0.9 * min(room, at[1]))
        thing = random_solid(rng).scale(size)
        wide = np.ptp(thing.vertices[:, 0])
        if np.ptp(thing.vertices[:, 2]) < room and wide < 0.25:
            group.append(thing.translate(at[0] + wide / 2, rng.uniform(-0.2, 0.1) * at[1], at[2]))
        return float(wide + 0.02)
    return float(rng.uniform(0.03, 0.15))


def cabinet(rng: np.random.Generator) -> Parts:
    """Return [body with doors or drawers, knobs] of a cupboard or chest."""
    wide, deep, high = rng.uniform([0.5, 0.35, 0.5], [1.4, 0.6, 2.0])
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    body, knobs = [box([wide, deep, high])], []
    gap, out = rng.uniform(0.006, 0.02), rng.uniform(0.008, 0.03)
    w, h = wide / columns, (high - 0.06) / rows
    for i in range(columns):
        for j in range(rows):
            x, z = (i + 0.5) * w - wide / 2, 0.05 + j * h
            body.append(box([w - 2 * gap, out, h - 2 * gap]).translate(x, -deep / 2 - out / 2 + 1e-3, z + gap))
            knob = frustum(0.014, 0.018, 0.03).turn(0, 90)
            knobs.append(knob.translate(x + 0.35 * w * (rows < 3), -deep / 2 - out, z + 0.5 * h))
    return [merge(body), merge(knobs)]


def lamp(rng: np.random.Generator, height: float) -> Parts:
    """Return [shade, stand] of a lamp."""
    base, top = rng.uniform(0.1, 0.22) * np.sqrt(height), rng.uniform(0.06, 0.15) * np.sqrt(height)
    tall = rng.uniform(0.18, 0.3) * height
    outside = np.array([[base, height - tall], [top, height]])
    shade = lathe([outside, outside - [4e-3, 0]])
    foot = frustum(0.7 * base, 0.6 * base, 0.03)
    return [shade, merge([foot, frustum(0.012, 0.012, height - 0.3 * tall)])]


def pot_plant(rng: np.random.Generator, height: float) -> Parts:
    """Return [leaves, stems, pot] of a plant."""
    leaves, stems = plant(rng)
    wide = rng.uniform(0.1, 0.2)
    pot = hollow(wide * np.array([0.7, 0.85, 1.0, 1.05]), 0.28, 0.015)
    earth = frustum(0.85 * wide, 0.85 * wide, 0.02).translate(0, 0, 0.2)
    parts = leaves.translate(0, 0, 0.2), merge([stems.translate(0, 0, 0.2), earth]), pot
    return [part.scale(height / 1.2) for part in parts]


def blinds(rng: np.random.Generator, width: float, height: float) -> Parts:
    """Return [slats] of a blind, or a grille's [bars], in the plane y = 0 from the origin to (width, 0, height)."""
    pitch = rng.uniform(0.03, 0.09)
    count = int(height / pitch)
    if rng.random() < 0.6:
        slat = box([width, 0.8 * pitch, 0.003]).turn(0, rng.uniform(-70, 70))
        return [merge([slat.translate(width / 2, 0, (k + 0.5) * pitch) for k in range(count)])]
    radius = rng.uniform(0.005, 0.015)
    bars = [_rod([x, 0, 0], [x, 0, height], radius) for x in np.arange(0, width, 1.6 * pitch)]
    bars += [_rod([0, 0, z], [width, 0, z], 1.5 * radius) for z in (0.0, height)]
    return [merge(bars)]


def window(rng: np.random.Generator, width: float, height: float) -> Parts:
    """Return [pane, frame] around (0, 0, 0) to (width, height) in x and z on the wall y = 0."""
    rim, out = rng.uniform(0.04, 0.09), rng.uniform(0.02, 0.06)
    columns, rows = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    outer = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float64)
    w, h = (width - rim) / columns, (height - rim) / rows
    holes = []
    for i in range(columns):
        for j in range(rows):
            low, high = np.array([i * w, j * h]) + rim, np.array([(i + 1) * w, (j + 1) * h])
            holes.append(np.array([low, [low[0], high[1]], high, [high[0], low[1]]]))
    frame = extrusion([outer, *holes], out).turn(0, 90)
    pane = box([width - rim, 0.004, height - rim]).translate(width / 2, 0, rim / 2)
    return [pane, frame]


def picture(rng: np.random.Generator) -> Parts:
    """Return [picture, frame] of a framed picture around the origin on the wall y = 0."""
    wide, high = rng.uniform(0.25, 0.9, 2)
    rim, out = rng.uniform(0.015, 0.06), rng.uniform(0.01, 0.04)
    outer = np.array([[-wide, -high], [wide, -high], [wide, high], [-wide, high]]) / 2
    inner = (outer - np.sign(outer) * rim)[::-1]
    frame = extrusion([outer, inner], out).turn(0, 90)
    sheet = box([wide - rim, 0.004, high - rim]).translate(0, 0, -(high - rim) / 2)
    return [sheet, frame]


def bed(rng: np.random.Generator) -> Parts:
    """Return [frame, bedding] of a bed whose head is at the largest y."""
    wide, long, high = rng.uniform([0.9, 1.9, 0.3], [1.6, 2.1, 0.5])
    base, head = box([wide, long, 0.6 * high]), box([wide, 0.05, high + 0.5])
    bedding = [rounded_box(np.array([wide, long - 0.05, 0.2]), 0.06).translate(0, -0.02, high - 0.18)]
    bedding.append(blanket(rng, np.array([wide + 0.1, 1.3]), 0.14, 200).translate(0, -0.3, high - 0.03))
    for s in (-1, 1) if wide > 1.2 else (0,):
        bedding.append(blanket(rng, np.array([0.6, 0.4]), 0.16, 80).translate(s * wide / 4, long / 2 - 0.3, high))
    return [merge([base.translate(0, 0, 0.05), head.translate(0, long / 2, 0)]), merge(bedding)]


def column(rng: np.random.Generator, high: float) -> Shape:
    """Return a round, fluted or square column with base and capital, ``high`` metres tall."""
    radius = rng.uniform(0.16, 0.32)
    kind = rng.integers(3)
    if kind == 0:
        shaft = hollow(radius * np.array([1.0, 1.03, 0.98, 0.85]), high - 0.4, 0.02)
    elif kind == 1:
        angle = np.arange(192) * 2 * np.pi / 192
        flutes = radius * (1 - 0.07 * np.abs(np.sin(angle * 10)))
        shaft = extrusion([ring(flutes, 192)], high - 0.4)
    else:
        shaft = box([1.7 * radius, 1.7 * radius, high - 0.4])
    plate = box([2.8 * radius, 2.8 * radius, 0.12])
    foot = frustum(1.3 * radius, 1.05 * radius, 0.1).translate(0, 0, 0.12)
    neck = frustum(radius, 1.35 * radius, 0.15).translate(0, 0, high - 0.27)
    return merge([shaft.translate(0, 0, 0.2), plate, plate.translate(0, 0, high - 0.121), foot, neck])


def arched_wall(rng: np.random.Generator, wide: float, high: float, back: float) -> Parts:
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
    wall = extrusion([outline, *holes], thick).turn(0, 90).translate(0, back, 0)
    return [wall, box([2 * wide, 0.05, high + 1]).translate(0, back + 0.05, -1)]


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
        stone = reliefs.relief(rng, reliefs.RELIEFS[rng.integers(4)], 1.0, 320).turn(0, 90).translate(0, 0, 0.5)
        scene.add(stone.scale([x, 2.0, z]).translate(0, y / 2 - 0.002, 0), "brick", 1.0)


def fill_room(rng: np.random.Generator, scene: SceneBuilder, size: Array) -> None:
    """Add furniture along the back and side walls and in the middle, and what hangs on the walls."""
    pieces = (
        (lambda: shelf(rng), ["wood", "any", "print", "cloth", "any"]),
        (lambda: cabinet(rng), ["wood", "metal"]),
        (lambda: sofa(rng), ["cloth", "cloth"]),
        (lambda: _set_table(rng), ["wood", "metal", "any"]),
        (lambda: lamp(rng, rng.uniform(1.2, 1.7)), ["white", "metal"]),
        (lambda: pot_plant(rng, rng.uniform(0.6, 1.6)), ["plant", "plant", "stone"]),
        (lambda: [s.turn(2, 25.0) for s in chair(rng)], ["cloth", "wood"]),
        (lambda: bed(rng), ["wood", "cloth"]),
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
    boxes = [box(rng.uniform(0.25, 0.6, 3)).turn(2, rng.uniform(-30, 30)) for _ in range(2)]
    return [boxes[0], boxes[1].translate(0, 0, boxes[0].vertices[:, 2].max() + 1e-3)]


def _set_table(rng: np.random.Generator) -> list[Shape]:
    """Return [top, legs, objects...] of a table with objects on it."""
    parts = table(rng)
    low, high = parts[0].vertices.min(0), parts[0].vertices.max(0)
    for spot in scatter(rng, high[:2] - low[:2] - 0.2, int(rng.integers(1, 6)), 0.28):
        size = rng.uniform(0.12, 0.4)
        things = lamp(rng, 0.5) if rng.random() < 0.15 else [random_solid(rng).scale(size)]
        parts += [s.translate(spot[0], spot[1], high[2]) for s in things]
    return parts


def _hang(rng: np.random.Generator, scene: SceneBuilder, turn: float, length: float, out: float, high: float) -> None:
    """Add pictures, windows with curtains or blinds, and shelves on a wall at y = ``out``, rotated by ``turn``."""
    x = -length / 2 + rng.uniform(0.3, 1.0)
    while x < length / 2 - 1.0:
        kind, wide = rng.random(), rng.uniform(0.6, 1.5)
        if kind < 0.5:
            at = x + 0.4, out - 0.004, rng.uniform(1.3, 1.8)
            _place(scene, picture(rng), ["print", "wood"], at, turn)
            wide = 0.9
        elif kind < 0.75 and x + wide < length / 2:
            sill, tall = rng.uniform(0.7, 1.0), rng.uniform(0.9, 1.2)
            _place(scene, window(rng, wide, tall), ["white"], (x, out - 0.003, sill), turn)
            if rng.random() < 0.4:
                _place(scene, blinds(rng, wide, tall), ["white"], (x, out - 0.1, sill), turn)
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
            seat = [s.translate(0, 0.75, 0).turn(2, 90 * k + rng.uniform(-20, 20)) for s in chair(rng)]
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
            parts = [part.translate(spot[0], spot[1], 0) for part in pot_plant(rng, 1.6 * large)]
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
        (0.06, lambda: [s.scale(0.6) for s in chair(rng)], ["wood", "cloth"]),
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
        wall = reliefs.relief(rng, reliefs.RELIEFS[rng.integers(len(reliefs.RELIEFS))], 5.0, 340).turn(0, 90)
        scene.add(wall.translate(0, back, 1.0), "brick", 0.8)
