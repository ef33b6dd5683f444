"""Triangle meshes with normals and paint coordinates, and general functions that make them.

A shape stands for the curved surface that its vertex normals define (see :mod:`dsr.synthetic.procedural.photo`), so
the vertices of sharp edges occur twice, with different normals. Local frames have z up; lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from dsr.synthetic.raycast import Array, rotation_about

Index = NDArray[np.intp]


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
    q = unit(rng.normal(size=(1, 3)))[0]
    spin = rotation_about(2, rng.uniform(0, 360))
    other = unit(np.cross(q, [0.3, 0.5, 0.81])[None])[0]
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
    """Return the surface of revolution about the z axis of a profile.

    Its sections, (K, 2) each, are radius and height along smooth pieces; edges between pieces are sharp.
    """
    angle = np.linspace(0, 2 * np.pi, 81)
    out, up = np.stack((np.cos(angle), np.sin(angle), 0 * angle), axis=1), np.array([0.0, 0.0, 1.0])
    parts = []
    for section in sections:
        tangent = np.gradient(section, axis=0) if len(section) > 2 else np.repeat(np.diff(section, axis=0), 2, axis=0)
        points = section[:, :1, None] * out + section[:, 1:, None] * up
        parts.append(surface(points, tangent[:, 1:, None] * out - tangent[:, :1, None] * up))
    return merge(parts)


def extrusion(outlines: Sequence[Array], height: float) -> Shape:
    """Return a prism from z = 0 to ``height`` over closed polygons (K, 2): the outer one, then holes.

    Corners of the outline below 32 degrees get smooth normals.
    """
    parts = []
    for outline in outlines:  # the walls
        after = np.roll(outline, -1, axis=0)
        edge = after - outline
        normal = unit(np.column_stack((edge[:, 1], -edge[:, 0], 0 * edge[:, 0])))
        before, behind = np.roll(normal, 1, axis=0), np.roll(normal, -1, axis=0)
        smooth = ((normal * before).sum(1) > np.cos(np.deg2rad(32.0)))[:, None]
        start = np.where(smooth, unit(normal + before), normal)
        end = np.where(np.roll(smooth, -1), unit(normal + behind), normal)
        arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(edge, axis=1))))
        foot, along = np.concatenate((outline, after)), np.concatenate((arc[:-1], arc[1:]))
        points = np.concatenate([_at_height(foot, z) for z in (0.0, height)])
        chart = np.concatenate([np.column_stack((along, np.full(len(along), z), 0 * along)) for z in (0.0, height)])
        a, b, c, d = np.arange(4 * len(outline)).reshape(4, -1)
        faces = np.concatenate((np.stack((a, b, c), 1), np.stack((b, d, c), 1)))
        parts.append(Shape(points, faces, np.concatenate((start, end, start, end)), chart, points))
    flat = np.concatenate(outlines)
    ends = np.cumsum([len(o) for o in outlines]).astype(np.uint32)
    faces = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ends).reshape(-1, 3).astype(np.intp)
    for z in (0.0, height):
        points = _at_height(flat, z)
        normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        parts.append(Shape(points, faces, normals, _at_height(flat, 0.0), points))
    return merge(parts)


def _at_height(flat: Array, z: float) -> Array:
    """Return the points (K, 3) at height ``z`` over points (K, 2)."""
    return np.column_stack((flat, np.full(len(flat), z)))


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
    return surface(points, np.broadcast_to(unit(np.cross(a, b)[None])[0], points.shape))


def box(size: Sequence[float] | Array) -> Shape:
    """Return the box of edges ``size`` (3,) that stands on z = 0 over the origin."""
    x, y, z = size
    e = np.diag(np.asarray(size, dtype=np.float64))
    low, high = np.array([-x / 2, -y / 2, 0.0]), np.array([x / 2, y / 2, float(z)])
    pairs = ((0, 1), (0, 2), (1, 2))
    return merge([quad(low, e[i], e[j]) for i, j in pairs] + [quad(high, -e[i], -e[j]) for i, j in pairs])
