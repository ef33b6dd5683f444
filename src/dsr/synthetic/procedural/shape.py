"""Triangle meshes with normals and paint coordinates, general functions that make them, and small solid objects.

A shape stands for the curved surface that its vertex normals define (see :mod:`dsr.synthetic.procedural.photo`), so
the vertices of sharp edges occur twice, with different normals. Local frames have z up; lengths are in metres. Solids
are functions from a random generator to a shape about 1 in size that stands on z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mapbox_earcut
import numpy as np
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from dsr.synthetic.raycast import Array, rotation_about

Index = NDArray[np.intp]
_GLYPHS = "ABCDEFGHJKLMNPRSTUVXYZ23456789&QO"


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh of V vertices and F triangles."""

    vertices: Array  # (V, 3) in metres
    faces: Index  # (F, 3) vertex indices, in any orientation
    normals: Array  # (V, 3) unit normals, to either side
    chart: Array  # (V, 3) for paint: two coordinates in metres and a tone in [0, 1], such as the height of a relief
    rest: Array  # (V, 3) coordinates of the vertices in the shape's own frame, for solid paint

    def translate(self, x: float, y: float, z: float) -> Shape:
        """Return the shape shifted by some metres."""
        return replace(self, vertices=self.vertices + np.array([x, y, z], dtype=np.float64))

    def rotate(self, rotation: Array) -> Shape:
        """Return the shape rotated about the origin by the matrix ``rotation`` (3, 3)."""
        return replace(self, vertices=self.vertices @ rotation.T, normals=self.normals @ rotation.T)

    def turn(self, axis: int, degrees: float) -> Shape:
        """Return the shape rotated about one of its axes."""
        return self.rotate(rotation_about(axis, degrees))

    def scale(self, factors: Sequence[float] | float) -> Shape:
        """Return the shape scaled along its axes, its paint coordinates with it."""
        by = np.broadcast_to(np.asarray(factors, dtype=np.float64), (3,))
        chart = self.chart * [by.prod() ** (1 / 3), by.prod() ** (1 / 3), 1.0]
        return Shape(self.vertices * by, self.faces, unit(self.normals / by), chart, self.rest * by)


def unit(vectors: Array) -> Array:
    """Return ``vectors`` (..., 3) at length 1; zero becomes (0, 0, 1)."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-300, vectors / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])


def random_rotation(rng: np.random.Generator) -> Array:
    """Return a uniformly distributed random rotation matrix (3, 3)."""
    q = unit(rng.normal(size=3))
    spin = rotation_about(2, rng.uniform(0, 360))
    other = unit(np.cross(q, [0.3, 0.5, 0.81]))
    return np.asarray(np.stack((other, np.cross(q, other), q), axis=1) @ spin)


def merge(shapes: Sequence[Shape]) -> Shape:
    """Return several shapes as one."""
    starts = np.cumsum([0, *(len(s.vertices) for s in shapes[:-1])])
    faces = np.concatenate([s.faces + start for s, start in zip(shapes, starts, strict=True)])
    rest = [np.concatenate([getattr(s, name) for s in shapes]) for name in ("vertices", "normals", "chart", "rest")]
    return Shape(rest[0], faces, *rest[1:])


def surface(points: Array, normals: Array | None = None, tone: Array | None = None) -> Shape:
    """Return the surface through a grid of points, (R, C, 3); the last column may repeat the first, which closes it.

    Without ``normals`` they are taken from the grid; ``tone``, (R, C) or (C,), is the chart's third coordinate.
    """
    rows, columns = points.shape[:2]
    if normals is None:  # by central differences, across the seam where the grid is closed
        along, around = np.gradient(points, axis=0), np.gradient(points, axis=1)
        if np.allclose(points[:, 0], points[:, -1], atol=1e-9):
            around[:, 0] = around[:, -1] = (points[:, 1] - points[:, -2]) / 2
        normals = np.cross(around, along)
    flat = points.reshape(-1, 3)
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel()
    c, d = corner[1:, :-1].ravel(), corner[1:, 1:].ravel()
    shorter = ((flat[a] - flat[d]) ** 2).sum(1) < ((flat[b] - flat[c]) ** 2).sum(1)
    first = np.where(shorter[:, None], np.stack((a, b, d), 1), np.stack((a, b, c), 1))
    second = np.where(shorter[:, None], np.stack((a, d, c), 1), np.stack((b, d, c), 1))
    chart = np.zeros(points.shape)
    chart[:, 1:, 0] = np.cumsum(np.linalg.norm(np.diff(points, axis=1), axis=2).mean(0))
    chart[1:, :, 1] = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=2).mean(1))[:, None]
    if tone is not None:
        chart[..., 2] = tone
    return Shape(flat, np.concatenate((first, second)), unit(normals.reshape(-1, 3)), chart.reshape(-1, 3), flat)


def grid(*coordinates: Array) -> Array:
    """Return the points (R, C, 3) of three coordinates that broadcast to (R, C)."""
    return np.stack(np.broadcast_arrays(*coordinates), axis=-1)


def lathe(sections: Sequence[Array]) -> Shape:
    """Return the surface of revolution of smooth sections (K, 2), radius and height, with sharp edges between them."""
    angle = np.linspace(0, 2 * np.pi, 81)
    out, up = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=1), np.array([0.0, 0.0, 1.0])
    parts = []
    for section in sections:
        tangent = np.gradient(section, axis=0) if len(section) > 2 else np.repeat(np.diff(section, axis=0), 2, axis=0)
        points = section[:, :1, None] * out + section[:, 1:, None] * up
        parts.append(surface(points, tangent[:, 1:, None] * out - tangent[:, :1, None] * up))
    return merge(parts)


def extrusion(outlines: Sequence[Array], height: float) -> Shape:
    """Return a prism from z = 0 to ``height`` over closed polygons (K, 2): the outer one, then holes."""
    parts = []
    for outline in outlines:  # the walls
        after = np.roll(outline, -1, axis=0)
        edge = after - outline
        normal = unit(np.column_stack((edge[:, 1], -edge[:, 0], 0 * edge[:, 0])))
        before, behind = np.roll(normal, 1, axis=0), np.roll(normal, -1, axis=0)
        smooth = ((normal * before).sum(1) > np.cos(np.deg2rad(32.0)))[:, None]  # at corners below 32 degrees
        start = np.where(smooth, unit(normal + before), normal)
        end = np.where(np.roll(smooth, -1), unit(normal + behind), normal)
        arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(edge, axis=1))))
        foot, along = np.concatenate((outline, after)), np.concatenate((arc[:-1], arc[1:]))
        points = np.concatenate([np.column_stack((foot, np.full(len(foot), z))) for z in (0.0, height)])
        chart = np.concatenate([np.column_stack((along, np.full(len(along), z), 0 * along)) for z in (0.0, height)])
        a, b, c, d = np.arange(4 * len(outline)).reshape(4, -1)
        faces = np.concatenate((np.stack((a, b, c), 1), np.stack((b, d, c), 1)))
        parts.append(Shape(points, faces, np.concatenate((start, end, start, end)), chart, points))
    flat = np.concatenate(outlines)
    ends = np.cumsum([len(o) for o in outlines]).astype(np.uint32)
    faces = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ends).reshape(-1, 3).astype(np.intp)
    base = np.column_stack((flat, np.zeros(len(flat))))
    for z in (0.0, height):
        points = np.column_stack((flat, np.full(len(flat), z)))
        normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        parts.append(Shape(points, faces, normals, base, points))
    return merge(parts)


def tube(path: Array, radius: Array | float, segments: int = 20) -> Shape:
    """Return a round tube along ``path`` (K, 3), with one ``radius`` or one for every point, closed by flat ends."""
    tangent = unit(np.gradient(path, axis=0))
    helper = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    frames = []
    for t in tangent:  # carry the frame along without twist
        helper = unit(helper - (helper @ t) * t)
        frames.append((helper, np.cross(t, helper)))
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    frame = np.array(frames)  # (K, 2, 3)
    out = np.cos(angle)[:, None] * frame[:, None, 0] + np.sin(angle)[:, None] * frame[:, None, 1]  # (K, S, 3)
    ring = path[:, None] + np.broadcast_to(radius, (len(path),))[:, None, None] * out
    caps = []
    for i in (0, -1):
        fan = np.stack((np.broadcast_to(path[i], ring[i].shape), ring[i]))
        caps.append(surface(fan, np.broadcast_to(tangent[i], fan.shape)))
    return merge([surface(ring, out), *caps])


def quad(corner: Sequence[float] | Array, side: Sequence[float] | Array, up: Sequence[float] | Array) -> Shape:
    """Return the flat parallelogram from ``corner`` along ``side`` and ``up``, all (3,)."""
    origin, a, b = (np.asarray(x, dtype=np.float64) for x in (corner, side, up))
    points = np.array([[origin, origin + a], [origin + b, origin + a + b]])
    return surface(points, np.broadcast_to(unit(np.cross(a, b)), points.shape))


def box(size: Sequence[float] | Array) -> Shape:
    """Return the box of edges ``size`` (3,) that stands on z = 0 over the origin."""
    x, y, z = size
    e = np.diag(np.asarray(size, dtype=np.float64))
    low, high = np.array([-x / 2, -y / 2, 0.0]), np.array([x / 2, y / 2, float(z)])
    pairs = ((0, 1), (0, 2), (1, 2))
    return merge([quad(low, e[i], e[j]) for i, j in pairs] + [quad(high, -e[i], -e[j]) for i, j in pairs])


def place_on_ground(shape: Shape) -> Shape:
    """Return the shape moved so that it stands on z = 0 with its middle over the origin."""
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    return shape.translate(-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2])


def block(rng: np.random.Generator) -> Shape:
    """Return a box, with sharp or rounded edges."""
    size = rng.uniform(0.35, 1.0, 3)
    return box(size) if rng.random() < 0.5 else rounded_box(size, rng.uniform(0.03, 0.16) * size.min())


def rounded_box(size: Array, radius: float, steps: int = 8) -> Shape:
    """Return the box of edges ``size`` (3,) on z = 0 with edges rounded to ``radius``."""
    half = np.asarray(size) / 2 - radius
    quarter = np.linspace(0, np.pi / 2, steps + 1)
    theta = np.concatenate([k * np.pi / 2 + quarter for k in range(4)])
    theta, phi = np.append(theta, 0.0), np.concatenate((quarter - np.pi / 2, quarter))[:, None]
    side = np.repeat([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]], [*[steps + 1] * 4, 1], axis=0)
    lift = np.repeat([-1.0, 1.0], steps + 1)[:, None]
    normal = grid(np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi))
    centre = grid(side[:, 0] * half[0], side[:, 1] * half[1], lift * half[2])
    span = 2 * half
    lids = [quad([-half[0], -half[1], z], [span[0], 0, 0], [0, span[1], 0]) for z in (-size[2] / 2, size[2] / 2)]
    return merge([surface(centre + radius * normal, normal), *lids]).translate(0, 0, size[2] / 2)


def superquadric(rng: np.random.Generator) -> Shape:
    """Return a ball between an octahedron and a rounded cube, turned any way."""
    power = rng.uniform(0.35, 1.5, 2) if rng.random() < 0.7 else np.ones(2)
    size = rng.uniform(0.3, 0.5, 3) if rng.random() < 0.7 else np.full(3, rng.uniform(0.3, 0.5))
    return place_on_ground(ellipsoid(size, power).rotate(random_rotation(rng)))


def ellipsoid(size: Array, power: Array, steps: int = 48) -> Shape:
    """Return the superquadric of half axes ``size`` (3,) and exponents ``power`` (2,), 1 for an ellipsoid."""
    phi, theta = np.linspace(-np.pi / 2, np.pi / 2, steps + 1)[:, None], np.linspace(-np.pi, np.pi, 2 * steps + 1)

    def signed(value: Array, exponent: float) -> Array:
        return np.sign(value) * np.abs(value) ** exponent

    balls = []
    for e in (power, 2 - power):  # of the points, and of their normals
        across, top = signed(np.cos(phi), e[0]), signed(np.sin(phi), e[0])
        balls.append(grid(across * signed(np.cos(theta), e[1]), across * signed(np.sin(theta), e[1]), top))
    return surface(balls[0] * size, unit(balls[1] / size))


def cylinder(rng: np.random.Generator) -> Shape:
    """Return a cylinder or a cone's stump, standing or lying."""
    radius, height = rng.uniform(0.15, 0.45), rng.uniform(0.3, 1.0)
    top = radius * (1.0 if rng.random() < 0.6 else rng.uniform(0.02, 0.9))
    shape = frustum(radius, top, height)
    if rng.random() < 0.7:
        return shape
    return place_on_ground(shape.rotate(rotation_about(2, rng.uniform(0, 360)) @ rotation_about(0, 90)))


def frustum(radius: float, top: float, height: float) -> Shape:
    """Return the cone's stump of ``radius`` below and ``top`` above, on z = 0."""
    profile = [(0, 0), (radius, 0)], [(radius, 0), (top, height)], [(top, height), (0, height)]
    return lathe([np.array(section, dtype=np.float64) for section in profile])


def torus(rng: np.random.Generator) -> Shape:
    """Return a ring, lying or leaning."""
    outer = rng.uniform(0.3, 0.42)
    angle = np.linspace(0, 2 * np.pi, 49)
    thick = rng.uniform(0.12, 0.42) * outer
    shape = lathe([np.column_stack((outer + thick * np.cos(angle), thick * np.sin(angle) * rng.uniform(0.6, 1.3)))])
    turn = rotation_about(2, rng.uniform(0, 360)) @ rotation_about(0, rng.choice([0.0, 20.0, 65.0, 90.0]))
    return place_on_ground(shape.rotate(turn))


def vase(rng: np.random.Generator) -> Shape:
    """Return a vase, bottle, goblet or turned column."""
    count = rng.integers(4, 8)
    radii = rng.uniform(0.08, 0.42, count)
    radii[-1] *= 0.6
    height = rng.uniform(0.5, 1.3)
    return hollow(radii, height, rng.uniform(0.01, 0.03), smooth=rng.random() < 0.7)


def bowl(rng: np.random.Generator) -> Shape:
    """Return a bowl, plate, cup or pan; cups have a handle."""
    kind = rng.random()
    if kind < 0.4:  # cup
        radius, height = rng.uniform(0.22, 0.35), rng.uniform(0.4, 0.7)
        cup = hollow(radius * np.array([rng.uniform(0.6, 1), 0.95, 1, 1]), height, 0.02)
        bend = np.linspace(-0.55, 0.55, 15) * np.pi
        handle = np.column_stack((0.45 * height * np.cos(bend) * 0.8, 0 * bend, 0.38 * height * np.sin(bend)))
        grip = tube(handle, rng.uniform(0.025, 0.045), 14).translate(radius * 0.97, 0, height * 0.5)
        return merge([cup, grip]).turn(2, rng.uniform(0, 360))
    depth = rng.uniform(0.05, 0.12) if kind < 0.6 else rng.uniform(0.2, 0.4)
    return hollow(0.48 * np.array([0.5, 0.72, 0.9, 1.0]) ** rng.uniform(0.6, 1.6), depth, 0.015)


def hollow(radii: Array, height: float, wall: float, *, smooth: bool = True) -> Shape:
    """Return an open vessel whose outside has the ``radii`` (K,) at even heights, with walls ``wall`` thick."""
    levels = np.linspace(0, height, len(radii))
    z = np.linspace(0, height, 40)
    r = np.maximum((CubicSpline if smooth else PchipInterpolator)(levels, radii)(z), 0.04)
    turn = np.linspace(0, np.pi, 9)
    rim = np.column_stack((r[-1] - wall + wall * np.cos(turn), height + wall * np.sin(turn)))
    inner = np.column_stack((np.maximum(r - 2 * wall, 0.01), z + wall))[::-1]
    foot, floor = np.array([[0.0, 0.0], [r[0], 0.0]]), np.array([inner[-1], [0.0, wall]])
    return lathe([foot, np.column_stack((r, z)), rim, inner[inner[:, 1] <= height], floor])


def prism(rng: np.random.Generator) -> Shape:
    """Return an extruded polygon, star, gear, smooth outline or frame, standing or lying."""
    kind = rng.integers(4)
    if kind == 0:  # a regular polygon or a star
        count = int(rng.integers(3, 9))
        if rng.random() < 0.5:
            outlines = [ring(0.45, count, rng.uniform(0, 6))]
        else:
            outlines = [ring(np.where(np.arange(2 * count) % 2, rng.uniform(0.15, 0.35), 0.48), 2 * count)]
    elif kind == 1:  # a toothed wheel with a round hole
        teeth, deep = int(rng.integers(8, 22)), rng.uniform(0.03, 0.08)
        radii = np.tile([0.46, 0.46, 0.46 - deep, 0.46 - deep], teeth)
        outlines = [ring(radii, 4 * teeth), ring(rng.uniform(0.06, 0.3), 48)[::-1]]
    elif kind == 2:  # a smooth closed curve
        angle = np.arange(120) * 2 * np.pi / 120
        waves = sum(rng.uniform(-0.09, 0.09) * np.cos(k * angle + rng.uniform(0, 6)) for k in range(2, 6))
        outlines = [ring(0.36 + waves, 120)]
    else:  # a rectangular frame
        half = rng.uniform(0.2, 0.48, 2)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        outlines = [corners, (corners * (1 - rng.uniform(0.05, 0.2) * half.min() * 4))[::-1]]
    shape = extrusion(outlines, rng.uniform(0.08, 0.7))
    if rng.random() < 0.5:
        return shape
    return place_on_ground(shape.rotate(rotation_about(2, rng.uniform(0, 360)) @ rotation_about(0, 90)))


def ring(radius: Array | float, count: int, phase: float = 0.0) -> Array:
    """Return ``count`` points at ``radius`` around the origin, (count, 2)."""
    angle = phase + np.arange(count) * 2 * np.pi / count
    return np.stack((np.cos(angle), np.sin(angle)), axis=1) * np.broadcast_to(radius, (count,))[:, None]


def letter(rng: np.random.Generator) -> Shape:
    """Return an extruded letter or digit, standing or lying."""
    font = FontProperties(family="DejaVu Sans", weight=str(rng.choice(["normal", "bold"])))
    glyph = TextPath((0, 0), str(rng.choice(list(_GLYPHS))), size=1.0, prop=font)
    rings = [np.array(p, dtype=np.float64)[:-1] for p in glyph.to_polygons(closed_only=True)]
    rings.sort(key=lambda p: -np.ptp(p[:, 0]) * np.ptp(p[:, 1]))
    shape = extrusion([r[np.linalg.norm(r - np.roll(r, 1, 0), axis=1) > 1e-9] for r in rings], rng.uniform(0.15, 0.4))
    lying = rng.random() < 0.3
    turn = rotation_about(2, rng.uniform(-60, 60)) @ (np.eye(3) if lying else rotation_about(0, 90))
    return place_on_ground(shape.rotate(turn))


def coil(rng: np.random.Generator) -> Shape:
    """Return a spring or a knot of wire."""
    s = np.linspace(0, 1, 260)
    if rng.random() < 0.5:
        turns, wide = rng.integers(3, 8), rng.uniform(0.15, 0.35)
        path = np.column_stack((wide * np.cos(2 * np.pi * turns * s), wide * np.sin(2 * np.pi * turns * s), 0.8 * s))
        return place_on_ground(tube(path, rng.uniform(0.012, 0.05), 14))
    p, q = ((2, 3), (3, 2), (3, 4), (2, 5))[rng.integers(4)]
    a = 2 * np.pi * s
    radius = 0.3 + 0.12 * np.cos(q * a)
    path = np.column_stack((radius * np.cos(p * a), radius * np.sin(p * a), 0.14 * np.sin(q * a)))
    return place_on_ground(tube(path, rng.uniform(0.02, 0.06), 14).turn(0, rng.choice([0.0, 80.0])))


SOLIDS = (block, superquadric, cylinder, torus, vase, bowl, prism, letter, coil)


def random_solid(rng: np.random.Generator) -> Shape:
    """Return a random one of :data:`SOLIDS`; boxes, balls and vessels are more frequent."""
    weights = np.array([5, 4, 4, 2, 5, 4, 3, 2, 1.5])
    return SOLIDS[rng.choice(len(SOLIDS), p=weights / weights.sum())](rng)
