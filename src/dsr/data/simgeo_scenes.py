"""SimGeo: six synthetic scenes of simple and of intricate geometry in front of a wall, with exact depth.

After the synthetic test set of Voynov et al., "Perceptual Deep Depth Super-Resolution" (ICCV 2019): the same geometry
with different textures tells whether a method mistakes texture for shape. The scenes are computed, nothing is loaded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from dsr.data.implicit import Implicit
from dsr.data.raycast import Body, World, area_light, render
from dsr.data.simgeo_statue import rotation, statue_distance
from dsr.data.surfaces import Array, Box, Cylinder, Field, Plane, Sphere
from dsr.geometry.camera import VIRTUAL_BASELINE, Camera

SCENES: tuple[str, ...] = (
    "cube_high_freq",
    "cube_no_texture",
    "sphere_cylinder_high_freq",
    "sphere_cylinder_low_freq",
    "sphere_cylinder_no_texture",
    "statue",
)
SCENES_VERSION = 1
"""Raised whenever an image would change."""
FOCAL = 618.0386 / 512
"""Focal length in image widths."""
WALL_Z = 3.95
STATUE_BASE = (0.0, 1.09, 3.02)
"""Camera coordinates of the point of the floor, in metres, that the statue stands on."""


@dataclass(frozen=True)
class Rendering:
    """A photo with its exact depth.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float64 distance to the image plane in metres.
        camera: the camera of both.

    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float64]
    camera: Camera


def render_scene(name: str, size: int = 512) -> Rendering:
    """Return the scene ``name``, one of :data:`SCENES`, at ``size`` x ``size`` pixels, with one view at any size.

    Raises:
        ValueError: there is no such scene, or the size is not positive.

    """
    scene = build_scene(name)
    centre = (size - 1) / 2
    camera = Camera(size, size, FOCAL * size, FOCAL * size, centre, centre, baseline=VIRTUAL_BASELINE)
    rgb, depth = render(scene, camera)
    return Rendering(rgb, depth, camera)


@lru_cache
def build_scene(name: str) -> World:
    """Return the bodies and lights of the scene ``name``; the last body is the back wall."""
    if name not in SCENES:
        raise ValueError(f"scene: expected one of {', '.join(SCENES)}, got {name!r}")
    if name == "statue":
        return _statue_scene()
    style = name.split("_")[-2]  # high, low or no
    bodies = _cube(style) if name.startswith("cube") else _sphere_cylinder(style)
    lights = area_light(np.array([-1.75, -2.05, 0.6]), np.array([0.42, 0.0, 0.3]), np.array([0.1, 0.3, -0.35]), 9)
    return World((*bodies, Body(_wall(), _wall_paint(style))), lights, spread=0.06)


def _wall() -> Plane:
    return Plane(np.array([0.0, 0.0, WALL_Z]), np.array([0.0, 0.0, -1.0]))


def _cube(style: str) -> list[Body]:
    cube = Box(np.array([0.0, 0.02, 3.1]), rotation(41.0, -31.0, 7.0), np.full(3, 0.44))
    # the faces lie in the middle of a layer of the solid mosaic
    paint = _mosaic(cube.local, 0.44 / 14, 11) if style == "high" else _plain(0.62, 0.60, 0.57)
    return [Body(cube, paint)]


def _sphere_cylinder(style: str) -> list[Body]:
    sphere = Sphere(np.array([-0.45, 0.33, 2.84]), np.eye(3), 0.45)
    cylinder = Cylinder(np.array([0.40, -0.03, 3.2]), rotation(0.0, 33.0, 14.0), 0.37, 0.64)
    if style == "high":
        paints = [_marble(sphere.local), _mosaic(_unrolled(cylinder), 2 * np.pi * 0.37 / 76, 12)]
    elif style == "low":
        paints = [_blobs(sphere.local, 0.25, 21, _CLOUD), _blobs(cylinder.local, 0.25, 22, _CLOUD)]
    else:
        paints = [_plain(0.62, 0.60, 0.57)] * 2
    return [Body(surface, paint) for surface, paint in zip((sphere, cylinder), paints, strict=True)]


def _unrolled(cylinder: Cylinder) -> Field:
    """Return a map from points to the cylinder's (arc, height, depth below the side) in metres."""

    def unroll(points: Array) -> Array:
        x, y, z = cylinder.local(points)
        below = cylinder.radius - np.hypot(x, z)
        cap = cylinder.half - np.abs(y) < np.abs(below)
        arc = np.arctan2(z, x) * cylinder.radius
        return np.where(cap, np.stack((x, z, np.sign(y) + 0 * x)), np.stack((arc, y, 0 * x)))

    return unroll


def _wall_paint(style: str) -> Field:
    if style == "high":
        return _weave
    return _blobs(lambda p: p, 0.45, 23, _DUSK) if style == "low" else _plain(0.60, 0.62, 0.65)


def _plain(*rgb: float) -> Field:
    """Return the paint of one linear RGB colour."""
    return lambda points: np.broadcast_to(np.array(rgb)[:, None], points.shape)


def _noise(points: Array, cell: float, seed: int, order: int = 1) -> Array:
    """Return noise in [0, 1] at ``points`` (3, N), with one value per ``cell`` metres, shape (N,).

    Order 1 fades from value to value; order 3 is a B-spline: smoother and weaker.
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


def _mix(palette: Sequence[Sequence[float]], position: Array) -> Array:
    """Return the colours (3, N) at ``position`` (N,) in [0, 1] along a palette of K linear RGB colours."""
    knots = np.linspace(0, 1, len(palette))
    return np.stack([np.interp(position, knots, channel) for channel in np.array(palette).T])


_CLAY = ((0.06, 0.07, 0.13), (0.10, 0.26, 0.30), (0.72, 0.64, 0.48), (0.70, 0.28, 0.12), (0.36, 0.09, 0.07))
_CLOUD = ((0.45, 0.10, 0.16), (0.80, 0.30, 0.12), (0.85, 0.72, 0.42), (0.55, 0.62, 0.30), (0.10, 0.36, 0.30))
_DUSK = ((0.13, 0.15, 0.33), (0.24, 0.38, 0.58), (0.60, 0.68, 0.72), (0.66, 0.56, 0.62), (0.34, 0.22, 0.40))
_TILT = rotation(37.0, 31.0, 29.0)


def _mosaic(chart: Field, cell: float, seed: int) -> Field:
    """Return a mosaic of small tiles of ``cell`` metres in the coordinates of ``chart``: random hue, dark joints."""

    def paint(points: Array) -> Array:
        place = chart(points) / cell + 0.5
        tile = np.floor(place).astype(np.intp)
        hue = _random_table(seed)[tuple(tile & 31)]
        checker = np.where(tile.sum(0) % 2, 0.35 * hue, 0.45 + 0.55 * hue)
        edge = np.abs(place - tile - 0.5).max(0)
        grain = 0.8 + 0.4 * _noise(points, 0.006, seed)
        return np.where(edge > 0.43, 0.10, _mix(_CLAY, checker)) * grain

    return paint


def _marble(chart: Field) -> Field:
    """Return fine warped veins through the solid."""

    def paint(points: Array) -> Array:
        p = chart(points)
        warp = _noise(p, 0.22, 31) + 0.5 * _noise(p, 0.09, 32) + 0.25 * _noise(p, 0.035, 33)
        vein = 0.5 + 0.5 * np.sin(130 * (0.35 * p[0] + p[1]) + 17 * warp)
        return _mix(_CLAY, 0.15 + 0.75 * vein) * (0.75 + 0.5 * _noise(p, 0.007, 34))

    return paint


def _blobs(chart: Field, cell: float, seed: int, palette: Sequence[Sequence[float]]) -> Field:
    """Return broad blobs of colour, about ``cell`` metres wide."""

    def paint(points: Array) -> Array:
        p = chart(points) + 3.7 * cell
        value = 0.7 * _noise(_TILT @ p, cell, seed, 3) + 0.3 * _noise(p, cell / 2, seed + 50, 3)
        return _mix(palette, np.clip(3.2 * value - 1.1, 0, 1))

    return paint


def _weave(points: Array) -> Array:
    """Return the cloth on the wall: a herringbone of two greys with a fine grain."""
    x, y = points[0], points[1] + 0.012 * _noise(points, 0.15, 41)
    zigzag = np.abs((x / 0.28) % 1 - 0.5) * 0.28
    stripe = 0.5 + 0.5 * np.clip(3 * np.sin(2 * np.pi * (y + zigzag) / 0.052), -1, 1)
    grain = 0.65 + 0.7 * _noise(points, 0.011, 42)
    return _mix(((0.16, 0.20, 0.26), (0.62, 0.60, 0.54)), stripe) * grain


def _statue_scene() -> World:
    base = np.array(STATUE_BASE)
    bounds = Box(base - [0.0, 1.13, 0.0], np.eye(3), np.array([0.95, 1.135, 0.46]))
    statue = Implicit(lambda p: statue_distance((p - base[:, None]) * [[1.0], [-1.0], [-1.0]]), bounds, caution=0.95)
    floor = Plane(base, np.array([0.0, -1.0, 0.0]))
    lights = area_light(np.array([-1.75, -2.05, 0.6]), np.array([0.32, 0.0, 0.24]), np.array([0.08, 0.24, -0.28]), 3)
    bodies = (Body(statue, _stone), Body(floor, _plain(0.30, 0.29, 0.28)), Body(_wall(), _plain(0.20, 0.24, 0.29)))
    return World(bodies, lights, spread=0.18)


def _stone(points: Array) -> Array:
    """Return light grey with faint mottling."""
    shade = 0.95 + 0.05 * _noise(points, 0.05, 51) + 0.05 * _noise(points, 0.008, 52)
    return np.array([[0.66], [0.64], [0.60]]) * shade
