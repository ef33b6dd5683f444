"""Ray tracing of triangle meshes: Embree finds the triangle, float64 arithmetic the depth.

Each triangle stands for the quadratic patch that its vertex normals suggest (half of the displacement of Phong
tessellation, Boubekeur and Alexa 2008, which is exact for a paraboloid). Flat triangles stay flat, spheres have no
facets, and the depth is continuous across edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh  # type: ignore[import-untyped]
from embreex.rtcore_scene import EmbreeScene  # type: ignore[import-untyped]
from numpy.typing import NDArray

from dsr.synthetic.procedural.shape import Index, Shape, merge
from dsr.synthetic.surfaces import Array

_GRAZING = 0.12  # smallest cosine between ray and normal that a displacement is divided by


@dataclass(frozen=True, eq=False)
class Hits:
    """The points where N rays from the camera meet the surfaces.

    Args:
        depth: (N,) ray parameter, which is the orthogonal depth; inf where nothing is hit.
        face: (N,) number of the triangle, -1 where nothing is hit.
        body: (N,) number of the shape.
        points, normals: (3, N) in the frame of the shapes; normals face the camera.
        rest, chart: (3, N) the paint's coordinates, as in :class:`dsr.synthetic.procedural.shape.Shape`.
        bulge: (N,) distance in metres from the triangle to the point along the normal.

    """

    depth: Array
    face: Index
    body: Index
    points: Array
    normals: Array
    rest: Array
    chart: Array
    bulge: Array


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

    def first_triangle(self, eye: Array, rays: Array) -> Index:
        """Return the triangle (N,) that each ray (3, N) from ``eye`` (3,) meets first, -1 for none."""
        ahead = np.ascontiguousarray(rays.T, dtype=np.float32)
        start = np.ascontiguousarray(np.broadcast_to(eye, ahead.shape), dtype=np.float32)
        return np.asarray(self._scene.run(start, ahead), dtype=np.intp)

    def triangles(self, face: Index) -> Array:
        """Return the corners (3 of the triangle, 3 coordinates, N) of the triangles ``face`` (N,)."""
        return np.stack([self._table[self._faces[face, i], :3].T for i in range(3)])

    def trace(self, eye: Array, rays: Array) -> Hits:
        """Return the first hits of rays (3, N) from ``eye`` (3,)."""
        face = self.first_triangle(eye, rays)
        known = np.maximum(face, 0)
        rows = [self._table[self._faces[known, i]].T for i in range(3)]  # 3 x (12, N)
        corners = [row[:3] - eye[:, None] for row in rows]
        t, weights = _intersect(corners, rays)
        bulge, normal = _bulge(corners, [row[3:6] for row in rows], weights)
        depth = np.where(face < 0, np.inf, t + _along(bulge, normal, rays))
        facing = -np.sign((normal * rays).sum(0))
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


def _bulge(corners: Sequence[Array], normals: Sequence[Array], weights: Array) -> tuple[Array, Array]:
    """Return the signed height (N,) of the curved patch above its triangle and the unit normal (3, N)."""
    flat = sum(w * p for w, p in zip(weights, corners, strict=True))
    normal = np.asarray(sum(w * n for w, n in zip(weights, normals, strict=True)))
    normal = normal / np.maximum(np.sqrt((normal**2).sum(0)), 1e-300)
    height = np.zeros(weights.shape[1])
    for w, p, n in zip(weights, corners, normals, strict=True):
        height += 0.5 * w * ((p - flat) * n).sum(0) * (n * normal).sum(0)
    return height, normal


def _along(bulge: Array, normal: Array, rays: Array) -> Array:
    """Return how far along the rays the displacement ``bulge`` moves the hit, in units of the ray."""
    slope = (normal * rays).sum(0)
    least = _GRAZING * np.sqrt((rays**2).sum(0))
    return bulge / np.where(np.abs(slope) > least, slope, np.copysign(least, slope))
