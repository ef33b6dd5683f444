"""Fewer triangles and points, for meshes and clouds beyond a limit.

Meshes are simplified by quadric edge collapses (Garland and Heckbert, *Surface Simplification Using Quadric Error
Metrics*, SIGGRAPH 1997), as the library `fast-simplification` (the extra ``mesh``) has them: flat regions become few
large triangles, and curved ones keep theirs. Without the library, rows and columns are left out.
"""

from __future__ import annotations

import importlib
import math

import numpy as np
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.mesh import Mesh, triangulate

QUADRIC = "quadric decimation"


def simplify(mesh: Mesh, most: int, camera: Camera) -> Mesh:
    """Return a mesh of at most ``most`` triangles by quadric decimation, or a few more where edges cannot collapse.

    Memory: about 300 bytes per triangle of ``mesh``; time: about a second per million.

    Args:
        mesh: is returned as it is if it has no more.
        most: triangles, 1 at least.
        camera: of the map that the mesh was made of.

    Raises:
        ImportError: `fast-simplification` is not installed.

    """
    if len(mesh.faces) <= most:
        return mesh
    library = importlib.import_module("fast_simplification")
    points, faces = library.simplify(mesh.vertices, mesh.faces, target_count=most)
    used = np.unique(faces)
    place_of = np.zeros(len(points), np.int32)
    place_of[used] = np.arange(len(used), dtype=np.int32)
    vertices = points[used].astype(np.float32)
    places = project(vertices, camera).round().astype(np.int64)
    return Mesh(vertices, place_of[faces], places[:, 1] * camera.width + places[:, 0])


def thin(depth: Tensor, camera: Camera, most: int, largest_step: float) -> tuple[Mesh, int]:
    """Return a mesh of at most ``most`` triangles, of every second, third, ... row and column, and that stride.

    Args:
        depth: (1, H, W) orthogonal depth in metres, NaN in holes.
        camera: of these pixels.
        most: triangles.
        largest_step: see :func:`dsr.geometry.mesh.triangulate`.

    """
    stride = max(2, math.isqrt(2 * int(depth.isfinite().sum()) // most))
    while len((mesh := triangulate(depth, camera, largest_step=largest_step, stride=stride)).faces) > most:
        stride += 1
    return mesh, stride


def select_points(mesh: Mesh, most: int, camera: Camera) -> np.ndarray:
    """Return the indices of at most ``most`` vertices of an unsimplified mesh, (N,), evenly spread in the image.

    They are those in rows and columns at equal distances, which need not be whole numbers of pixels.

    Args:
        mesh: whose ``pixels`` are read.
        most: vertices, 1 at least.
        camera: of the map that the mesh was made of.

    """
    count = len(mesh.pixels)
    if count <= most:
        return np.arange(count)
    rows, columns = np.divmod(mesh.pixels, camera.width)
    step = math.sqrt(count / most)
    while True:
        chosen = _is_chosen(camera.height, step)[rows] & _is_chosen(camera.width, step)[columns]
        if np.count_nonzero(chosen) <= most:
            return np.flatnonzero(chosen)
        step *= 1.02


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the column and row of points in the image, (N, 2) float64, pixel centres at integers, clipped to it.

    Args:
        points: (N, 3) in the camera frame, in front of it.
        camera: the camera.

    """
    x, y, z = points.astype(np.float64).T
    places = np.stack((x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy), axis=1)
    return places.clip(0, (camera.width - 1, camera.height - 1))


def _is_chosen(size: int, step: float) -> np.ndarray:
    """Return which of ``size`` rows or columns are nearest to multiples of a step of at least 1, (size,) bool."""
    chosen = np.zeros(size, bool)
    chosen[np.arange(0, size, step).astype(int)] = True
    return chosen
