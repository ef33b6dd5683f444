"""Materials of random scenes: random paints, pictures as paint, and highlights, sampled for each shape.

A paint maps points (3, N) in a shape's own frame and the chart (3, N), two surface coordinates in metres and a tone,
to linear RGB (3, N). ``scale`` is the size of the painted object in metres. Most patterns are independent of the
shape's edges, so that a network learns not to take edges of texture for edges of depth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dsr.synthetic.procedural.reliefs import spectrum
from dsr.synthetic.procedural.shape import Shape, random_rotation
from dsr.synthetic.raycast import TILT, Array, mix, noise

Paint = Callable[[Array, Array], Array]
_FAMILIES = {
    "wood": ((0.40, 0.22, 0.10), (0.16, 0.07, 0.03), (0.60, 0.42, 0.24), (0.30, 0.15, 0.07)),
    "stone": ((0.55, 0.52, 0.47), (0.33, 0.31, 0.29), (0.70, 0.66, 0.58), (0.20, 0.19, 0.19)),
    "wall": ((0.78, 0.75, 0.70), (0.60, 0.62, 0.60), (0.72, 0.64, 0.50), (0.45, 0.52, 0.58), (0.82, 0.82, 0.80)),
    "brick": ((0.42, 0.14, 0.08), (0.30, 0.10, 0.07), (0.52, 0.26, 0.15), (0.24, 0.14, 0.11)),
    "plant": ((0.05, 0.16, 0.03), (0.12, 0.28, 0.06), (0.25, 0.33, 0.09), (0.03, 0.08, 0.03)),
    "metal": ((0.45, 0.45, 0.46), (0.25, 0.25, 0.27), (0.60, 0.52, 0.35), (0.08, 0.08, 0.09)),
    "earth": ((0.30, 0.22, 0.14), (0.16, 0.12, 0.08), (0.45, 0.38, 0.26), (0.22, 0.24, 0.12)),
    "white": ((0.80, 0.80, 0.78), (0.74, 0.73, 0.70), (0.66, 0.66, 0.67)),
}


def palette(rng: np.random.Generator, family: str, count: int = 4) -> Array:
    """Return ``count`` linear RGB colours (count, 3) of a material, or of any colour for "any"."""
    if family in _FAMILIES:
        table = np.array(_FAMILIES[family])
        picked = table[rng.integers(len(table), size=count)]
        return np.clip(picked * rng.uniform(0.75, 1.25) * (1 + 0.08 * rng.normal(size=(count, 3))), 0.015, 0.9)
    base, spread = rng.uniform(), rng.uniform(0.02, 0.5)
    hue = base + spread * rng.normal(size=count)
    grey, light = 0.85 * rng.uniform() ** 1.8, rng.uniform(0.03, 0.85, count) ** rng.uniform(0.7, 1.8)
    tint = 0.5 + 0.5 * np.cos(2 * np.pi * (hue[:, None] + np.array([0.0, 1 / 3, 2 / 3])))
    return np.clip(light[:, None] * (grey * tint / tint.max(1, keepdims=True) + 1 - grey), 0.012, 0.9)


def fractal(points: Array, cell: float, seed: int | np.int64, octaves: int = 3) -> Array:
    """Return noise in about [0, 1] of several scales, the coarsest ``cell`` metres, shape (N,)."""
    place = TILT @ points
    total = sum(0.5**k * noise(place + 0.37 * k * cell, cell * 0.47**k, seed + k) for k in range(octaves))
    return np.asarray(total / (2 - 0.5 ** (octaves - 1)))


def solid_colour(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return a nearly uniform colour."""
    colour = palette(rng, family, 1)[0][:, None]
    depth, cell, seed = rng.choice([0.0, 0.06, 0.25]), scale * rng.uniform(0.05, 0.4), rng.integers(1 << 31)
    return lambda p, chart: colour * (1 + depth * (fractal(p, cell, seed, 2) - 0.5))


def clouds(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return blotches of several colours, soft or hard."""
    colours, seed, cell = palette(rng, family), rng.integers(1 << 31), scale * np.exp(rng.uniform(-4.0, -0.7))
    hard, octaves = rng.choice([1.0, 2.5, 9.0]), int(rng.integers(1, 5))
    return lambda p, chart: mix(colours, np.clip(hard * (fractal(p, cell, seed, octaves) - 0.5) + 0.5, 0, 1))


def veins(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return marble."""
    colours, seed, cell = palette(rng, family), rng.integers(1 << 31), scale * rng.uniform(0.15, 0.7)
    wave = rng.normal(size=(1, 3)) * rng.uniform(4, 25) / scale
    bend, sharp = rng.uniform(3, 14), rng.choice([1.0, 3.0])

    def paint(p: Array, chart: Array) -> Array:
        swing = np.abs(np.sin((wave @ p)[0] + bend * fractal(p, cell, seed, 4)))
        return mix(colours, 1 - (1 - swing) ** sharp)

    return paint


def grain(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return wood: stretched rings with fibres, in planks or whole."""
    colours, seed = palette(rng, family), rng.integers(1 << 31)
    plank = scale * rng.choice([0.0, 0.06, 0.12, 0.25])
    rings, along = rng.uniform(25, 120) / max(scale, 0.3), int(rng.integers(2))
    thin = rng.uniform(0.004, 0.02)

    def paint(p: Array, chart: Array) -> Array:
        u, v = chart[along], chart[1 - along]
        board = np.floor(v / plank) if plank else 0 * v
        place = np.stack((0.12 * u + 7.3 * board, v, 0.6 * p[2] + 3.1 * board))
        ring = 0.5 + 0.5 * np.sin(rings * (v + 0.4 * noise(place, 0.25 * scale, seed)) + 5 * board)
        fibre = noise(np.stack((0.04 * u + board, v, 0 * v)), 0.004 * max(scale, 0.5), seed + 1)
        colour = mix(colours, np.clip(0.55 * ring + 0.3 * fibre + 0.25 * np.sin(2.3 * board), 0, 1))
        if plank:
            colour = colour * np.where(np.abs(v / plank - board - 0.5) > 0.5 - thin, 0.3, 1.0)
        return colour

    return paint


def bricks(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return bricks, tiles or parquet with joints, painted on."""
    colours, joint, seed = palette(rng, family), palette(rng, "stone", 1)[0][:, None], rng.integers(1 << 31)
    high, aspect = scale * np.exp(rng.uniform(-3.6, -1.6)), rng.choice([1.0, 1.0, 2.0, 3.0, 6.0])
    shift, thin, mottle = rng.choice([0.0, 0.5]), rng.uniform(0.01, 0.08), rng.uniform(0, 0.6)
    table = rng.random((64, 64))

    def paint(p: Array, chart: Array) -> Array:
        v = chart[1] / high
        row = np.floor(v)
        u = chart[0] / (high * aspect) + shift * (row % 2)
        column = np.floor(u)
        tile = table[row.astype(np.intp) & 63, column.astype(np.intp) & 63]
        edge = np.minimum((0.5 - np.abs(u - column - 0.5)) * aspect, 0.5 - np.abs(v - row - 0.5))
        colour = mix(colours, tile) * (1 + mottle * (fractal(p, 0.4 * high, seed, 3) - 0.5))
        return np.where(edge < thin, joint, colour)

    return paint


def stripes(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return stripes or a plaid."""
    colours, period = palette(rng, family), scale * np.exp(rng.uniform(-4.0, -1.0))
    angle = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
    sharp, plaid, bend = rng.choice([1.0, 8.0, 30.0]), rng.random() < 0.35, rng.choice([0.0, 0.0, 1.2])
    seed = rng.integers(1 << 31)

    def band(value: Array) -> Array:
        return 0.5 + 0.5 * np.clip(sharp * np.sin(2 * np.pi * value / period), -1, 1)

    def paint(p: Array, chart: Array) -> Array:
        wobble = bend * period * fractal(p, 4 * period, seed, 2)
        along = np.cos(angle) * chart[0] + np.sin(angle) * chart[1] + wobble
        across = np.cos(angle) * chart[1] - np.sin(angle) * chart[0]
        value = 0.5 * band(along) + 0.5 * band(0.7 * across) if plaid else band(along)
        return mix(colours, value)

    return paint


def dots(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return dots, rings, diamonds or little crosses on a lattice."""
    colours, period = palette(rng, family), scale * np.exp(rng.uniform(-3.6, -1.3))
    kind, size, jump = int(rng.integers(4)), rng.uniform(0.15, 0.42), rng.choice([0.0, 0.5])
    table = rng.random((64, 64))

    def paint(p: Array, chart: Array) -> Array:
        v = chart[1] / period
        row = np.floor(v)
        u = chart[0] / period + jump * (row % 2)
        x, y = np.abs(u - np.floor(u) - 0.5), np.abs(v - row - 0.5)
        tile = table[row.astype(np.intp) & 63, np.floor(u).astype(np.intp) & 63]
        measure = (np.hypot(x, y), np.abs(np.hypot(x, y) - 0.3) + 0.1, x + y, np.minimum(x, y) + 0.15)[kind]
        return np.where(measure < size, mix(colours[1:], tile), colours[0][:, None])

    return paint


def shards(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return flat colours that meet at straight or wavy lines in space: camouflage, patchwork, painted facets."""
    colours, count = palette(rng, family, 6), int(rng.integers(3, 7))
    planes = rng.normal(size=(count, 3)) * rng.uniform(1.0, 6.0) / scale
    offsets, seed, bend = rng.uniform(0, 5, (count, 1)), rng.integers(1 << 31), rng.choice([0.0, 0.5, 2.0])
    table = rng.random(4096)

    def paint(p: Array, chart: Array) -> Array:
        cells = np.floor(planes @ p + offsets + bend * fractal(p, 0.4 * scale, seed, 2)).astype(np.int64)
        key = (cells * np.array([[1], [7], [31], [173], [911], [4111]])[:count]).sum(0) & 4095
        return mix(colours, table[key])

    return paint


def toned(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return colours that follow the chart's tone, as dirt in grooves: texture that correlates with geometry."""
    colours, seed, cell = palette(rng, family), rng.integers(1 << 31), scale * rng.uniform(0.02, 0.2)
    blend = rng.uniform(0.0, 0.5)
    return lambda p, chart: mix(colours, np.clip((1 - blend) * chart[2] + blend * fractal(p, cell, seed), 0, 1))


def speckles(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return granite, terrazzo, gravel or coarse cloth."""
    colours, seed, cell = palette(rng, family), rng.integers(1 << 31), scale * np.exp(rng.uniform(-5.2, -3.0))
    turn = random_rotation(rng)

    def paint(p: Array, chart: Array) -> Array:
        value = noise(turn @ p, cell, seed) * 0.6 + 0.4 * noise(p, 2.7 * cell, seed + 1)
        return mix(colours, np.clip(2.2 * (value - 0.5) + 0.5, 0, 1))

    return paint


def woven(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return cloth: herringbone or plain weave with a fine grain."""
    colours, seed, period = palette(rng, family, 3), rng.integers(1 << 31), scale * np.exp(rng.uniform(-4.5, -2.5))
    zig = rng.choice([0.0, 3.0, 6.0])

    def paint(p: Array, chart: Array) -> Array:
        u, v = chart[0] / period, chart[1] / period
        turn = np.abs((u / max(zig, 1.0)) % 1 - 0.5) * zig
        warp, weft = np.clip(3 * np.sin(2 * np.pi * (v + turn)), -1, 1), np.sin(2 * np.pi * u) * (zig == 0)
        value = 0.5 + 0.25 * warp + 0.2 * weft
        return mix(colours, np.clip(value + 0.4 * (noise(p, 0.5 * period, seed) - 0.5), 0, 1))

    return paint


PAINTS = (solid_colour, clouds, veins, grain, bricks, stripes, dots, shards, toned, speckles, woven)

Image = NDArray[np.uint8]  # (S, S, 3); a value stands for the linear light (value / 255)**2
_SIDE = 384
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_DUPLEX)
_LETTERS = list("abcdefghijklmnoprstuvwyz      ")


def _colour(rng: np.random.Generator, colours: Array) -> tuple[float, ...]:
    return _ink(colours[rng.integers(len(colours))])


def _ink(linear: Array) -> tuple[float, ...]:
    """Return a linear colour (3,) as it is drawn."""
    return tuple(float(c) for c in np.rint(255 * np.sqrt(np.clip(linear, 0, 1))))


def _random_pixels(rng: np.random.Generator, low: float, high: float) -> int:
    """Return a random number of pixels between two fractions of the picture's side."""
    return int(rng.uniform(low, high) * _SIDE)


def poster(rng: np.random.Generator, colours: Array) -> Image:
    """Return rectangles, discs, lines and a title."""
    image = np.full((_SIDE, _SIDE, 3), _colour(rng, colours), dtype=np.uint8)
    for _ in range(rng.integers(3, 16)):
        x, y = _random_pixels(rng, -0.1, 1), _random_pixels(rng, -0.1, 1)
        kind, width = rng.integers(4), int(rng.choice([-1, -1, 2, 6]))
        if kind == 0:
            corner = (x + _random_pixels(rng, 0.05, 0.6), y + _random_pixels(rng, 0.05, 0.6))
            cv2.rectangle(image, (x, y), corner, _colour(rng, colours), width)
        elif kind == 1:
            cv2.circle(image, (x, y), _random_pixels(rng, 0.03, 0.3), _colour(rng, colours), width, cv2.LINE_AA)
        elif kind == 2:
            corners = rng.integers(0, _SIDE, (3, 2)).astype(np.int32)
            cv2.fillPoly(image, [corners], _colour(rng, colours), cv2.LINE_AA)
        else:
            _word(rng, image, (x, y), rng.uniform(0.8, 4.0), _colour(rng, colours))
    return image


def _word(rng: np.random.Generator, image: Image, at: tuple[int, int], size: float, colour: tuple[float, ...]) -> None:
    text = "".join(rng.choice(_LETTERS, rng.integers(3, 10)))
    text = text.upper() if rng.random() < 0.5 else text
    face = _FONTS[rng.integers(len(_FONTS))]
    cv2.putText(image, text, at, face, size, colour, max(1, round(1.5 * size)), cv2.LINE_AA)


def page(rng: np.random.Generator, colours: Array) -> Image:
    """Return lines of text, some of them with a figure, dark on light."""
    paper = rng.uniform(0.5, 0.85) * rng.uniform([0.9, 0.88, 0.75], 1.0)
    image = np.full((_SIDE, _SIDE, 3), _ink(paper), dtype=np.uint8)
    size, ink = rng.uniform(0.3, 0.9), _ink(np.array([0.03, 0.03, 0.04]))
    y = int(30 * size) + 12
    _word(rng, image, (16, y + 12), 2 * size, ink)
    y += int(60 * size)
    while y < _SIDE - 8:
        text = "".join(rng.choice(_LETTERS, int(rng.uniform(0.6, 1.0) * 21 / size)))
        cv2.putText(image, text, (14, y), _FONTS[0], size, ink, 1, cv2.LINE_AA)
        y += int(28 * size)
        if rng.random() < 0.07:
            high = _random_pixels(rng, 0.15, 0.35)
            cv2.rectangle(image, (14, y), (_SIDE - 14, y + high), _colour(rng, colours), -1)
            y += high + int(28 * size)
    return image


def facade(rng: np.random.Generator, colours: Array) -> Image:
    """Return painted boxes with lit and dark sides and cast shadows, which are not geometry."""
    image = np.full((_SIDE, _SIDE, 3), _colour(rng, colours), dtype=np.uint8)
    image = (image * np.linspace(0.7, 1.0, _SIDE)[:, None, None]).astype(np.uint8)
    count, margin = int(rng.integers(2, 7)), rng.uniform(0.1, 0.3)
    step, slant = _SIDE / count, rng.uniform(-0.15, 0.15)
    for i in range(count):
        for j in range(count):
            x0, y0 = (i + margin) * step, (j + margin) * step
            w, h = (1 - 2 * margin) * step * rng.uniform(0.6, 1.0, 2)
            front = np.array([[x0, y0], [x0 + w, y0], [x0 + w, y0 + h], [x0, y0 + h]])
            colour = colours[rng.integers(len(colours))]
            lift, depth = np.array([slant * w, -0.18 * h]), np.array([0.2 * w, -0.1 * h])
            for quad, shade in (
                (front + np.array([0.25 * w, 0.2 * h]), 0.15),
                (np.stack((front[0], front[1], front[1] + lift, front[0] + lift)), 1.2),
                (np.stack((front[1], front[2], front[2] + depth, front[1] + depth)), 0.4),
                (front, 0.8),
            ):
                cv2.fillPoly(image, [quad.astype(np.int32)], _ink(shade * colour), cv2.LINE_AA)
    return image


def photograph(rng: np.random.Generator, colours: Array) -> Image:
    """Return coloured noise with the spectrum of photographs and a few occluding outlines."""
    image = np.zeros((_SIDE, _SIDE, 3))
    for _ in range(rng.integers(1, 5)):
        weight = spectrum(rng, _SIDE, rng.uniform(1.1, 1.9))
        shade = 0.4 + 1.0 * spectrum(rng, _SIDE, rng.uniform(1.3, 2.2))[..., None]
        mask = 1 / (1 + np.exp(-(spectrum(rng, _SIDE, 2.2) - rng.uniform(0.3, 0.6)) * rng.choice([10.0, 250.0])))
        tint = np.stack([np.interp(weight, np.linspace(0.2, 0.8, len(colours)), c) for c in colours.T], axis=-1)
        image += mask[..., None] * (tint * shade - image)
    return np.rint(255 * np.sqrt(np.clip(image, 0, 1))).astype(np.uint8)


def scribble(rng: np.random.Generator, colours: Array) -> Image:
    """Return curves and outlines drawn on paper."""
    image = np.full((_SIDE, _SIDE, 3), _colour(rng, colours), dtype=np.uint8)
    s = np.linspace(0, 1, 200)[:, None]
    for _ in range(rng.integers(4, 20)):
        waves = (rng.normal(size=2) / k * np.sin(np.pi * k * s + rng.uniform(0, 6)) for k in range(1, 5))
        points = ((0.25 * sum(waves) + rng.random(2)) * _SIDE).astype(np.int32)
        closed, colour, width = bool(rng.random() < 0.2), _colour(rng, colours), int(rng.integers(1, 9))
        cv2.polylines(image, [points], closed, colour, width, cv2.LINE_AA)
    return image


def picture_paint(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return a random picture as paint, repeated one to three times over ``scale`` metres."""
    colours = palette(rng, family, 6)
    image = (poster, page, facade, photograph, scribble)[rng.choice(5, p=[0.3, 0.15, 0.15, 0.25, 0.15])](rng, colours)
    flat = np.ascontiguousarray(((image / np.float32(255)) ** 2).reshape(-1, 3).T, dtype=np.float32)
    size, turn = scale * rng.uniform(0.3, 1.1), rng.choice([0.0, rng.uniform(0, 6.28)])

    def paint(p: Array, chart: Array) -> Array:
        x = (np.cos(turn) * chart[0] + np.sin(turn) * chart[1]) * _SIDE / size
        y = (np.sin(turn) * chart[0] - np.cos(turn) * chart[1]) * _SIDE / size
        i, j = np.floor(y), np.floor(x)
        a, b = (y - i).astype(np.float32), (x - j).astype(np.float32)
        row = [(i.astype(np.intp) + k) % _SIDE * _SIDE for k in (0, 1)]
        column = [(j.astype(np.intp) + k) % _SIDE for k in (0, 1)]
        top = flat[:, row[0] + column[0]] * (1 - b) + flat[:, row[0] + column[1]] * b
        low = flat[:, row[1] + column[0]] * (1 - b) + flat[:, row[1] + column[1]] * b
        return np.asarray(top * (1 - a) + low * a, dtype=np.float64)

    return paint


_USUAL_PAINTS: dict[str, tuple[Callable[[np.random.Generator, str, float], Paint], ...]] = {
    "wood": (grain, grain, grain, solid_colour),
    "stone": (veins, clouds, speckles, toned, solid_colour),
    "wall": (solid_colour, solid_colour, clouds, stripes, dots),
    "brick": (bricks, toned, clouds),
    "plant": (solid_colour, toned, clouds),
    "metal": (solid_colour, speckles, clouds),
    "earth": (clouds, speckles, toned),
    "white": (solid_colour,),
    "cloth": (woven, stripes, solid_colour, dots, toned, clouds),
}


@dataclass(frozen=True, eq=False)
class Body:
    """A shape with its paint, and the strength ``gloss`` and exponent ``shine`` of its highlights."""

    shape: Shape
    paint: Paint
    gloss: float = 0.0
    shine: float = 20.0


class SceneBuilder:
    """The bodies of one scene, each in a random material, from plain to patterned; some scenes have a single paint."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.bodies: list[Body] = []
        self._rng = rng
        self._pattern_probability = float(rng.choice([0.0, 0.25, 0.6, 0.95], p=[0.12, 0.33, 0.35, 0.2]))
        self._any_colour_probability = float(rng.choice([0.08, 0.3, 0.8]))
        self._shared: Paint | None = None
        kind = rng.random()
        if kind < 0.07:  # camouflage: one pattern continues from object to object
            self._shared = PAINTS[rng.integers(len(PAINTS))](rng, "any", 1.0)
        elif kind < 0.13:
            self._shared = solid_colour(rng, str(rng.choice(["white", "stone", "wall"])), 1.0)
        self._turn = random_rotation(rng)

    def add(self, shape: Shape, family: str, scale: float) -> None:
        """Add a shape in a random material of ``family`` with a pattern for objects of ``scale`` metres."""
        rng = self._rng
        gloss = float(rng.choice([0.0, 0.0, 0.1, 0.5])) * (2.5 if family == "metal" else 1.0)
        shine = float(np.exp(rng.uniform(2, 5)))
        if self._shared is None or (family == "print" and rng.random() < 0.5):
            paint = self.paint(family, scale)
        else:  # the coordinates of the paint are those of the scene
            paint, place = self._shared, shape.vertices @ self._turn.T
            shape = replace(shape, chart=np.column_stack((place[:, :2], shape.chart[:, 2])), rest=place)
        self.bodies.append(Body(shape, paint, gloss, shine))

    def add_all(self, shapes: Sequence[Shape], families: Sequence[str], scale: float) -> None:
        """Add shapes, each in a material of the family at its place, those beyond the last family of the last."""
        for k, shape in enumerate(shapes):
            self.add(shape, families[min(k, len(families) - 1)], scale)

    def paint(self, family: str, scale: float) -> Paint:
        """Return a random paint: nearly one colour, of a kind that is usual for the family, or of any kind."""
        rng = self._rng
        if family == "print":
            return picture_paint(rng, "any", scale)
        colours = "any" if family == "cloth" or rng.random() < self._any_colour_probability else family
        if rng.random() > self._pattern_probability:
            return solid_colour(rng, colours, scale)
        if rng.random() < 0.65:
            usual = _USUAL_PAINTS.get(family, PAINTS)
            return usual[rng.integers(len(usual))](rng, colours, scale)
        if rng.random() < 0.2:
            return picture_paint(rng, "any", scale)
        return PAINTS[rng.integers(len(PAINTS))](rng, colours, scale)
