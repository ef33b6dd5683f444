"""SimGeo: six synthetic scenes of simple and of intricate geometry in front of a wall, with exact depth.

They follow the synthetic test set of Voynov et al., "Perceptual Deep Depth Super-Resolution" (ICCV 2019). The same
geometry with different textures shows whether a method mistakes texture for shape. The scenes are rendered by this
package; no file is read.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dsr.geometry.camera import VIRTUAL_BASELINE, Camera
from dsr.synthetic.implicit import Implicit
from dsr.synthetic.raycast import Body, World, area_light, render
from dsr.synthetic.rendering import Rendering
from dsr.synthetic.simgeo.statue import statue_distance
from dsr.synthetic.surfaces import Array, Box, Cylinder, Field, Plane, Sphere, rotation
from dsr.synthetic.textures import CLOUD, DUSK, blobs, marble, mosaic, noise, plain, unroll_chart, weave

SCENES: tuple[str, ...] = (
    "cube_high_freq",
    "cube_no_texture",
    "sphere_cylinder_high_freq",
    "sphere_cylinder_low_freq",
    "sphere_cylinder_no_texture",
    "statue",
)
SCENES_VERSION = 1
"""Version of the scenes; it has to be increased whenever an image changes."""
FOCAL = 618.0386 / 512
"""Focal length in image widths."""
WALL_Z = 3.95
STATUE_BASE = (0.0, 1.09, 3.02)
"""Point of the floor on which the statue stands, in camera coordinates in metres."""


def render_scene(name: str, size: int = 512) -> Rendering:
    """Return the scene ``name``, one of :data:`SCENES`, at ``size`` x ``size`` pixels.

    The view is the same at any size.

    Raises:
        ValueError: the name is unknown, or the size is not positive.

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
    paint = mosaic(cube.to_local, 0.44 / 14, 11) if style == "high" else plain(0.62, 0.60, 0.57)
    return [Body(cube, paint)]


def _sphere_cylinder(style: str) -> list[Body]:
    sphere = Sphere(np.array([-0.45, 0.33, 2.84]), np.eye(3), 0.45)
    cylinder = Cylinder(np.array([0.40, -0.03, 3.2]), rotation(0.0, 33.0, 14.0), 0.37, 0.64)
    if style == "high":
        paints = [marble(sphere.to_local), mosaic(unroll_chart(cylinder), 2 * np.pi * 0.37 / 76, 12)]
    elif style == "low":
        paints = [blobs(sphere.to_local, 0.25, 21, CLOUD), blobs(cylinder.to_local, 0.25, 22, CLOUD)]
    else:
        paints = [plain(0.62, 0.60, 0.57)] * 2
    return [Body(surface, paint) for surface, paint in zip((sphere, cylinder), paints, strict=True)]


def _wall_paint(style: str) -> Field:
    if style == "high":
        return weave
    return blobs(lambda p: p, 0.45, 23, DUSK) if style == "low" else plain(0.60, 0.62, 0.65)


def _statue_scene() -> World:
    base = np.array(STATUE_BASE)
    bounds = Box(base - [0.0, 1.13, 0.0], np.eye(3), np.array([0.95, 1.135, 0.46]))
    statue = Implicit(
        lambda p: statue_distance((p - base[:, None]) * [[1.0], [-1.0], [-1.0]]), bounds, step_fraction=0.95
    )
    floor = Plane(base, np.array([0.0, -1.0, 0.0]))
    lights = area_light(np.array([-1.75, -2.05, 0.6]), np.array([0.32, 0.0, 0.24]), np.array([0.08, 0.24, -0.28]), 3)
    bodies = (Body(statue, _stone), Body(floor, plain(0.30, 0.29, 0.28)), Body(_wall(), plain(0.20, 0.24, 0.29)))
    return World(bodies, lights, spread=0.18)


def _stone(points: Array) -> Array:
    """Return light grey with faint mottling."""
    shade = 0.95 + 0.05 * noise(points, 0.05, 51) + 0.05 * noise(points, 0.008, 52)
    return np.array([[0.66], [0.64], [0.60]]) * shade
