"""Materials of random scenes: paints and highlights sampled for each shape, and pictures as paint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dsr.synthetic.procedural import paints as p
from dsr.synthetic.procedural.paints import PAINTS, Paint, palette
from dsr.synthetic.procedural.photo import Body
from dsr.synthetic.procedural.reliefs import spectrum
from dsr.synthetic.procedural.shape import Shape, random_rotation
from dsr.synthetic.raycast import Array

Image = NDArray[np.uint8]  # (S, S, 3); a value stands for the linear light (value / 255)**2
_SIDE = 384
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_DUPLEX)
_LETTERS = list("abcdefghijklmnoprstuvwyz      ")


def _colour(rng: np.random.Generator, colours: Array) -> tuple[float, ...]:
    return _ink(colours[rng.integers(len(colours))])


def _ink(linear: Array) -> tuple[float, ...]:
    """Return a linear colour (3,) as it is drawn."""
    return tuple(float(c) for c in np.rint(255 * np.sqrt(np.clip(linear, 0, 1))))


def _sheet(colour: tuple[float, ...]) -> Image:
    """Return an empty picture of one colour."""
    return np.full((_SIDE, _SIDE, 3), colour, dtype=np.uint8)


def _random_pixels(rng: np.random.Generator, low: float, high: float) -> int:
    """Return a random number of pixels between two fractions of the picture's side."""
    return int(rng.uniform(low, high) * _SIDE)


def poster(rng: np.random.Generator, colours: Array) -> Image:
    """Return rectangles, discs, lines and a title."""
    image = _sheet(_colour(rng, colours))
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
    image = _sheet(_ink(rng.uniform(0.5, 0.85) * rng.uniform([0.9, 0.88, 0.75], 1.0)))
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
    image = _sheet(_colour(rng, colours))
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
    image = _sheet(_colour(rng, colours))
    s = np.linspace(0, 1, 200)[:, None]
    for _ in range(rng.integers(4, 20)):
        curve = sum(
            rng.normal(size=(1, 2)) / (k + 1) * np.sin(np.pi * (k + 1) * s + rng.uniform(0, 6)) for k in range(4)
        )
        points = ((0.25 * curve + rng.random(2)) * _SIDE).astype(np.int32)
        cv2.polylines(
            image, [points], bool(rng.random() < 0.2), _colour(rng, colours), int(rng.integers(1, 9)), cv2.LINE_AA
        )
    return image


def tile_picture(image: Image, size: float, *, turn: float = 0.0) -> Paint:
    """Return the paint that repeats the picture (S, S, 3), ``size`` metres wide, turned by ``turn`` radians."""
    count = len(image)
    flat = np.ascontiguousarray(((image / np.float32(255)) ** 2).reshape(-1, 3).T, dtype=np.float32)

    def paint(points: Array, chart: Array) -> Array:
        x = (np.cos(turn) * chart[0] + np.sin(turn) * chart[1]) * count / size
        y = (np.sin(turn) * chart[0] - np.cos(turn) * chart[1]) * count / size
        i, j = np.floor(y), np.floor(x)
        a, b = (y - i).astype(np.float32), (x - j).astype(np.float32)
        row = [(i.astype(np.intp) + k) % count * count for k in (0, 1)]
        column = [(j.astype(np.intp) + k) % count for k in (0, 1)]
        top = flat[:, row[0] + column[0]] * (1 - b) + flat[:, row[0] + column[1]] * b
        low = flat[:, row[1] + column[0]] * (1 - b) + flat[:, row[1] + column[1]] * b
        return np.asarray(top * (1 - a) + low * a, dtype=np.float64)

    return paint


def picture_paint(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return a random picture as paint, repeated one to three times over ``scale`` metres."""
    colours = palette(rng, family, 6)
    image = (poster, page, facade, photograph, scribble)[rng.choice(5, p=[0.3, 0.15, 0.15, 0.25, 0.15])](rng, colours)
    return tile_picture(image, scale * rng.uniform(0.3, 1.1), turn=rng.choice([0.0, rng.uniform(0, 6.28)]))


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
            self._shared = p.solid_colour(rng, str(rng.choice(["white", "stone", "wall"])), 1.0)
        self._turn = random_rotation(rng)

    def add(self, shape: Shape, family: str, scale: float = 1.0) -> None:
        """Add a shape in a random material of ``family`` with a pattern for objects of ``scale`` metres."""
        self.bodies.append(self.sample(shape, family, scale))

    def add_all(self, shapes: Sequence[Shape], families: Sequence[str], scale: float) -> None:
        """Add shapes, each in a material of the family at its place, those beyond the last family of the last."""
        for k, shape in enumerate(shapes):
            self.add(shape, families[min(k, len(families) - 1)], scale)

    def sample(self, shape: Shape, family: str, scale: float = 1.0) -> Body:
        """Return what :meth:`add` adds."""
        rng = self._rng
        gloss = float(rng.choice([0.0, 0.0, 0.1, 0.5])) * (2.5 if family == "metal" else 1.0)
        shine = float(np.exp(rng.uniform(2, 5)))
        if self._shared is None or (family == "print" and rng.random() < 0.5):
            return Body(shape, self.paint(family, scale), gloss, shine)
        place = shape.vertices @ self._turn.T  # the coordinates of the scene are those of the paint
        chart = np.column_stack((place[:, :2], shape.chart[:, 2]))
        return Body(replace(shape, chart=chart, rest=place), self._shared, gloss, shine)

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
