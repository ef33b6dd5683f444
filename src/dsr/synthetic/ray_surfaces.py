"""Surfaces that rays hit, in closed form: plane, sphere, box, cylinder; and their procedural paints.

Frame: that of :mod:`dsr.geometry.camera` (x right, y down, z forward, metres). Points and directions are float64 arrays
of shape (3, N). Paints are functions from points in metres to linear RGB (3, N).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

Array = NDArray[np.float64]
Field = Callable[[Array], Array]

CLAY = ((0.06, 0.07, 0.13), (0.10, 0.26, 0.30), (0.72, 0.64, 0.48), (0.70, 0.28, 0.12), (0.36, 0.09, 0.07))
CLOUD = ((0.45, 0.10, 0.16), (0.80, 0.30, 0.12), (0.85, 0.72, 0.42), (0.55, 0.62, 0.30), (0.10, 0.36, 0.30))
DUSK = ((0.13, 0.15, 0.33), (0.24, 0.38, 0.58), (0.60, 0.68, 0.72), (0.66, 0.56, 0.62), (0.34, 0.22, 0.40))


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation by ``roll`` about z, then ``pitch`` about x, then ``yaw`` about y, in degrees."""
    out = np.eye(3)
    for (i, j), angle in zip(((0, 1), (1, 2), (2, 0)), np.deg2rad((roll, pitch, yaw)), strict=True):
        turn = np.eye(3)
        turn[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        out = turn @ out
    return out


class Surface(ABC):
    """An opaque surface seen from outside."""

    @abstractmethod
    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the smallest t > 0 with origin + t * direction on the surface, inf where there is none, shape (N,)."""

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Return the outward unit normals at ``points`` on the surface, shape (3, N)."""

    def visibility(self, origin: Array, direction: Array, spread: float) -> Array:
        """Return the visible fraction of a light patch at origin + direction, shape (N,).

        ``spread`` is the radius of the patch in metres; surfaces with a closed form treat the patch as a point.
        """
        return np.asarray(self.intersect(origin, direction) >= 1, dtype=np.float64)

    def openness(self, points: Array, normals: Array) -> Array:
        """Return the fraction of the surroundings that the surface does not occlude at its ``points``, shape (N,)."""
        return np.ones(points.shape[1])


@dataclass(frozen=True, eq=False)
class Plane(Surface):
    """The plane through ``point`` with the unit normal ``facing``, both of shape (3,)."""

    point: Array
    facing: Array

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return where the rays meet the plane; inf for rays that are parallel to it or come from behind."""
        slope = self.facing @ direction
        t = (self.facing @ self.point - self.facing @ origin) / np.where(slope < 0, slope, np.nan)
        return np.where(t > 0, t, np.inf)

    def normal(self, points: Array) -> Array:
        """Return the plane's normal for every point."""
        return np.broadcast_to(self.facing[:, None], points.shape)


@dataclass(frozen=True, eq=False)
class Convex(Surface):
    """A convex body: the part of a ray inside it is one interval."""

    centre: Array  # (3,) in metres
    axes: Array  # (3, 3) rotation whose columns are the body's own axes

    def to_local(self, points: Array) -> Array:
        """Return ``points`` in the body's own frame, shape (3, N)."""
        return self.axes.T @ (points - self.centre[:, None])

    @abstractmethod
    def intersect_local(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the parameters at which rays in the body's own frame enter and leave it; enter > leave on a miss."""

    @abstractmethod
    def local_normal(self, points: Array) -> Array:
        """Return the unit normals in the body's own frame, shape (3, N)."""

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return where the rays enter the body."""
        enter, leave = self.intersect_local(self.to_local(origin), self.axes.T @ direction)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)

    def normal(self, points: Array) -> Array:
        """Return the outward unit normals."""
        return self.axes @ self.local_normal(self.to_local(points))


@dataclass(frozen=True, eq=False)
class Sphere(Convex):
    """A sphere of ``radius`` metres."""

    radius: float

    def intersect_local(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the roots of |origin + t direction| = radius."""
        return _intersect_round(origin, direction, self.radius)

    def local_normal(self, points: Array) -> Array:
        """Return the directions from the centre."""
        return points / np.sqrt((points**2).sum(0))


@dataclass(frozen=True, eq=False)
class Box(Convex):
    """A box with the half edges ``half`` (3,) in metres."""

    half: Array

    def intersect_local(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the overlap of the three slabs."""
        slabs = [_intersect_slab(origin[i], direction[i], self.half[i]) for i in range(3)]
        return np.maximum.reduce([s[0] for s in slabs]), np.minimum.reduce([s[1] for s in slabs])

    def local_normal(self, points: Array) -> Array:
        """Return the axis of the face nearest to each point."""
        face = np.argmax(np.abs(points) - self.half[:, None], axis=0)
        return np.where(np.arange(3)[:, None] == face, np.sign(points), 0.0)


@dataclass(frozen=True, eq=False)
class Cylinder(Convex):
    """A capped cylinder along its own y axis, ``radius`` and ``half`` height in metres."""

    radius: float
    half: float

    def intersect_local(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the overlap of the infinite cylinder and the slab between the caps."""
        side = _intersect_round(origin[::2], direction[::2], self.radius)
        caps = _intersect_slab(origin[1], direction[1], self.half)
        return np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])

    def local_normal(self, points: Array) -> Array:
        """Return the axis on the caps and the direction from the axis on the side."""
        across = np.maximum(np.hypot(points[0], points[2]), 1e-300)
        cap = np.abs(points[1]) - self.half > across - self.radius
        side = np.stack((points[0] / across, np.zeros_like(across), points[2] / across))
        return np.where(cap, np.sign(points[1]) * np.array([[0.0], [1.0], [0.0]]), side)


def _intersect_slab(origin: Array, direction: Array, half: float) -> tuple[Array, Array]:
    """Return the interval of t in which |origin + t direction| <= half, all of shape (N,)."""
    slope = np.where(direction == 0, 1e-300, direction)
    middle, half_length = -origin / slope, half / np.abs(slope)
    return middle - half_length, middle + half_length


def _intersect_round(origin: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    """Return the interval of t in which origin + t direction (k, N) has a length <= radius; (inf, -inf) on a miss."""
    square = np.maximum((direction**2).sum(0), 1e-300)
    middle = -(origin * direction).sum(0) / square
    nearest = ((origin + middle * direction) ** 2).sum(0)
    half_length = np.sqrt(np.maximum(radius**2 - nearest, 0) / square)
    return np.where(nearest <= radius**2, middle - half_length, np.inf), middle + half_length


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
