"""Random paints: functions from the paint's coordinates to linear RGB.

A paint takes points (3, N) in a shape's own frame and the chart (3, N), two surface coordinates in metres and a tone,
and returns (3, N). ``scale`` is the size of the painted object in metres. Most patterns are independent
of the shape's edges, so that a network learns not to take edges of texture for edges of depth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsr.synthetic.procedural.shape import random_rotation
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


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 31))


def fractal(points: Array, cell: float, seed: int, octaves: int = 3) -> Array:
    """Return noise in about [0, 1] of several scales, the coarsest ``cell`` metres, shape (N,)."""
    place = TILT @ points
    total = sum(0.5**k * noise(place + 0.37 * k * cell, cell * 0.47**k, seed + k) for k in range(octaves))
    return np.asarray(total / (2 - 0.5 ** (octaves - 1)))


def solid_colour(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return a nearly uniform colour."""
    colour = palette(rng, family, 1)[0][:, None]
    depth, cell, seed = rng.choice([0.0, 0.06, 0.25]), scale * rng.uniform(0.05, 0.4), _seed(rng)
    return lambda p, chart: colour * (1 + depth * (fractal(p, cell, seed, 2) - 0.5))


def clouds(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return blotches of several colours, soft or hard."""
    colours, seed, cell = palette(rng, family), _seed(rng), scale * np.exp(rng.uniform(-4.0, -0.7))
    hard, octaves = rng.choice([1.0, 2.5, 9.0]), int(rng.integers(1, 5))
    return lambda p, chart: mix(colours, np.clip(hard * (fractal(p, cell, seed, octaves) - 0.5) + 0.5, 0, 1))


def veins(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return marble."""
    colours, seed, cell = palette(rng, family), _seed(rng), scale * rng.uniform(0.15, 0.7)
    wave = rng.normal(size=(1, 3)) * rng.uniform(4, 25) / scale
    bend, sharp = rng.uniform(3, 14), rng.choice([1.0, 3.0])

    def paint(p: Array, chart: Array) -> Array:
        swing = np.abs(np.sin((wave @ p)[0] + bend * fractal(p, cell, seed, 4)))
        return mix(colours, 1 - (1 - swing) ** sharp)

    return paint


def grain(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return wood: stretched rings with fibres, in planks or whole."""
    colours, seed = palette(rng, family), _seed(rng)
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
    colours, joint, seed = palette(rng, family), palette(rng, "stone", 1)[0][:, None], _seed(rng)
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
    seed = _seed(rng)

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
    offsets, seed, bend = rng.uniform(0, 5, (count, 1)), _seed(rng), rng.choice([0.0, 0.5, 2.0])
    table = rng.random(4096)

    def paint(p: Array, chart: Array) -> Array:
        cells = np.floor(planes @ p + offsets + bend * fractal(p, 0.4 * scale, seed, 2)).astype(np.int64)
        key = (cells * np.array([[1], [7], [31], [173], [911], [4111]])[:count]).sum(0) & 4095
        return mix(colours, table[key])

    return paint


def toned(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return colours that follow the chart's tone, as dirt in grooves: texture that correlates with geometry."""
    colours, seed, cell = palette(rng, family), _seed(rng), scale * rng.uniform(0.02, 0.2)
    blend = rng.uniform(0.0, 0.5)
    return lambda p, chart: mix(colours, np.clip((1 - blend) * chart[2] + blend * fractal(p, cell, seed), 0, 1))


def speckles(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return granite, terrazzo, gravel or coarse cloth."""
    colours, seed, cell = palette(rng, family), _seed(rng), scale * np.exp(rng.uniform(-5.2, -3.0))
    turn = random_rotation(rng)

    def paint(p: Array, chart: Array) -> Array:
        value = noise(turn @ p, cell, seed) * 0.6 + 0.4 * noise(p, 2.7 * cell, seed + 1)
        return mix(colours, np.clip(2.2 * (value - 0.5) + 0.5, 0, 1))

    return paint


def woven(rng: np.random.Generator, family: str, scale: float) -> Paint:
    """Return cloth: herringbone or plain weave with a fine grain."""
    colours, seed, period = palette(rng, family, 3), _seed(rng), scale * np.exp(rng.uniform(-4.5, -2.5))
    zig = rng.choice([0.0, 3.0, 6.0])

    def paint(p: Array, chart: Array) -> Array:
        u, v = chart[0] / period, chart[1] / period
        turn = np.abs((u / max(zig, 1.0)) % 1 - 0.5) * zig
        warp, weft = np.clip(3 * np.sin(2 * np.pi * (v + turn)), -1, 1), np.sin(2 * np.pi * u) * (zig == 0)
        value = 0.5 + 0.25 * warp + 0.2 * weft
        return mix(colours, np.clip(value + 0.4 * (noise(p, 0.5 * period, seed) - 0.5), 0, 1))

    return paint


PAINTS = (solid_colour, clouds, veins, grain, bricks, stripes, dots, shards, toned, speckles, woven)
