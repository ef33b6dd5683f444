"""Lights of random scenes: a lamp with soft shadows, light from all around with occlusion, shadow patterns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dsr.synthetic.procedural.paints import fractal
from dsr.synthetic.procedural.shape import Index, unit
from dsr.synthetic.procedural.tracer import Hits, Tracer
from dsr.synthetic.surfaces import Array

Cookie = Callable[[Array], Array]
SETS = 16
"""Neighbouring pixels use different sixteenths of the samples of a light."""
_EACH = 3


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light in a scene.

    Args:
        lamp: (SETS, L, 3) points that stand for the lamp.
        colour: (3,) of the lamp.
        cookie: share of the lamp's light let through at points (3, N), such as by leaves or a window.
        ambient: (3,) colour of the light from all around, and ``sky`` (3,) what is added from above.
        directions: (SETS, A, 3) unit vectors, as many upward as cosine asks for (z is the normal).
        reach: metres within which surfaces take ambient light from each other.

    """

    lamp: Array
    colour: Array
    cookie: Cookie
    ambient: Array
    sky: Array
    directions: Array
    reach: float


def random_lighting(rng: np.random.Generator, tracer: Tracer, seen: Hits, low: Array, high: Array) -> Lighting:
    """Return lights for what a coarse picture has ``seen``, the lamp between the corners ``low`` and ``high`` (3,)."""
    middle = np.median(seen.points, axis=1)
    extent = float(np.median(seen.depth))
    points, normals = seen.points, seen.normals
    best, position = -1.0, high
    for _ in range(8):
        way = unit(rng.normal(size=(1, 3)) * [1, 1, 0.6] + [0, -0.5, 0.7])[0]
        spot = np.clip(middle + extent * rng.uniform(0.5, 2.5) * way, low, high)
        toward = spot[:, None] - points
        slope = (toward * normals).sum(0) / np.sqrt((toward**2).sum(0))
        lit = (slope > 0.02) & ~tracer.blocked(lifted(seen, extent), toward)
        score = min(float(lit.mean()), 0.75) + 0.3 * rng.random()
        if score > best:
            best, position = score, spot
    return _build(rng, position, middle, extent)


def _build(rng: np.random.Generator, position: Array, middle: Array, extent: float) -> Lighting:
    """Return the lighting with the lamp at ``position`` (3,)."""
    toward = position - middle
    distance = float(np.linalg.norm(toward))
    radius = distance * np.exp(rng.uniform(np.log(0.01), np.log(0.3)))
    frame = np.linalg.svd(unit(toward[None]))[2][1:]  # (2, 3): across the way to the lamp
    cells = _stratified(rng, SETS * _EACH) * 2 - 1
    lamp = position + radius * (cells @ frame).reshape(_EACH, SETS, 3).transpose(1, 0, 2)
    warm = np.array([1.0, 1.0, 1.0]) + rng.uniform(-0.25, 0.35) * np.array([0.5, 0.0, -0.6])
    share = rng.uniform(0.12, 0.9)  # of the light that is ambient
    ambient, sky = share * 0.7 * (2 - warm), share * rng.uniform(0.0, 0.6) * np.array([0.9, 1.0, 1.15])
    cookie = _cookie(rng, frame, middle, distance) if rng.random() < 0.22 else _clear
    strength = (1.15 - share) * distance**2
    directions = _hemisphere(_stratified(rng, SETS * _EACH)).reshape(_EACH, SETS, 3).transpose(1, 0, 2)
    return Lighting(lamp, strength * warm, cookie, ambient, sky, directions, 0.35 * extent)


def _stratified(rng: np.random.Generator, count: int) -> Array:
    """Return points (count, 2) spread over the unit square: a shifted lattice of the plastic number."""
    steps = np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    return (steps + rng.random(2)) % 1.0


def _hemisphere(cells: Array) -> Array:
    """Return unit vectors (N, 3), cosine distributed about z, for points (N, 2) of the unit square."""
    radius, angle = np.sqrt(cells[:, 0]), 2 * np.pi * cells[:, 1]
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - cells[:, 0])))


def _clear(points: Array) -> Array:
    return np.ones(points.shape[1])


def _cookie(rng: np.random.Generator, frame: Array, middle: Array, distance: float) -> Cookie:
    """Return shadows of slats, of a window's bars or of leaves, projected onto everything along parallel lines."""
    kind, soft = rng.integers(3), rng.uniform(0.01, 0.12)
    period, dark = distance * rng.uniform(0.06, 0.3), rng.uniform(0.0, 0.45)
    turn, seed, cut = rng.uniform(0, np.pi), int(rng.integers(1 << 31)), rng.uniform(0.42, 0.58)

    def through(points: Array) -> Array:
        a, b = frame @ (points - middle[:, None]) / period
        u, v = np.cos(turn) * a + np.sin(turn) * b, np.cos(turn) * b - np.sin(turn) * a
        if kind == 0:
            value = np.abs((2.2 * u) % 1 - 0.5) - 0.22
        elif kind == 1:
            bars = np.minimum(np.abs(u % 1 - 0.5), np.abs((0.7 * v) % 1 - 0.5)) - 0.06
            value = np.minimum(bars, 1.4 - np.maximum(np.abs(u), np.abs(v)))
        else:
            value = fractal(np.stack((u, v, 0 * u)), 0.7, seed, 4) - cut
        return dark + (1 - dark) * np.clip(0.5 + value / soft, 0, 1)

    return through


def lifted(hits: Hits, extent: float) -> Array:
    """Return the points (3, N) a little above the surface, out of reach of the triangles that stand for it."""
    rise = 2e-4 * extent + 2.2 * np.abs(hits.bulge)
    return hits.points + rise * hits.normals


def visibility(tracer: Tracer, lighting: Lighting, hits: Hits, which: Index, extent: float) -> tuple[Array, Array]:
    """Return the seen shares (N,) of the lamp and of the surroundings, from the samples of the sets ``which`` (N,)."""
    start = lifted(hits, extent)
    lamp, open_ = np.zeros(len(which)), np.zeros(len(which))
    n = hits.normals
    side = np.where(np.abs(n[2]) < 0.9, np.stack((-n[1], n[0], 0 * n[2])), np.stack((0 * n[0], -n[2], n[1])))
    side /= np.sqrt((side**2).sum(0))
    up = np.stack((n[1] * side[2] - n[2] * side[1], n[2] * side[0] - n[0] * side[2], n[0] * side[1] - n[1] * side[0]))
    for k in range(_EACH):
        toward = lighting.lamp[which, k].T - start
        facing = np.flatnonzero((toward * n).sum(0) > 0)
        lamp[facing] += ~tracer.blocked(start[:, facing], toward[:, facing])
        a, b, c = lighting.reach * lighting.directions[which, k].T
        open_ += ~tracer.blocked(start, a * side + b * up + c * n)
    return lamp / _EACH, open_ / _EACH


def arriving(lighting: Lighting, points: Array, normals: Array, seen: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the light (3, N) that surfaces get, and the lamp's part at a right angle (N,) for highlights."""
    toward = lighting.lamp.mean((0, 1))[:, None] - points
    square = (toward**2).sum(0)
    direct = seen[0] * lighting.cookie(points) / square
    slope = np.maximum((toward * normals).sum(0) / np.sqrt(square), 0.0)
    around = (0.15 + 0.85 * seen[1]) * (lighting.ambient[:, None] + (0.5 + 0.5 * normals[2]) * lighting.sky[:, None])
    return around + direct * slope * lighting.colour[:, None], direct
