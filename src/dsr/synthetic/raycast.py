"""A small ray caster for synthetic scenes: exact depth, area light with soft shadows, antialiased colour.

Frame: that of :mod:`dsr.geometry.camera` (x right, y down, z forward, metres). Points and directions are float64 arrays
of shape (3, N). A camera ray has z = 1, so that the ray parameter of its hit is the orthogonal depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from dsr.geometry.camera import Camera
from dsr.synthetic.surfaces import Array, Field, Plane, Surface

_CHUNK = 1 << 16  # rays at a time: temporaries stay in the cache
_LIFT = 1e-4  # metres that a shadow ray starts above its surface
_SUBPIXELS = [((i % 3 - 1) / 3, (i // 3 - 1) / 3) for i in range(9)]


@dataclass(frozen=True, eq=False)
class Body:
    """A surface and its ``albedo``, which maps points (3, N) on it to linear RGB (3, N)."""

    surface: Surface
    albedo: Field


@dataclass(frozen=True, eq=False)
class World:
    """The bodies and lights of a scene.

    Args:
        bodies: bodies that cover the whole view.
        lights: (3, L) sample points of the area light in metres.
        spread: radius in metres of the patch that each sample point represents.

    """

    bodies: tuple[Body, ...]
    lights: Array
    spread: float


def area_light(centre: Array, side: Array, up: Array, count: int) -> Array:
    """Return ``count``**2 points of the parallelogram centre +- side +- up, one in each cell, shape (3, count**2).

    The points are jittered within their cells, and ordered so that every ninth of them forms a spread-out set.
    """
    rng = np.random.default_rng(7)
    grid = np.stack(np.meshgrid(np.arange(count), np.arange(count)))  # (2, count, count)
    a, b = (2 * (grid + 0.5 + 0.7 * (rng.random(grid.shape) - 0.5)) / count - 1).reshape(2, -1)
    order = np.argsort((grid[0] % 3 + 3 * (grid[1] % 3)).ravel(), kind="stable")  # nine interleaved lattices
    points = centre[:, None] + a * side[:, None] + b * up[:, None]
    return points[:, order].reshape(3, 9, -1).transpose(0, 2, 1).reshape(3, -1)


def cast(scene: World, direction: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the depth (N,) along camera rays (3, N) with z = 1 and the number (N,) of the body that is hit."""
    origin = np.zeros_like(direction)
    t = np.stack([body.surface.intersect(origin, direction) for body in scene.bodies])
    index = np.argmin(t, axis=0)
    return t[index, np.arange(index.size)], index


def shade(scene: World, points: Array, index: NDArray[np.intp], lights: Array) -> Array:
    """Return the linear RGB (3, N) that ``points`` of the bodies ``index`` reflect, lit by the points ``lights``."""
    out = np.empty_like(points)
    for number, body in enumerate(scene.bodies):
        mine = np.flatnonzero(index == number)
        if mine.size:
            p = points[:, mine]
            n = body.surface.normal(p)
            ambient = (0.14 - 0.05 * n[1]) * body.surface.openness(p, n)
            fill = 0.12 * np.maximum(n.T @ np.array([0.75, -0.10, -0.65]), 0.0)
            cool, warm = np.array([[0.94], [0.99], [1.06]]), np.array([[1.04], [1.0], [0.93]])
            out[:, mine] = body.albedo(p) * (cool * (ambient + fill) + warm * _direct(scene, p, n, lights))
    return out


def _direct(scene: World, points: Array, normals: Array, lights: Array) -> Array:
    """Return the light (N,) that arrives from the area light; it is 1 at 3.4 m and normal incidence."""
    total = np.zeros(points.shape[1])
    origin = points + _LIFT * normals
    for light in lights.T:
        toward = light[:, None] - origin
        square = (toward**2).sum(0)
        strength = (toward * normals).sum(0) * square**-1.5
        lit = np.flatnonzero(strength > 0)
        for body in scene.bodies:
            if not isinstance(body.surface, Plane):  # planes surround the scene
                seen = body.surface.visibility(origin[:, lit], toward[:, lit], scene.spread)
                strength[lit] *= seen
                lit = lit[seen > 0]
        total += np.maximum(strength, 0.0)
    return 11.5 * total / lights.shape[1]


def render(scene: World, camera: Camera) -> tuple[NDArray[np.uint8], Array]:
    """Return the photo, (H, W, 3) RGB, and the orthogonal depth in metres, (H, W), of a scene.

    Depth comes from one ray through each pixel centre. Colour comes from the same ray where the picture is smooth, and
    from the mean of 3 x 3 rays within the pixel elsewhere.
    """
    rays = camera.rays().numpy().reshape(3, -1)
    depth, colour = np.empty(rays.shape[1]), np.empty_like(rays)
    for start in range(0, depth.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        depth[part], index = cast(scene, rays[:, part])
        colour[:, part] = shade(scene, depth[part] * rays[:, part], index, scene.lights)
    shape = (camera.height, camera.width)
    rough = np.flatnonzero(_contrast(_encode(colour).reshape(3, *shape)) > 0.04)
    for start in range(0, rough.size, _CHUNK):
        pixels = rough[start : start + _CHUNK]
        colour[:, pixels] = _supersample(scene, camera, rays[:, pixels])
    rgb = np.rint(255 * _encode(colour)).astype(np.uint8)
    return np.ascontiguousarray(rgb.T).reshape(*shape, 3), depth.reshape(shape)


def _supersample(scene: World, camera: Camera, rays: Array) -> Array:
    """Return the mean linear RGB (3, N) of 3 x 3 rays around each of ``rays``; each uses a ninth of the light."""
    offsets = np.array([(du / camera.fx, dv / camera.fy, 0.0) for du, dv in _SUBPIXELS])
    moved = (rays[:, None] + offsets.T[..., None]).reshape(3, -1)
    depth, index = np.empty(moved.shape[1]), np.empty(moved.shape[1], np.intp)
    for start in range(0, depth.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        depth[part], index[part] = cast(scene, moved[:, part])
    total = np.zeros_like(rays)
    for number in range(len(_SUBPIXELS)):
        part = slice(number * rays.shape[1], (number + 1) * rays.shape[1])
        total += shade(scene, depth[part] * moved[:, part], index[part], scene.lights[:, number::9])
    return total / len(_SUBPIXELS)


def _encode(linear: Array) -> Array:
    """Return display values in [0, 1] for linear light."""
    return np.clip(linear, 0.0, 1.0) ** (1 / 2.2)


def _contrast(image: Array) -> Array:
    """Return the largest difference within 3 x 3 pixels over the channels of (3, H, W), shape (H * W,)."""
    size = (1, 3, 3)
    difference = maximum_filter(image, size, mode="nearest") - minimum_filter(image, size, mode="nearest")
    return np.asarray(difference.max(0).ravel())
