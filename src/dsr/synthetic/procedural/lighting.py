"""Lights of random scenes: ray tracing, a lamp with soft shadows, ambient light with occlusion, shadow patterns.

Embree finds the triangle, float64 arithmetic the depth. Each triangle stands for the quadratic patch that its vertex
normals suggest (half of the displacement of Phong tessellation, Boubekeur and Alexa 2008, which is exact for a
paraboloid). Flat triangles stay flat, spheres have no facets, and the depth is continuous across edges.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh  # type: ignore[import-untyped]
from embreex.rtcore_scene import EmbreeScene  # type: ignore[import-untyped]
from numpy.typing import NDArray

from dsr.synthetic.procedural.paints import fractal
from dsr.synthetic.procedural.shape import Index, Shape, merge, unit
from dsr.synthetic.raycast import Array

_GRAZING = 0.12  # smallest cosine between ray and normal that a displacement is divided by

Cookie = Callable[[Array], Array]
Corner = Sequence[float]
SETS = 16  # number of sets into which the samples of a light are divided; neighbouring pixels use different sets
_SAMPLES_PER_SET = 3


class Hits(NamedTuple):
    """The points where N rays from the camera meet the surfaces."""

    depth: Array  # (N,) ray parameter, which is the orthogonal depth; inf where nothing is hit
    face: Index  # (N,) number of the triangle, -1 where nothing is hit
    body: Index  # (N,) number of the shape
    points: Array  # (3, N) in the frame of the shapes
    normals: Array  # (3, N), facing the camera
    rest: Array  # (3, N) the paint's coordinates, as in `dsr.synthetic.procedural.shape.Shape`
    chart: Array  # (3, N)
    bulge: Array  # (N,) distance in metres from the triangle to the point along the normal


class Tracer:
    """Intersects rays with shapes. Ray directions have length 1 along the optical axis, so that t is the depth."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        mesh = merge(shapes)
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        keep = area > 1e-13
        self._faces = mesh.faces[keep]
        self._body = np.repeat(np.arange(len(shapes)), [len(s.faces) for s in shapes])[keep]
        self._table = np.concatenate((mesh.vertices, mesh.normals, mesh.rest, mesh.chart), axis=1)  # (V, 12)
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, mesh.vertices.astype(np.float32), self._faces.astype(np.int32))

    def triangles(self, face: Index) -> Array:
        """Return the corners (3 of the triangle, 3 coordinates, N) of the triangles ``face`` (N,)."""
        return np.stack([self._table[self._faces[face, i], :3].T for i in range(3)])

    def trace(self, eye: Array, rays: Array) -> Hits:
        """Return the first hits of rays (3, N) from ``eye`` (3,)."""
        ahead = np.ascontiguousarray(rays.T, dtype=np.float32)
        start = np.ascontiguousarray(np.broadcast_to(eye, ahead.shape), dtype=np.float32)
        face = np.asarray(self._scene.run(start, ahead), dtype=np.intp)
        known = np.maximum(face, 0)
        rows = [self._table[self._faces[known, i]].T for i in range(3)]  # 3 x (12, N)
        corners = [row[:3] - eye[:, None] for row in rows]
        t, weights = _intersect(corners, rays)
        flat = sum(w * p for w, p in zip(weights, corners, strict=True))
        normal = np.asarray(sum(w * row[3:6] for w, row in zip(weights, rows, strict=True)))
        normal = normal / np.maximum(np.sqrt((normal**2).sum(0)), 1e-300)
        bulge = np.zeros(weights.shape[1])  # the signed height of the curved patch above its triangle
        for w, p, row in zip(weights, corners, rows, strict=True):
            bulge += 0.5 * w * ((p - flat) * row[3:6]).sum(0) * (row[3:6] * normal).sum(0)
        slope, least = (normal * rays).sum(0), _GRAZING * np.sqrt((rays**2).sum(0))
        along = bulge / np.where(np.abs(slope) > least, slope, np.copysign(least, slope))  # in units of the ray
        depth = np.where(face < 0, np.inf, t + along)
        facing = -np.sign(slope)
        paint = sum(w * row[6:] for w, row in zip(weights, rows, strict=True))
        points = eye[:, None] + np.where(face < 0, 0.0, depth) * rays
        return Hits(depth, face, self._body[known], points, normal * facing, paint[:3], paint[3:], bulge * facing)

    def is_blocked(self, origin: Array, toward: Array) -> NDArray[np.bool_]:
        """Return whether something lies between ``origin`` and ``origin + toward``, both (3, N), shape (N,)."""
        start = np.ascontiguousarray(origin.T, dtype=np.float32)
        ahead = np.ascontiguousarray(toward.T, dtype=np.float32)
        lengths = np.ones(len(start), dtype=np.float32)
        return np.asarray(self._scene.run(start, ahead, dists=lengths, query="OCCLUDED")) >= 0


def _intersect(corners: Sequence[Array], rays: Array) -> tuple[Array, Array]:
    """Return the parameter (N,) and the barycentric weights (3, N) where rays meet the planes of their triangles."""
    a, b, c = corners
    one, two = b - a, c - a
    normal = _cross(one, two)
    slope = (normal * rays).sum(0)
    safe = np.where(slope == 0, 1e-300, slope)
    t = (normal * a).sum(0) / safe
    lever = _cross(rays, -a)
    u, v = (lever * two).sum(0) / safe, -(lever * one).sum(0) / safe
    weights = np.clip(np.stack((1 - u - v, u, v)), 0.0, 1.0)
    return t, weights / weights.sum(0)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product of (3, N) vectors."""
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light in a scene."""

    lamp: Array  # (SETS, L, 3) sample points of the lamp in metres
    colour: Array  # (3,) colour and strength of the lamp
    cookie: Cookie  # from points (3, N) to the fraction of the lamp's light that arrives there, as through leaves
    ambient: Array  # (3,) colour of the light from all directions
    sky: Array  # (3,) colour of additional light from above
    directions: Array  # (SETS, A, 3) unit vectors, cosine distributed about z, the normal
    occlusion_distance: float  # metres within which surfaces occlude each other's ambient light


def random_lighting(rng: np.random.Generator, tracer: Tracer, seen: Hits, low: Corner, high: Corner) -> Lighting:
    """Return random lights for the surfaces of a preview; the lamp may hang in a box from ``low`` to ``high``."""
    middle = np.median(seen.points, axis=1)
    extent = float(np.median(seen.depth))
    points, normals = seen.points, seen.normals
    best, position = -1.0, middle
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
    warm = 1.0 + rng.uniform(-0.25, 0.35) * np.array([0.5, 0.0, -0.6])
    ambient_fraction = rng.uniform(0.12, 0.9)
    ambient = ambient_fraction * 0.7 * (2 - warm)
    sky = ambient_fraction * rng.uniform(0.0, 0.6) * np.array([0.9, 1.0, 1.15])
    cookie = _cookie(rng, frame, middle, distance) if rng.random() < 0.22 else lambda points: np.ones(points.shape[1])
    strength = (1.15 - ambient_fraction) * distance**2
    cells = _stratified(rng, SETS * _SAMPLES_PER_SET)
    spread, angle = np.sqrt(cells[:, 0]), 2 * np.pi * cells[:, 1]
    around = np.column_stack((spread * np.cos(angle), spread * np.sin(angle), np.sqrt(1 - cells[:, 0])))
    directions = around.reshape(_SAMPLES_PER_SET, SETS, 3).transpose(1, 0, 2)
    return Lighting(lamp, strength * warm, cookie, ambient, sky, directions, 0.35 * extent)


def _stratified(rng: np.random.Generator, count: int) -> Array:
    """Return points (count, 2) spread over the unit square: a shifted lattice of the plastic number."""
    steps = np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    return (steps + rng.random(2)) % 1.0


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


def visibility(tracer: Tracer, lighting: Lighting, hits: Hits, which: Index, extent: float) -> Array:
    """Return the visible fractions (2, N) of lamp and surroundings, from the sample sets ``which`` (N or more,)."""
    start, n = offset_points(hits, extent), hits.normals
    which = which[: n.shape[1]]
    side = np.where(np.abs(n[2]) < 0.9, np.stack((-n[1], n[0], 0 * n[2])), np.stack((0 * n[0], -n[2], n[1])))
    side /= np.sqrt((side**2).sum(0))
    up = _cross(n, side)
    seen = np.zeros((2, len(which)))
    for k in range(_SAMPLES_PER_SET):
        toward = lighting.lamp[which, k].T - start
        facing = np.flatnonzero((toward * n).sum(0) > 0)
        seen[0, facing] += ~tracer.is_blocked(start[:, facing], toward[:, facing])
        a, b, c = lighting.occlusion_distance * lighting.directions[which, k].T
        seen[1] += ~tracer.is_blocked(start, a * side + b * up + c * n)
    return seen / _SAMPLES_PER_SET


def incident_light(lighting: Lighting, points: Array, normals: Array, seen: Array) -> tuple[Array, Array]:
    """Return the light (3, N) that arrives at surfaces, and the lamp's at normal incidence (N,) for highlights."""
    toward = lighting.lamp.mean((0, 1))[:, None] - points
    square = (toward**2).sum(0)
    direct = seen[0] * lighting.cookie(points) / square
    slope = np.maximum((toward * normals).sum(0) / np.sqrt(square), 0.0)
    around = (0.15 + 0.85 * seen[1]) * (lighting.ambient[:, None] + (0.5 + 0.5 * normals[2]) * lighting.sky[:, None])
    return around + direct * slope * lighting.colour[:, None], direct
