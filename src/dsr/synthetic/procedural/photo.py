"""From the bodies of a layout to a photo: ray tracing, light and shadow, shading, exposure, lens and noise.

Embree finds the triangle, float64 arithmetic the depth. Each triangle stands for the quadratic patch that its vertex
normals suggest (half of the displacement of Phong tessellation, Boubekeur and Alexa 2008, which is exact for a
paraboloid). Flat triangles stay flat, spheres have no facets, and the depth is continuous across edges.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh  # type: ignore[import-untyped]
from embreex.rtcore_scene import EmbreeScene  # type: ignore[import-untyped]
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dsr.geometry.camera import Camera
from dsr.synthetic.procedural.materials import Body, fractal
from dsr.synthetic.procedural.shape import Index, Shape, merge, unit
from dsr.synthetic.raycast import Array, encode, local_contrast

_CHUNK = 1 << 15
_GRAZING = 0.12  # smallest cosine between ray and normal that a displacement is divided by
_SETS = 16  # number of sets into which the samples of a light are divided; neighbouring pixels use different sets
_SAMPLES_PER_SET = 3
_SUBPIXELS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
_MAX_SUPERSAMPLED = 0.45  # largest fraction of the pixels that are supersampled

Cookie = Callable[[Array], Array]


class Hits(NamedTuple):
    """The points where N rays from the camera meet the surfaces."""

    depth: Array  # (N,) ray parameter, which is the orthogonal depth; inf where nothing is hit
    face: Index  # (N,) number of the triangle, -1 where nothing is hit
    body: Index  # (N,) number of the shape
    points: Array  # (3, N) in the frame of the shapes
    normals: Array  # (3, N), facing the camera
    rest: Array  # (3, N) the paint's coordinates, as in `dsr.synthetic.procedural.shape.Shape`
    chart: Array  # (3, N)
    bulge: Array  # (N,) distance from the triangle to the point along the normal


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

    def trace(self, eye: Array, rays: Array) -> Hits:
        """Return the first hits of rays (3, N) from ``eye`` (3,)."""
        ahead = np.ascontiguousarray(rays.T, dtype=np.float32)
        start = np.ascontiguousarray(np.broadcast_to(eye, ahead.shape), dtype=np.float32)
        face = np.asarray(self._scene.run(start, ahead), dtype=np.intp)
        known = np.maximum(face, 0)
        rows = [self._table[self._faces[known, i]].T for i in range(3)]  # 3 x (12, N)
        corners = [row[:3] - eye[:, None] for row in rows]
        # the ray parameter and the barycentric weights where the rays meet the planes of their triangles
        one, two = corners[1] - corners[0], corners[2] - corners[0]
        plane = _cross(one, two)
        slope = (plane * rays).sum(0)
        safe = np.where(slope == 0, 1e-300, slope)
        t = (plane * corners[0]).sum(0) / safe
        lever = _cross(rays, -corners[0])
        u, v = (lever * two).sum(0) / safe, -(lever * one).sum(0) / safe
        weights = np.clip(np.stack((1 - u - v, u, v)), 0.0, 1.0)
        weights /= weights.sum(0)
        # the signed height of the curved patch above its triangle
        flat = sum(w * p for w, p in zip(weights, corners, strict=True))
        normal = _unit_columns(np.asarray(sum(w * row[3:6] for w, row in zip(weights, rows, strict=True))))
        bulge = np.zeros(face.shape)
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


def _cross(a: Array, b: Array) -> Array:
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def _unit_columns(vectors: Array) -> Array:
    return vectors / np.maximum(np.sqrt((vectors**2).sum(0)), 1e-300)


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light in a scene."""

    lamp: Array  # (_SETS, L, 3) sample points of the lamp
    colour: Array  # (3,) colour and strength of the lamp
    cookie: Cookie  # from points (3, N) to the fraction of the lamp's light that arrives there, as through leaves
    ambient: Array  # (3,) colour of the light from all directions
    sky: Array  # (3,) colour of additional light from above
    directions: Array  # (_SETS, A, 3) unit vectors, cosine distributed about z, the normal
    occlusion_distance: float  # distance within which surfaces occlude each other's ambient light


def random_lighting(
    rng: np.random.Generator, tracer: Tracer, seen: Hits, low: Sequence[float], high: Sequence[float]
) -> Lighting:
    """Return random lights for the surfaces of a preview; the lamp may hang in a box from ``low`` to ``high``."""
    middle = np.median(seen.points, axis=1)
    extent = float(np.median(seen.depth))
    best, position = -1.0, middle
    for _ in range(8):
        way = unit(rng.normal(size=3) * [1, 1, 0.6] + [0, -0.5, 0.7])
        spot = np.clip(middle + extent * rng.uniform(0.5, 2.5) * way, low, high)
        toward = spot[:, None] - seen.points
        slope = (toward * seen.normals).sum(0) / np.sqrt((toward**2).sum(0))
        lit = (slope > 0.02) & ~tracer.is_blocked(_lifted(seen, extent), toward)
        score = min(float(lit.mean()), 0.75) + 0.3 * rng.random()
        if score > best:
            best, position = score, spot
    distance = float(np.linalg.norm(position - middle))
    radius = distance * np.exp(rng.uniform(np.log(0.01), np.log(0.3)))
    frame = np.linalg.svd(unit((position - middle)[None]))[2][1:]  # (2, 3): across the way to the lamp
    # samples are a shifted lattice of the plastic number, which spreads over the unit square
    lattice = np.arange(_SETS * _SAMPLES_PER_SET)[:, None] * np.array([0.7548776662466927, 0.5698402909980532])
    cells = (lattice + rng.random(2)) % 1.0 * 2 - 1
    lamp = position + radius * (cells @ frame).reshape(_SAMPLES_PER_SET, _SETS, 3).transpose(1, 0, 2)
    warm = 1.0 + rng.uniform(-0.25, 0.35) * np.array([0.5, 0.0, -0.6])
    ambient_fraction = rng.uniform(0.12, 0.9)
    ambient = ambient_fraction * 0.7 * (2 - warm)
    sky = ambient_fraction * rng.uniform(0.0, 0.6) * np.array([0.9, 1.0, 1.15])
    cookie = _cookie(rng, frame, middle, distance) if rng.random() < 0.22 else lambda points: np.ones(points.shape[1])
    strength = (1.15 - ambient_fraction) * distance**2
    cells = (lattice + rng.random(2)) % 1.0
    spread, angle = np.sqrt(cells[:, 0]), 2 * np.pi * cells[:, 1]
    around = np.column_stack((spread * np.cos(angle), spread * np.sin(angle), np.sqrt(1 - cells[:, 0])))
    directions = around.reshape(_SAMPLES_PER_SET, _SETS, 3).transpose(1, 0, 2)
    return Lighting(lamp, strength * warm, cookie, ambient, sky, directions, 0.35 * extent)


def _cookie(rng: np.random.Generator, frame: Array, middle: Array, distance: float) -> Cookie:
    """Return the shadow pattern of slats, window bars or leaves, projected along parallel lines."""
    kind, soft = rng.integers(3), rng.uniform(0.01, 0.12)
    period, dark = distance * rng.uniform(0.06, 0.3), rng.uniform(0.0, 0.45)
    turn, seed, cut = rng.uniform(0, np.pi), rng.integers(1 << 31), rng.uniform(0.42, 0.58)

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


def _lifted(hits: Hits, extent: float) -> Array:
    """Return the points (3, N) moved along their normals, so that their own triangles do not shadow them."""
    rise = 2e-4 * extent + 2.2 * np.abs(hits.bulge)
    return hits.points + rise * hits.normals


def visibility(tracer: Tracer, lighting: Lighting, hits: Hits, which: Index, extent: float) -> Array:
    """Return the visible fractions (2, N) of lamp and surroundings, from the sample sets ``which`` (N or more,)."""
    start, n = _lifted(hits, extent), hits.normals
    which = which[: n.shape[1]]
    side = np.where(np.abs(n[2]) < 0.9, np.stack((-n[1], n[0], 0 * n[2])), np.stack((0 * n[0], -n[2], n[1])))
    side = _unit_columns(side)
    up = _cross(n, side)
    seen = np.zeros((2, len(which)))
    for k in range(_SAMPLES_PER_SET):
        toward = lighting.lamp[which, k].T - start
        facing = np.flatnonzero((toward * n).sum(0) > 0)
        seen[0, facing] += ~tracer.is_blocked(start[:, facing], toward[:, facing])
        a, b, c = lighting.occlusion_distance * lighting.directions[which, k].T
        seen[1] += ~tracer.is_blocked(start, a * side + b * up + c * n)
    return seen / _SAMPLES_PER_SET


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The pose and the intrinsics of a camera in a layout."""

    eye: Array  # (3,) position of the camera, z up
    target: Array  # (3,) point in the middle of the picture
    focal: float  # focal length in image widths
    roll: float  # rotation about the viewing direction in degrees
    centre: Array  # (2,) principal point in image widths from the left and upper edge

    def axes(self) -> Array:
        """Return the camera's right, down and forward axes as rows (3, 3)."""
        forward = unit(self.target - self.eye)
        right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
        down = np.cross(forward, right)
        c, s = np.cos(np.deg2rad(self.roll)), np.sin(np.deg2rad(self.roll))
        return np.stack((c * right + s * down, c * down - s * right, forward))

    def rays(self, camera: Camera) -> Array:
        """Return the directions (3, H * W) of the camera's rays in the layout, of length 1 along the optical axis."""
        return np.einsum("ik,ihw->khw", self.axes(), camera.rays().numpy()).reshape(3, -1)


def aim_camera(rng: np.random.Generator, eye: Array, target: Array, low: float, high: float) -> Viewpoint:
    """Return a camera at ``eye`` that looks at ``target``, with a random focal length from ``low`` to ``high``."""
    roll = rng.normal(0, 2) if rng.random() < 0.75 else rng.uniform(-25, 25)
    centre = 0.5 + rng.normal(0, 0.015, 2)
    return Viewpoint(eye, target, float(np.exp(rng.uniform(np.log(low), np.log(high)))), float(roll), centre)


def radiance(
    tracer: Tracer, bodies: Sequence[Body], viewpoint: Viewpoint, camera: Camera, lighting: Lighting
) -> tuple[Array, Array]:
    """Return the linear RGB (3, H, W) and the depth (H, W) of a view."""
    eye, rays, shape = viewpoint.eye, viewpoint.rays(camera), (camera.height, camera.width)
    parts = [tracer.trace(eye, rays[:, i : i + _CHUNK]) for i in range(0, rays.shape[1], _CHUNK)]
    hits = Hits(*(np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True)))
    extent = float(np.median(hits.depth))
    v, u = np.indices(shape)
    which = ((u % 4 + 4 * (v % 4)) * 7 % _SETS).ravel()  # of light samples; each 4 x 4 window has every set once
    seen = [visibility(tracer, lighting, part, which[i * _CHUNK :], extent) for i, part in enumerate(parts)]
    smooth = _smooth_visibility(np.concatenate(seen, axis=1), hits, shape)
    colour = shade(bodies, hits, lighting, eye, smooth)
    display = encode(colour / (2.5 * np.median(colour) + 1e-9)).reshape(3, *shape)
    contrast = local_contrast(display.astype(np.float32)).ravel().astype(np.float64)
    limit = max(0.04, float(np.quantile(contrast, 1 - _MAX_SUPERSAMPLED)))
    rough = np.flatnonzero(contrast > limit)
    right, down, _ = viewpoint.axes()[..., None]
    for start in range(0, rough.size, _CHUNK):
        pixels = rough[start : start + _CHUNK]
        total = np.zeros((3, pixels.size))
        for du, dv in _SUBPIXELS:
            fine = tracer.trace(eye, rays[:, pixels] + du * (right / camera.fx) + dv * (down / camera.fy))
            near = _like_neighbour(hits, fine, pixels, shape, (int(np.sign(du)), int(np.sign(dv))))
            total += shade(bodies, fine, lighting, eye, smooth[:, near])
        colour[:, pixels] = total / len(_SUBPIXELS)
    return colour.reshape(3, *shape), hits.depth.reshape(shape)


def _like_neighbour(hits: Hits, fine: Hits, pixels: Index, shape: tuple[int, int], side: tuple[int, int]) -> Index:
    """Return which pixel on a side of each of ``pixels`` (N,), itself included, is nearest in depth to ``fine``."""
    row, column = np.divmod(pixels, shape[1])
    best, nearest = pixels, np.full(pixels.size, np.inf)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        v = np.clip(row + i * side[1], 0, shape[0] - 1)
        u = np.clip(column + j * side[0], 0, shape[1] - 1)
        other = v * shape[1] + u
        away = np.abs(hits.depth[other] - fine.depth) + 1e3 * (hits.body[other] != fine.body)
        best, nearest = np.where(away < nearest, other, best), np.minimum(away, nearest)
    return best


def _smooth_visibility(seen: Array, hits: Hits, shape: tuple[int, int]) -> Array:
    """Return the visibilities (2, N) averaged over 4 x 4 pixels of the same surface."""
    height, width = shape
    values = seen.reshape(2, height, width).astype(np.float32)
    normals = hits.normals.reshape(3, height, width).astype(np.float32)
    inverse = (1 / hits.depth).reshape(height, width).astype(np.float32)
    slopes = [np.abs(np.gradient(inverse, axis=axis)) for axis in (0, 1)]
    slack = 1e-3 * inverse + 1.5 * np.maximum(*[np.minimum(s, np.roll(s, 1, a)) for a, s in enumerate(slopes)])
    total, weight = np.zeros_like(values), np.zeros((height, width), np.float32)
    for dv in range(-2, 2):
        for du in range(-2, 2):
            v, u = slice(max(0, -dv), height - max(0, dv)), slice(max(0, -du), width - max(0, du))
            here, there = (v, u), (slice(v.start + dv, v.stop + dv), slice(u.start + du, u.stop + du))
            alike = np.einsum("ihw,ihw->hw", normals[:, *here], normals[:, *there]) > 0.9
            near = np.abs(inverse[here] - inverse[there]) < (abs(du) + abs(dv) + 0.5) * slack[here]
            w = (alike & near).astype(np.float32)
            total[:, *here] += w * values[:, *there]
            weight[here] += w
    return np.asarray(total / weight, dtype=np.float64).reshape(2, -1)


def shade(bodies: Sequence[Body], hits: Hits, lighting: Lighting, eye: Array, seen: Array) -> Array:
    """Return the linear RGB (3, N) of the hits, given the visibilities (2, N) of lamp and surroundings."""
    toward = lighting.lamp.mean((0, 1))[:, None] - hits.points
    square = (toward**2).sum(0)
    direct = seen[0] * lighting.cookie(hits.points) / square  # the lamp's light at normal incidence
    slope = np.maximum((toward * hits.normals).sum(0) / np.sqrt(square), 0.0)
    around = lighting.ambient[:, None] + (0.5 + 0.5 * hits.normals[2]) * lighting.sky[:, None]
    light = (0.15 + 0.85 * seen[1]) * around + direct * slope * lighting.colour[:, None]
    half = _unit_columns(_unit_columns(toward) + _unit_columns(eye[:, None] - hits.points))
    mirror = np.maximum((half * hits.normals).sum(0), 0.0)
    out = np.empty_like(light)
    order = np.argsort(hits.body, kind="stable")
    ends = np.searchsorted(hits.body[order], np.arange(len(bodies) + 1))
    for number, body in enumerate(bodies):
        mine = order[ends[number] : ends[number + 1]]
        if mine.size:
            out[:, mine] = light[:, mine] * body.paint(hits.rest[:, mine], hits.chart[:, mine])
            if body.gloss:
                shine = body.gloss * direct[mine] * mirror[mine] ** body.shine
                out[:, mine] += shine * lighting.colour[:, None]
    return out


def develop(linear: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the photo (H, W, 3) of linear RGB (3, H, W): exposure, white balance, lens, noise, tone curve."""
    height, width = linear.shape[1:]
    light, gamma = np.quantile(linear.max(0), rng.uniform(0.85, 0.98)), rng.uniform(1.9, 2.4)
    image = linear * (rng.uniform(0.5, 1.0) / max(float(light), 1e-9))
    image = image * np.exp(rng.normal(0, 0.06, (3, 1, 1)))
    blur = rng.uniform(0.2, 0.6)
    image = gaussian_filter(image, (0, blur, blur))
    v, u = np.indices((height, width), dtype=np.float32) / max(height, width) - 0.5
    image = image * (1 - rng.uniform(0, 0.7) * (u * u + v * v))
    noise = rng.uniform(0.0, 0.012) ** 1.2
    image = image + noise * np.sqrt(np.maximum(image, 0) + 0.01) * rng.standard_normal(image.shape, dtype=np.float32)
    image = np.where(image > 0.8, 0.8 + 0.2 * np.tanh((image - 0.8) / 0.2), image)  # a shoulder
    encoded = np.clip(image, 0, 1) ** (1 / gamma)
    return np.ascontiguousarray(np.rint(255 * encoded).astype(np.uint8).transpose(1, 2, 0))
