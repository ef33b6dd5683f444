"""From the bodies of a layout to a photo: viewpoint, visibility, shading, antialiasing, exposure, lens and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dsr.geometry.camera import Camera
from dsr.synthetic.procedural.lighting import SETS, Hits, Lighting, Tracer, incident_light, visibility
from dsr.synthetic.procedural.paints import Paint
from dsr.synthetic.procedural.shape import Index, Shape, unit
from dsr.synthetic.raycast import Array, encode, local_contrast

_CHUNK = 1 << 15
_SUBPIXELS = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
_MAX_SUPERSAMPLED = 0.45  # largest fraction of the pixels that are supersampled


@dataclass(frozen=True, eq=False)
class Body:
    """A shape with its paint, and the strength ``gloss`` and exponent ``shine`` of its highlights."""

    shape: Shape
    paint: Paint
    gloss: float = 0.0
    shine: float = 20.0


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """The pose and the intrinsics of a camera in a layout."""

    eye: Array  # (3,) position of the camera in metres, z up
    target: Array  # (3,) point in the middle of the picture in metres
    focal: float  # focal length in image widths
    roll: float  # rotation about the viewing direction in degrees
    centre: Array  # (2,) principal point in image widths from the left and upper edge

    def axes(self) -> Array:
        """Return the camera's right, down and forward axes as rows (3, 3)."""
        forward = unit((self.target - self.eye)[None])[0]
        right = unit(np.cross(forward, [0.0, 0.0, 1.0])[None])[0]
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
    which = ((u % 4 + 4 * (v % 4)) * 7 % SETS).ravel()  # of light samples; each 4 x 4 window has every set once
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
    light, direct = incident_light(lighting, hits.points, hits.normals, seen)
    half = _unit(_unit(lighting.lamp.mean((0, 1))[:, None] - hits.points) + _unit(eye[:, None] - hits.points))
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


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt((vectors**2).sum(0))


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
