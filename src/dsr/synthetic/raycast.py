"""A small ray caster for synthetic scenes: exact depth, area light with soft shadows, antialiased colour.

Frame: that of :mod:`dsr.geometry.camera` (x right, y down, z forward, metres). Points and directions are float64 arrays
of shape (3, N). A camera ray has z = 1, so that the ray parameter of its hit is the orthogonal depth. Paints are
functions from points in metres to linear RGB (3, N).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from dsr.geometry.camera import Camera

Array = NDArray[np.float64]
Field = Callable[[Array], Array]

_CHUNK = 1 << 16  # rays at a time: temporaries stay in the cache
_LIFT = 1e-4  # metres that a shadow ray starts above its surface
_CELL = 0.0125  # metres between the samples of an implicit surface's lattice


def rotation_about(axis: int, degrees: float) -> Array:
    """Return the matrix (3, 3) of the rotation about the coordinate axis ``axis``."""
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    turn, angle = np.eye(3), np.deg2rad(degrees)
    turn[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return turn


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation by ``roll`` about z, then ``pitch`` about x, then ``yaw`` about y, in degrees."""
    return rotation_about(1, yaw) @ (rotation_about(0, pitch) @ rotation_about(2, roll))


class Surface(ABC):
    """An opaque surface seen from outside."""

    @abstractmethod
    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the smallest t > 0 with origin + t * direction on the surface, inf where there is none, (N,)."""

    @abstractmethod
    def normal(self, points: Array) -> Array:
        """Return the outward unit normals (3, N) at ``points`` on the surface."""

    def visibility(self, origin: Array, direction: Array, spread: float) -> Array:
        """Return the visible fraction (N,) of a light of radius ``spread`` metres at origin + direction."""
        return np.asarray(self.intersect(origin, direction) >= 1, dtype=np.float64)  # in closed form, a point light

    def openness(self, points: Array, normals: Array) -> Array:
        """Return the fraction (N,) of the surroundings that the surface does not occlude at its ``points``."""
        return np.ones(points.shape[1])


@dataclass(frozen=True, eq=False)
class Plane(Surface):
    """The plane through ``point`` (3,) with the unit normal ``facing`` (3,), seen from that side."""

    point: Array
    facing: Array

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return where the rays meet the plane from its front."""
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
        """Return ``points`` (3, N) in the body's own frame."""
        return self.axes.T @ (points - self.centre[:, None])

    @abstractmethod
    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return the parameters (N,) at which rays enter and leave the body; enter > leave on a miss."""

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return where the rays enter the body."""
        enter, leave = self.interval(origin, direction)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True, eq=False)
class Sphere(Convex):
    """A sphere of ``radius`` metres."""

    radius: float

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return where the rays enter and leave the sphere."""
        return _intersect_round(self.to_local(origin), self.axes.T @ direction, self.radius)

    def normal(self, points: Array) -> Array:
        """Return the directions from the centre."""
        away = self.to_local(points)
        return self.axes @ (away / np.sqrt((away**2).sum(0)))


@dataclass(frozen=True, eq=False)
class Box(Convex):
    """A box with the half edges ``half`` (3,) in metres."""

    half: Array

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return where the rays are between the faces of all three pairs."""
        start, way = self.to_local(origin), self.axes.T @ direction
        slabs = [_intersect_slab(start[i], way[i], self.half[i]) for i in range(3)]
        return np.maximum.reduce([s[0] for s in slabs]), np.minimum.reduce([s[1] for s in slabs])

    def normal(self, points: Array) -> Array:
        """Return the normals of the nearest faces."""
        away = self.to_local(points)
        face = np.argmax(np.abs(away) - self.half[:, None], axis=0)
        return self.axes @ np.where(np.arange(3)[:, None] == face, np.sign(away), 0.0)


@dataclass(frozen=True, eq=False)
class Cylinder(Convex):
    """A capped cylinder along its own y axis, ``radius`` and ``half`` height in metres."""

    radius: float
    half: float

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Return where the rays are within the side and between the caps."""
        start, way = self.to_local(origin), self.axes.T @ direction
        side = _intersect_round(start[::2], way[::2], self.radius)
        caps = _intersect_slab(start[1], way[1], self.half)
        return np.maximum(side[0], caps[0]), np.minimum(side[1], caps[1])

    def normal(self, points: Array) -> Array:
        """Return the normals of the caps or the side, whichever is nearer."""
        x, y, z = self.to_local(points)
        across = np.maximum(np.hypot(x, z), 1e-300)
        cap = np.abs(y) - self.half > across - self.radius
        side = np.stack((x / across, np.zeros_like(across), z / across))
        return self.axes @ np.where(cap, np.sign(y) * np.array([[0.0], [1.0], [0.0]]), side)


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


@dataclass(frozen=True, eq=False)
class Implicit(Surface):
    """The zero set of a continuous function, positive outside."""

    distance: Field  # from points (3, N) to approximate distances (N,) in metres
    bounds: Box  # contains the surface
    step_fraction: float = 0.7  # of ``distance``, a safe step; 1 for a true distance function

    @cached_property
    def _samples(self) -> NDArray[np.float32]:
        """``distance`` on a lattice over the bounds."""
        nx, ny, nz = (math.ceil(2 * half / _CELL) + 1 for half in self.bounds.half)
        lattice = _CELL * np.indices((ny, nz)).reshape(2, -1)
        low = self.bounds.centre - self.bounds.half
        out = np.empty((nx, ny, nz), np.float32)
        for i in range(nx):
            points = low[:, None] + np.vstack((np.full_like(lattice[:1], i * _CELL), lattice))
            out[i] = self.distance(points).reshape(ny, nz)
        return out

    def _interpolate_distance(self, points: Array) -> Array:
        """Return ``distance`` interpolated from the lattice, which is fast and correct within about a cell."""
        place = (points - (self.bounds.centre - self.bounds.half)[:, None]) / _CELL
        return np.asarray(map_coordinates(self._samples, place, np.float64, order=1, mode="nearest"))

    def intersect(self, origin: Array, direction: Array) -> Array:
        """Return the first root along the rays, found by sphere tracing."""
        scale = np.sqrt((direction**2).sum(0))
        t, leave = self.bounds.interval(origin, direction)
        t = np.maximum(t, 0.0)
        out, before = np.full(t.shape, np.inf), t.copy()
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._interpolate_distance(origin[:, live] + t[live] * direction[:, live]) - 1.5 * _CELL
            near = np.flatnonzero(value < 0.25 * _CELL)
            at = live[near]
            value[near] = self.distance(origin[:, at] + t[at] * direction[:, at])
            out[live[value < 0]] = t[live[value < 0]]
            live, value = live[value >= 0], value[value >= 0]
            before[live] = t[live]
            t[live] += np.maximum(self.step_fraction * value, 5e-4) / scale[live]
            live = live[t[live] < leave[live]]
        found = np.flatnonzero(np.isfinite(out))
        out[found] = self._root(origin[:, found], direction[:, found], before[found], out[found])
        return out

    def _root(self, origin: Array, direction: Array, low: Array, high: Array) -> Array:
        """Return the root between ``low`` (outside) and ``high`` (inside), by false position and bisection in turn."""
        out, live = high.copy(), np.arange(high.size)
        f_low, f_high = (self.distance(origin + t * direction) for t in (low, high))
        while np.any(early := f_low < 0):  # the interpolated distance was too large
            low = np.where(early, low - _CELL / 4, low)
            f_low = self.distance(origin + low * direction)
        for step in range(80):
            weight = 0.5 if step % 3 == 2 else f_low / np.maximum(f_low - f_high, 1e-300)
            out[live] = middle = low + weight * (high - low)
            value = self.distance(origin[:, live] + middle * direction[:, live])
            outside = value >= 0
            low, f_low = np.where(outside, middle, low), np.where(outside, value, f_low)
            high, f_high = np.where(outside, high, middle), np.where(outside, f_high, value)
            on = np.abs(value) >= 1e-11
            live, low, high, f_low, f_high = live[on], low[on], high[on], f_low[on], f_high[on]
            if not live.size:
                break
        return out

    def normal(self, points: Array) -> Array:
        """Return the normalised gradient by differences over 0.3 mm at the corners of a tetrahedron."""
        corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=np.float64)
        gradient = sum(c[:, None] * self.distance(points + 3e-4 * c[:, None]) for c in corners)
        return np.asarray(gradient / np.maximum(np.sqrt(np.sum(gradient**2, axis=0)), 1e-300))

    def visibility(self, origin: Array, direction: Array, spread: float) -> Array:
        """Return the visible fraction of the patch, estimated from the smallest lattice distance to the ray."""
        length = np.sqrt((direction**2).sum(0))
        t, leave = self.bounds.interval(origin, direction)
        t, leave = np.maximum(t, 1.6 * _CELL / length), np.minimum(leave, 1.0)
        clear = np.ones(t.shape)
        live = np.flatnonzero(t < leave)
        while live.size:
            value = self._interpolate_distance(origin[:, live] + t[live] * direction[:, live]) + 0.15 * _CELL
            clear[live] = np.minimum(clear[live], value / (t[live] * spread))
            t[live] += np.maximum(self.step_fraction * np.abs(value), 6e-3) / length[live]
            live = live[(t[live] < leave[live]) & (clear[live] > -1)]
        clear = np.maximum(clear, -1.0)
        return 0.25 * (1 + clear) ** 2 * (2 - clear)

    def openness(self, points: Array, normals: Array) -> Array:
        """Return the openness, estimated from the distances at three heights above the surface."""
        lost = np.zeros(points.shape[1])
        for height, weight in ((0.012, 8.0), (0.035, 4.0), (0.08, 2.0)):
            lost += weight * np.maximum(height - self.distance(points + height * normals), 0.0)
        return np.exp(-2.2 * lost)


@dataclass(frozen=True, eq=False)
class Body:
    """A surface and its ``albedo``, which maps points (3, N) on it to linear RGB (3, N)."""

    surface: Surface
    albedo: Field


@dataclass(frozen=True, eq=False)
class World:
    """The bodies and lights of a scene; the bodies cover the whole view."""

    bodies: tuple[Body, ...]
    lights: Array  # (3, L) sample points of the area light in metres
    spread: float  # radius in metres of the patch that each sample point represents


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
    depth, index = np.empty(direction.shape[1]), np.empty(direction.shape[1], np.intp)
    for start in range(0, depth.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        rays = direction[:, part]
        t = np.stack([body.surface.intersect(np.zeros_like(rays), rays) for body in scene.bodies])
        depth[part], index[part] = t.min(axis=0), t.argmin(axis=0)
    return depth, index


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
    rays, shape = camera.rays().numpy().reshape(3, -1), (camera.height, camera.width)
    depth, index = cast(scene, rays)
    colour = np.empty_like(rays)
    for start in range(0, depth.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        colour[:, part] = shade(scene, depth[part] * rays[:, part], index[part], scene.lights)
    rough = np.flatnonzero(local_contrast(encode(colour).reshape(3, *shape)) > 0.04)
    offsets = np.array([((i % 3 - 1) / 3 / camera.fx, (i // 3 - 1) / 3 / camera.fy, 0.0) for i in range(9)])
    for start in range(0, rough.size, _CHUNK):
        pixels = rough[start : start + _CHUNK]
        moved = rays[:, None, pixels] + offsets.T[..., None]  # (3, 9, N); each of the nine uses a ninth of the light
        fine, which = (hit.reshape(9, -1) for hit in cast(scene, moved.reshape(3, -1)))
        parts = (shade(scene, fine[k] * moved[:, k], which[k], scene.lights[:, k::9]) for k in range(9))
        colour[:, pixels] = sum(parts) / 9
    rgb = np.rint(255 * encode(colour)).astype(np.uint8)
    return np.ascontiguousarray(rgb.T).reshape(*shape, 3), depth.reshape(shape)


def encode(linear: Array) -> Array:
    """Return display values in [0, 1] for linear light."""
    return np.clip(linear, 0.0, 1.0) ** (1 / 2.2)


def local_contrast(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the largest difference of a channel of ``image`` (3, H, W) within 3 x 3 pixels, (H, W)."""
    highest = maximum_filter(image, (1, 3, 3), mode="nearest")
    return np.asarray((highest - minimum_filter(image, (1, 3, 3), mode="nearest")).max(0))


TILT = rotation(37.0, 31.0, 29.0)  # so that the lattice of noise is not parallel to edges


def noise(points: Array, cell: float, seed: int | np.int64, order: int = 1) -> Array:
    """Return noise (N,) in [0, 1] at ``points`` (3, N), one value per ``cell`` metres; order 3 is a B-spline."""
    place = points / cell
    if order == 1:
        part = place - np.floor(place)
        place += part * part * (3 - 2 * part) - part
    return np.asarray(map_coordinates(random_table(seed), place, order=order, mode="grid-wrap", prefilter=False))


@lru_cache(maxsize=32)
def random_table(seed: int | np.int64) -> Array:
    """Return 32 x 32 x 32 values in [0, 1)."""
    return np.random.default_rng(seed).random((32, 32, 32))


def mix(palette: Array, position: Array) -> Array:
    """Return the colours (3, N) at ``position`` (N,) in [0, 1] along a palette (K, 3) of linear RGB colours."""
    knots = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(position, knots, channel) for channel in palette.T])
