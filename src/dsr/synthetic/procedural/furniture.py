"""Furniture, fittings and masonry, life-size: functions from a generator to shapes on z = 0 (or hanging on y = 0).

Most return a list of shapes, one for each material. Fronts look along -y.
"""

from __future__ import annotations

import numpy as np

from dsr.synthetic.procedural.organic import plant
from dsr.synthetic.procedural.reliefs import blanket
from dsr.synthetic.procedural.shape import (
    Shape,
    box,
    extrusion,
    frustum,
    hollow,
    lathe,
    merge,
    random_solid,
    ring,
    rounded_box,
    tube,
)
from dsr.synthetic.raycast import Array

Parts = list[Shape]


def _rod(start: Array | list[float], end: Array | list[float], radius: float) -> Shape:
    """Return a round bar."""
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
