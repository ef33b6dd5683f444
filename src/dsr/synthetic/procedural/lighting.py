"""Lights of random scenes: a lamp with soft shadows, ambient light with occlusion, and shadow patterns."""

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
"""Number of sets into which the samples of a light are divided; neighbouring pixels use different sets."""
_SAMPLES_PER_SET = 3


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light in a scene.

    Args:
        lamp: (SETS, L, 3) sample points of the lamp in metres.
        colour: (3,) colour and strength of the lamp.
        cookie: function from points (3, N) to the fraction (N,) of the lamp's light that arrives there, for example
            through leaves or a window.
        ambient: (3,) colour of the light from all directions.
        sky: (3,) colour of additional light from above.
        directions: (SETS, A, 3) unit vectors, cosine distributed about z, the normal.
        occlusion_distance: distance in metres within which surfaces occlude each other's ambient light.

    """

    lamp: Array
    colour: Array
    cookie: Cookie
    ambient: Array
    sky: Array
    directions: Array
    occlusion_distance: float


def random_lighting(rng: np.random.Generator, tracer: Tracer, seen: Hits, low: Array, high: Array) -> Lighting:
    """Return random lights for the surfaces of a preview.

    Args:
        rng: source of random numbers.
        tracer: ray tracer of the scene.
        seen: hits of the preview's rays.
        low: (3,) lower corner of the box in which the lamp may hang, in metres.
        high: (3,) upper corner of the same.

    """
    middle = np.median(seen.points, axis=1)
    extent = float(np.median(seen.depth))
    points, normals = seen.points, seen.normals
    best, position = -1.0, high
    for _ in range(8):
        way = unit(rng.normal(size=(1, 3)) * [1, 1, 0.6] + [0, -0.5, 0.7])[0]
        spot = np.clip(middle + extent * rng.uniform(0.5, 2.5) * way, low, high)
        toward = spot[:, None] - points
        slope = (toward * normals).sum(0) / np.sqrt((toward**2).sum(0))
        lit = (slope > 0.02) & ~tracer.is_blocked(offset_points(seen, extent), toward)
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
    cells = _stratified(rng, SETS * _SAMPLES_PER_SET) * 2 - 1
    lamp = position + radius * (cells @ frame).reshape(_SAMPLES_PER_SET, SETS, 3).transpose(1, 0, 2)
    warm = np.array([1.0, 1.0, 1.0]) + rng.uniform(-0.25, 0.35) * np.array([0.5, 0.0, -0.6])
    ambient_fraction = rng.uniform(0.12, 0.9)
    ambient, sky = (
        ambient_fraction * 0.7 * (2 - warm),
        ambient_fraction * rng.uniform(0.0, 0.6) * np.array([0.9, 1.0, 1.15]),
    )
    cookie = _cookie(rng, frame, middle, distance) if rng.random() < 0.22 else _clear
    strength = (1.15 - ambient_fraction) * distance**2
    directions = (
        _hemisphere(_stratified(rng, SETS * _SAMPLES_PER_SET)).reshape(_SAMPLES_PER_SET, SETS, 3).transpose(1, 0, 2)
    )
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
    """Return the shadow pattern of slats, window bars or leaves, projected along parallel lines."""
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


def offset_points(hits: Hits, extent: float) -> Array:
    """Return the points (3, N) moved along their normals, so that their own triangles do not shadow them."""
    rise = 2e-4 * extent + 2.2 * np.abs(hits.bulge)
    return hits.points + rise * hits.normals


def visibility(tracer: Tracer, lighting: Lighting, hits: Hits, which: Index, extent: float) -> tuple[Array, Array]:
    """Return the visible fractions (N,) of the lamp and of the surroundings, from the sample sets ``which`` (N,)."""
    start = offset_points(hits, extent)
    lamp, open_ = np.zeros(len(which)), np.zeros(len(which))
    n = hits.normals
    side = np.where(np.abs(n[2]) < 0.9, np.stack((-n[1], n[0], 0 * n[2])), np.stack((0 * n[0], -n[2], n[1])))
    side /= np.sqrt((side**2).sum(0))
    up = np.stack((n[1] * side[2] - n[2] * side[1], n[2] * side[0] - n[0] * side[2], n[0] * side[1] - n[1] * side[0]))
    for k in range(_SAMPLES_PER_SET):
        toward = lighting.lamp[which, k].T - start
        facing = np.flatnonzero((toward * n).sum(0) > 0)
        lamp[facing] += ~tracer.is_blocked(start[:, facing], toward[:, facing])
        a, b, c = lighting.occlusion_distance * lighting.directions[which, k].T
        open_ += ~tracer.is_blocked(start, a * side + b * up + c * n)
    return lamp / _SAMPLES_PER_SET, open_ / _SAMPLES_PER_SET


def incident_light(lighting: Lighting, points: Array, normals: Array, seen: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the light (3, N) that arrives at surfaces, and the lamp's at normal incidence (N,) for highlights."""
    toward = lighting.lamp.mean((0, 1))[:, None] - points
    square = (toward**2).sum(0)
    direct = seen[0] * lighting.cookie(points) / square
    slope = np.maximum((toward * normals).sum(0) / np.sqrt(square), 0.0)
    around = (0.15 + 0.85 * seen[1]) * (lighting.ambient[:, None] + (0.5 + 0.5 * normals[2]) * lighting.sky[:, None])
    return around + direct * slope * lighting.colour[:, None], direct
