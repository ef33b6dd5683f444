"""Procedural paints for the ray caster's bodies: functions from points (3, N) in metres to linear RGB (3, N)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from dsr.synthetic.ray_surfaces import Array, Cylinder, Field, rotation

CLAY = ((0.06, 0.07, 0.13), (0.10, 0.26, 0.30), (0.72, 0.64, 0.48), (0.70, 0.28, 0.12), (0.36, 0.09, 0.07))
CLOUD = ((0.45, 0.10, 0.16), (0.80, 0.30, 0.12), (0.85, 0.72, 0.42), (0.55, 0.62, 0.30), (0.10, 0.36, 0.30))
DUSK = ((0.13, 0.15, 0.33), (0.24, 0.38, 0.58), (0.60, 0.68, 0.72), (0.66, 0.56, 0.62), (0.34, 0.22, 0.40))
_TILT = rotation(37.0, 31.0, 29.0)


def plain(*rgb: float) -> Field:
    """Return the paint of one linear RGB colour."""
    return lambda points: np.broadcast_to(np.array(rgb)[:, None], points.shape)


def noise(points: Array, cell: float, seed: int, order: int = 1) -> Array:
    """Return noise in [0, 1] at ``points`` (3, N), with one value per ``cell`` metres, shape (N,).

    Order 1 interpolates between the values; order 3 is a B-spline, which is smoother and weaker.
    """
    place = points / cell
    if order == 1:
        part = place - np.floor(place)
        place += part * part * (3 - 2 * part) - part
    return np.asarray(map_coordinates(_random_table(seed), place, order=order, mode="grid-wrap", prefilter=False))


@lru_cache(maxsize=32)
def _random_table(seed: int) -> Array:
    """Return 32 x 32 x 32 values in [0, 1)."""
    return np.random.default_rng(seed).random((32, 32, 32))


def mix(palette: Sequence[Sequence[float]], position: Array) -> Array:
    """Return the colours (3, N) at ``position`` (N,) in [0, 1] along a palette of K linear RGB colours."""
    knots = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(position, knots, channel) for channel in np.array(palette).T])


def mosaic(chart: Field, cell: float, seed: int) -> Field:
    """Return a mosaic of small tiles of ``cell`` metres in the coordinates of ``chart``: random hue, dark joints."""

    def paint(points: Array) -> Array:
        place = chart(points) / cell + 0.5
        tile = np.floor(place).astype(np.intp)
        hue = _random_table(seed)[tuple(tile & 31)]
        checker = np.where(tile.sum(0) % 2, 0.35 * hue, 0.45 + 0.55 * hue)
        edge = np.abs(place - tile - 0.5).max(0)
        grain = 0.8 + 0.4 * noise(points, 0.006, seed)
        return np.where(edge > 0.43, 0.10, mix(CLAY, checker)) * grain

    return paint


def marble(chart: Field) -> Field:
    """Return fine warped veins through the solid."""

    def paint(points: Array) -> Array:
        p = chart(points)
        warp = noise(p, 0.22, 31) + 0.5 * noise(p, 0.09, 32) + 0.25 * noise(p, 0.035, 33)
        vein = 0.5 + 0.5 * np.sin(130 * (0.35 * p[0] + p[1]) + 17 * warp)
        return mix(CLAY, 0.15 + 0.75 * vein) * (0.75 + 0.5 * noise(p, 0.007, 34))

    return paint


def blobs(chart: Field, cell: float, seed: int, palette: Sequence[Sequence[float]]) -> Field:
    """Return broad blobs of colour, about ``cell`` metres wide."""

    def paint(points: Array) -> Array:
        p = chart(points) + 3.7 * cell
        value = 0.7 * noise(_TILT @ p, cell, seed, 3) + 0.3 * noise(p, cell / 2, seed + 50, 3)
        return mix(palette, np.clip(3.2 * value - 1.1, 0, 1))

    return paint


def weave(points: Array) -> Array:
    """Return the cloth on the wall: a herringbone of two greys with a fine grain."""
    x, y = points[0], points[1] + 0.012 * noise(points, 0.15, 41)
    zigzag = np.abs((x / 0.28) % 1 - 0.5) * 0.28
    stripe = 0.5 + 0.5 * np.clip(3 * np.sin(2 * np.pi * (y + zigzag) / 0.052), -1, 1)
    grain = 0.65 + 0.7 * noise(points, 0.011, 42)
    return mix(((0.16, 0.20, 0.26), (0.62, 0.60, 0.54)), stripe) * grain


def unroll_chart(cylinder: Cylinder) -> Field:
    """Return the chart that maps points to the cylinder's (arc length, height, depth below the side) in metres."""

    def unroll(points: Array) -> Array:
        x, y, z = cylinder.to_local(points)
        below = cylinder.radius - np.hypot(x, z)
        cap = cylinder.half - np.abs(y) < np.abs(below)
        arc = np.arctan2(z, x) * cylinder.radius
        return np.where(cap, np.stack((x, z, np.sign(y) + 0 * x)), np.stack((arc, y, 0 * x)))

    return unroll
