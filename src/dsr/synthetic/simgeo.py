"""SimGeo: six synthetic scenes of simple and of intricate geometry in front of a wall, with exact depth.

They follow the synthetic test set of Voynov et al., "Perceptual Deep Depth Super-Resolution" (ICCV 2019). The same
geometry with different textures shows whether a method mistakes texture for shape. The scenes are rendered by this
package; no file is read.

The statue is a winged, draped figure with a torch, an implicit surface. Points are float64 arrays (3, N) in metres: x
right, y up from the floor, z towards the viewer.
"""

import math
from functools import lru_cache, partial

import numpy as np

from dsr.geometry.camera import VIRTUAL_BASELINE, Camera
from dsr.synthetic import Rendering
from dsr.synthetic import raycast as rc
from dsr.synthetic.raycast import Array, Body, Field, mix, noise, rotation

Vector = tuple[float, float, float]

SCENES: tuple[str, ...] = (
    "cube_high_freq",
    "cube_no_texture",
    "sphere_cylinder_high_freq",
    "sphere_cylinder_low_freq",
    "sphere_cylinder_no_texture",
    "statue",
)
SCENES_VERSION = 1  # version of the scenes; it has to be increased whenever an image changes
FOCAL = 618.0386 / 512  # focal length in image widths
WALL_Z = 3.95
STATUE_BASE = (0.0, 1.09, 3.02)  # point of the floor on which the statue stands, in camera coordinates in metres


def statue_distance(p: Array) -> Array:
    """Return the approximate distance, (N,) metres, to a winged, draped figure with a torch on a fluted plinth.

    Each part is computed within 5 cm of its box; elsewhere, the distance to the box stands for it.
    """
    distances = []
    for low, high, part in _PARTS:
        gap = np.maximum(np.maximum(np.array(low)[:, None] - p, p - np.array(high)[:, None]), 0.0)
        out = np.sqrt((gap**2).sum(0))
        close = np.flatnonzero(out < 0.05)
        out[close] = part(p[:, close])
        distances.append(out)
    return np.minimum.reduce(distances)


def _blend(a: Array, b: Array, width: float) -> Array:
    """Return the union of two bodies with a fillet of about ``width`` metres; negate all three to intersect."""
    overlap = np.maximum(width - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap**2 / (4 * width)


def _ellipsoid(p: Array, centre: Vector, radii: Vector) -> Array:
    q = (p - np.array(centre)[:, None]) / np.array(radii)[:, None]
    return (np.sqrt((q**2).sum(0)) - 1) * min(radii)


def _limb(
    p: Array, start: Vector, end: Vector, radii: tuple[float, float], folds: tuple[float, float] = (0, 0)
) -> Array:
    """Return a capsule that tapers from one radius to the other, with ``folds`` (count, depth) along it."""
    q = _limb_axes(start, end) @ (p - np.array(start)[:, None])
    length = math.dist(start, end)
    along = np.clip(q[2], 0.0, length)
    thick = np.sqrt(q[0] ** 2 + q[1] ** 2 + (q[2] - along) ** 2)
    along /= length
    radius = radii[0] + (radii[1] - radii[0]) * along
    if not folds[1]:
        return np.asarray(thick - radius)
    crease = np.abs(np.sin(folds[0] / 2 * np.arctan2(q[1], q[0]) + 2.0 * along)) - 0.6
    return (thick - radius - folds[1] * crease * np.minimum(thick / radius, 1.0)) * 0.8


@lru_cache
def _limb_axes(start: Vector, end: Vector) -> Array:
    """Return the (3, 3) rotation to a frame whose third axis points from ``start`` to ``end``."""
    axis = np.array(end) - np.array(start)
    side = np.cross(axis, [0.31, 0.17, 0.93])
    axes = np.stack((side, np.cross(axis, side), axis))
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def _plinth(p: Array) -> Array:
    x, y, z = p
    across, angle = np.hypot(x, z), np.arctan2(z, x)
    flute = 0.014 * np.maximum(np.cos(28 * angle), -0.3) * np.clip(np.minimum(y - 0.075, 0.175 - y) / 0.02, 0, 1)
    drum = np.maximum(across - 0.335 + flute, np.abs(y - 0.12) - 0.11)
    foot = np.hypot(np.maximum(across - 0.385, 0), np.maximum(np.abs(y - 0.02) - 0.012, 0)) - 0.012
    roll = np.hypot(across - 0.36, y - 0.055) - 0.02
    bead = np.hypot(across - 0.345, y - 0.192) - 0.013 - 0.004 * np.cos(60 * angle)
    slab = np.hypot(np.maximum(across - 0.365, 0), np.maximum(np.abs(y - 0.225) - 0.012, 0)) - 0.008
    return np.minimum.reduce([drum, foot, roll, bead, slab])


def _skirt(p: Array) -> Array:
    y = p[1]
    s = np.clip((1.22 - y) / 0.98, 0.0, 1.0)
    x, z = p[0] - 0.035 * np.sin(np.pi * s), p[2] / 0.86 - 0.03 * np.sin(2 * np.pi * s)
    across, angle = np.hypot(x, z), np.arctan2(z, x)
    radius = 0.120 + 0.055 * np.minimum(s / 0.25, 1.0) * (2 - np.minimum(s / 0.25, 1.0)) + 0.09 * s**2
    wander = 8 * angle + 1.3 * np.sin(angle + 1.0) + 1.1 * np.sin(2 * angle - 3 * s) + 1.4 * s
    fold = (np.abs(np.sin(wander)) - 0.6) * 0.040 * s**0.8 + 0.0045 * s * np.sin(31 * angle + 9 * s)
    robe = np.maximum(across - radius - fold, np.maximum(y - 1.24, 0.235 - y))
    hem = 0.70 + 0.10 * np.sin(angle + 2.2) + 0.028 * np.abs(np.sin(4.5 * angle + 0.6))
    crease = np.abs(np.sin(6.5 * angle + 0.9 * np.sin(2 * angle) + 2 * s)) - 0.6
    pleat = 0.034 * crease * np.minimum(2.2 * s + 0.15, 1)
    border = 0.004 * np.clip(6 * np.cos(2 * np.pi * (y - hem) / 0.03), -1, 1) * (np.abs(y - hem - 0.045) < 0.0225)
    tunic = np.maximum(across - radius - 0.032 - pleat - border, np.maximum(y - 1.24, hem - y))
    return np.minimum(robe, tunic) * 0.8


def _torso(p: Array) -> Array:
    x, y, z = p
    mirrored = np.stack((np.sqrt(x**2 + 4e-4), y, z))  # smooth across the middle
    chest = _ellipsoid(p, (0.0, 1.41, -0.005), (0.155, 0.17, 0.105))
    bust = _ellipsoid(mirrored, (0.068, 1.415, 0.075), (0.062, 0.062, 0.055))
    waist = _limb(p, (0.0, 1.16, 0.0), (0.0, 1.36, 0.0), (0.116, 0.108))
    shoulders = _limb(mirrored, (0.0, 1.525, -0.01), (0.155, 1.495, -0.01), (0.055, 0.055))
    plain = _blend(_blend(chest, bust, 0.05), _blend(waist, shoulders, 0.05), 0.06)
    drape = np.abs(np.sin(50 * y - 24 * np.sqrt(x**2 + 4e-4) + 7 * x + 0.8 * np.sin(45 * x))) - 0.6
    body = plain - 0.007 * drape * np.clip((1.50 - y) / 0.06, 0, 1) * np.clip((z + 0.02) / 0.05, 0, 1)
    cord = 0.005 * np.sin(24 * np.arctan2(z, x) + 60 * y)
    belt = np.hypot((np.hypot(x, z / 0.95) - 0.118), (y - 1.215) / 1.3) - 0.026 - cord
    across = 0.72 * x + 0.69 * y - 0.925
    sash = np.maximum(plain - 0.016 - 0.007 * np.abs(np.sin(150 * across + 9 * x)), np.abs(across) - 0.042)
    neck = _limb(p, (0.0, 1.52, -0.01), (0.008, 1.66, 0.01), (0.052, 0.043))
    return np.minimum(_blend(np.minimum(body, sash), neck, 0.03), belt) * 0.8


_TURN = rotation(14.0, 6.0, 5.0)


def _head(p: Array) -> Array:
    q = _TURN @ (p - np.array([[0.012], [1.755], [0.022]]))
    x, y, z = q
    m = np.stack((np.abs(x), y, z))
    skull = _ellipsoid(q, (0, 0.018, -0.012), (0.076, 0.092, 0.088))
    jaw = _ellipsoid(q, (0, -0.045, 0.022), (0.05, 0.062, 0.056))
    socket = _ellipsoid(m, (0.031, 0.012, 0.088), (0.022, 0.013, 0.022))
    face = -_blend(-_blend(skull, jaw, 0.03), socket, 0.012)
    face = _blend(face, _ellipsoid(m, (0.030, 0.010, 0.060), (0.014, 0.009, 0.012)), 0.003)
    face = _blend(face, _limb(q, (0, 0.020, 0.078), (0, -0.022, 0.094), (0.008, 0.012)), 0.012)
    face = _blend(face, _ellipsoid(q, (0, -0.052, 0.074), (0.020, 0.0075, 0.012)), 0.004)
    face = _blend(face, _ellipsoid(q, (0, -0.088, 0.058), (0.020, 0.017, 0.018)), 0.015)
    waves = 0.007 * np.abs(np.sin(120 * np.hypot(x, y + 0.03) + 25 * z + 0.8 * np.sin(45 * x)))
    cap = _ellipsoid(q, (0, 0.022, -0.022), (0.088, 0.100, 0.098)) - waves
    cap = -_blend(-cap, _ellipsoid(q, (0, -0.034, 0.092), (0.061, 0.088, 0.092)), 0.01)
    bun = _ellipsoid(q, (0, 0.03, -0.125), (0.045, 0.045, 0.04)) - 0.005 * np.abs(np.sin(120 * y + 30 * x))
    locks = _limb(m, (0.066, 0.0, -0.03), (0.066, -0.19, 0.025), (0.022, 0.013), (5, 0.008))
    sector = np.pi / 8
    around = np.arctan2(x, z)
    folded = np.abs(around - 2 * sector * np.round(around / (2 * sector)))
    ring = np.hypot(x, z + 0.015)
    spikes = np.stack((ring * np.sin(folded), y - 0.35 * z, ring * np.cos(folded)))
    crown = _limb(spikes, (0, 0.078, 0.080), (0, 0.150, 0.140), (0.013, 0.002))
    band = np.hypot(ring - 0.088, (y - 0.35 * z - 0.070) / 1.4) - 0.009
    hair = np.minimum.reduce([cap, bun, locks])
    return np.minimum(_blend(face, hair, 0.006), np.minimum(crown, band)) * 0.8


def _raised_arm(p: Array) -> Array:
    upper = _limb(p, (-0.155, 1.495, -0.01), (-0.325, 1.60, 0.05), (0.050, 0.042))
    fore = _limb(p, (-0.325, 1.60, 0.05), (-0.365, 1.83, 0.10), (0.041, 0.027))
    hand = _ellipsoid(p, (-0.370, 1.865, 0.108), (0.034, 0.042, 0.036)) - 0.004 * np.sin(260 * (p[1] - 0.3 * p[0]))
    arm = _blend(_blend(upper, fore, 0.02), hand, 0.02)
    sleeve = _limb(p, (-0.145, 1.49, -0.01), (-0.300, 1.575, 0.035), (0.070, 0.068), (9, 0.012))
    hang = _limb(p, (-0.245, 1.49, 0.02), (-0.285, 1.17, 0.01), (0.062, 0.050), (9, 0.022))
    cloth = _blend(sleeve, np.maximum(hang, 1.24 - 0.5 * (p[0] + 0.28) - p[1]), 0.03)
    handle = _limb(p, (-0.362, 1.74, 0.108), (-0.382, 1.965, 0.112), (0.012, 0.026), (10, 0.004))
    cup = np.hypot(np.hypot(p[0] + 0.384, p[2] - 0.112) - 0.038, (p[1] - 1.975) / 1.2) - 0.012
    spin = np.stack((p[0] + 0.386 + 0.012 * np.sin(28 * p[1]), p[1], p[2] - 0.112))
    swirl = np.abs(np.sin(2.5 * np.arctan2(spin[2], spin[0]) + 22 * p[1]))
    swirl *= np.minimum(np.hypot(spin[0], spin[2]) / 0.03, 1)
    flame = _limb(spin, (0, 2.01, 0), (0, 2.155, 0), (0.040, 0.006)) - 0.014 * (swirl - 0.5)
    return np.minimum.reduce([arm, cloth, handle, cup, 0.7 * flame]) * 0.8


def _lowered_arm(p: Array) -> Array:
    upper = _limb(p, (0.155, 1.495, -0.01), (0.250, 1.25, -0.01), (0.050, 0.041))
    fore = _limb(p, (0.250, 1.25, -0.01), (0.205, 1.12, 0.17), (0.040, 0.027))
    hand = _ellipsoid(p, (0.196, 1.105, 0.205), (0.028, 0.024, 0.042))
    arm = _blend(_blend(upper, fore, 0.02), hand, 0.02)
    sleeve = _limb(p, (0.150, 1.49, -0.01), (0.232, 1.29, -0.01), (0.068, 0.072), (9, 0.012))
    mantle = _limb(p, (0.235, 1.22, 0.06), (0.285, 0.60, 0.035), (0.045, 0.080), (9, 0.024))
    wave = np.abs(np.sin(45 * p[0] + 20 * p[2]))
    mantle = np.maximum(mantle, 0.60 + 0.03 * wave - 0.35 * (p[0] - 0.28) - p[1])
    return np.minimum(_blend(arm, sleeve, 0.015), _blend(mantle, fore, 0.02)) * 0.8


def _wings(p: Array) -> Array:
    x, y = np.abs(p[0]), p[1]
    back = p[2] + 0.115 + 0.30 * x - 0.28 * x**2  # the wings sweep back, then level out
    a, b = x - 0.23, y - 1.66  # around the wrist
    radius, angle = np.hypot(a, b), np.arctan2(b, a) + np.deg2rad(12)
    t = np.clip((np.deg2rad(86) - angle) / np.deg2rad(172), 0.0, 1.0)  # 0 along the leading edge, 1 towards the hip
    side = radius * np.sin(np.clip(np.abs(angle) - np.deg2rad(86), -np.pi / 2, np.pi / 2))
    length = 0.46 + 0.22 * np.exp(-(((t - 0.20) / 0.24) ** 2)) + 0.14 * t**2
    wing = _limb(np.stack((x, y, back)), (0.05, 1.40, 0.0), (0.23, 1.66, 0.0), (0.045, 0.038))
    wing = _blend(wing, _limb(np.stack((x, y, back)), (0.23, 1.66, 0.0), (0.31, 2.0, 0.01), (0.036, 0.012)), 0.03)
    wing = _blend(wing, _ellipsoid(np.stack((x, y, back)), (0.25, 1.69, 0.008), (0.085, 0.125, 0.034)), 0.03)
    for count, relative_length, thick, front in (
        (13, 1.0, 0.010, -0.006),
        (17, 0.62, 0.011, 0.006),
        (21, 0.36, 0.012, 0.016),
    ):
        place = (t * count) % 1.0
        step = np.minimum(place / 0.90, (1 - place) / 0.10)  # each feather overlaps the next
        shaft = 0.005 * np.maximum(1 - np.abs(place - 0.5) / 0.08, 0)
        barbs = 0.0007 * np.sin(230 * radius + 32 * np.abs(place - 0.5))
        relief = (0.012 * step + shaft + barbs) * np.minimum(radius / 0.12, 1)
        tip = length * relative_length * (1 - 0.16 * (2 * place - 1) ** 2)
        blade = np.maximum(back - front - thick / 2 - relief, front - thick - back)
        wing = np.minimum(wing, np.maximum(np.maximum(blade, 0.5 * (radius - tip)), side))
    return wing * 0.6


# The statue's parts with the lowest and highest corners of their boxes
_PARTS: tuple[tuple[Vector, Vector, Field], ...] = (
    ((-0.40, 0.0, -0.40), (0.40, 0.25, 0.40), _plinth),
    ((-0.36, 0.23, -0.32), (0.36, 1.24, 0.32), _skirt),
    ((-0.22, 1.05, -0.16), (0.22, 1.70, 0.17), _torso),
    ((-0.16, 1.56, -0.18), (0.16, 1.97, 0.18), _head),
    ((-0.44, 1.22, -0.10), (-0.07, 2.19, 0.18), _raised_arm),
    ((0.07, 0.55, -0.10), (0.40, 1.57, 0.26), _lowered_arm),
    ((-0.90, 0.85, -0.28), (0.90, 2.26, -0.02), _wings),
)
_CLAY = np.array(((0.06, 0.07, 0.13), (0.10, 0.26, 0.30), (0.72, 0.64, 0.48), (0.70, 0.28, 0.12), (0.36, 0.09, 0.07)))
_CLOUD = np.array(((0.45, 0.10, 0.16), (0.80, 0.30, 0.12), (0.85, 0.72, 0.42), (0.55, 0.62, 0.30), (0.10, 0.36, 0.30)))
_DUSK = np.array(((0.13, 0.15, 0.33), (0.24, 0.38, 0.58), (0.60, 0.68, 0.72), (0.66, 0.56, 0.62), (0.34, 0.22, 0.40)))


def _plain(*rgb: float) -> Field:
    return lambda points: np.broadcast_to(np.array(rgb)[:, None], points.shape)


def _mosaic(chart: Field, cell: float, seed: int, points: Array) -> Array:
    """Return a mosaic of small tiles of ``cell`` metres in the coordinates of ``chart``: random hue, dark joints."""
    place = chart(points) / cell + 0.5
    tile = np.floor(place).astype(np.intp)
    hue = rc.random_table(seed)[tuple(tile & 31)]
    checker = np.where(tile.sum(0) % 2, 0.35 * hue, 0.45 + 0.55 * hue)
    edge = np.abs(place - tile - 0.5).max(0)
    grain = 0.8 + 0.4 * noise(points, 0.006, seed)
    return np.where(edge > 0.43, 0.10, mix(_CLAY, checker)) * grain


def _marble(chart: Field, points: Array) -> Array:
    """Return fine warped veins through the solid."""
    p = chart(points)
    warp = noise(p, 0.22, 31) + 0.5 * noise(p, 0.09, 32) + 0.25 * noise(p, 0.035, 33)
    vein = 0.5 + 0.5 * np.sin(130 * (0.35 * p[0] + p[1]) + 17 * warp)
    return mix(_CLAY, 0.15 + 0.75 * vein) * (0.75 + 0.5 * noise(p, 0.007, 34))


def _blobs(chart: Field, cell: float, seed: int, palette: Array, points: Array) -> Array:
    """Return broad blobs of colour, about ``cell`` metres wide."""
    p = chart(points) + 3.7 * cell
    value = 0.7 * noise(rc.TILT @ p, cell, seed, 3) + 0.3 * noise(p, cell / 2, seed + 50, 3)
    return mix(palette, np.clip(3.2 * value - 1.1, 0, 1))


def _weave(points: Array) -> Array:
    """Return the cloth on the wall: a herringbone of two greys with a fine grain."""
    x, y = points[0], points[1] + 0.012 * noise(points, 0.15, 41)
    zigzag = np.abs((x / 0.28) % 1 - 0.5) * 0.28
    stripe = 0.5 + 0.5 * np.clip(3 * np.sin(2 * np.pi * (y + zigzag) / 0.052), -1, 1)
    grain = 0.65 + 0.7 * noise(points, 0.011, 42)
    return mix(np.array([[0.16, 0.20, 0.26], [0.62, 0.60, 0.54]]), stripe) * grain


def _unroll(cylinder: rc.Cylinder, points: Array) -> Array:
    """Return the (arc length, height, depth below the side) in metres of points on a cylinder."""
    x, y, z = cylinder.to_local(points)
    below = cylinder.radius - np.hypot(x, z)
    cap = cylinder.half - np.abs(y) < np.abs(below)
    arc = np.arctan2(z, x) * cylinder.radius
    return np.where(cap, np.stack((x, z, np.sign(y) + 0 * x)), np.stack((arc, y, 0 * x)))


def _stone(points: Array) -> Array:
    """Return light grey with faint mottling."""
    shade = 0.95 + 0.05 * noise(points, 0.05, 51) + 0.05 * noise(points, 0.008, 52)
    return np.array([[0.66], [0.64], [0.60]]) * shade


def render_scene(name: str, size: int = 512) -> Rendering:
    """Return one of :data:`SCENES` at ``size`` x ``size`` pixels; the view is the same at any size."""
    centre = (size - 1) / 2
    camera = Camera(size, size, FOCAL * size, FOCAL * size, centre, centre, baseline=VIRTUAL_BASELINE)
    return Rendering(*rc.render(build_scene(name), camera), camera)


@lru_cache
def build_scene(name: str) -> rc.World:
    """Return the bodies and lights of the scene ``name``; the last body is the back wall."""
    if name not in SCENES:
        raise ValueError(f"scene: expected one of {', '.join(SCENES)}, got {name!r}")
    wall = rc.Plane(np.array([0.0, 0.0, WALL_Z]), np.array([0.0, 0.0, -1.0]))
    middle = np.array([-1.75, -2.05, 0.6])
    if name == "statue":
        base = np.array(STATUE_BASE)
        bounds = rc.Box(base - [0.0, 1.13, 0.0], np.eye(3), np.array([0.95, 1.135, 0.46]))
        statue = rc.Implicit(lambda p: statue_distance((p - base[:, None]) * [[1.0], [-1.0], [-1.0]]), bounds, 0.95)
        floor = rc.Plane(base, np.array([0.0, -1.0, 0.0]))
        lights = rc.area_light(middle, np.array([0.32, 0.0, 0.24]), np.array([0.08, 0.24, -0.28]), 3)
        bodies = (Body(statue, _stone), Body(floor, _plain(0.30, 0.29, 0.28)), Body(wall, _plain(0.20, 0.24, 0.29)))
        return rc.World(bodies, lights, spread=0.18)
    style = name.split("_")[-2]  # high, low or no
    clay = _plain(0.62, 0.60, 0.57)
    if name.startswith("cube"):
        cube = rc.Box(np.array([0.0, 0.02, 3.1]), rotation(41.0, -31.0, 7.0), np.full(3, 0.44))
        # the faces lie in the middle of a layer of the solid mosaic
        shown = [Body(cube, partial(_mosaic, cube.to_local, 0.44 / 14, 11) if style == "high" else clay)]
    else:
        sphere = rc.Sphere(np.array([-0.45, 0.33, 2.84]), np.eye(3), 0.45)
        cylinder = rc.Cylinder(np.array([0.40, -0.03, 3.2]), rotation(0.0, 33.0, 14.0), 0.37, 0.64)
        paints = [clay, clay]
        if style == "high":
            tiles = partial(_mosaic, partial(_unroll, cylinder), 2 * np.pi * 0.37 / 76, 12)
            paints = [partial(_marble, sphere.to_local), tiles]
        elif style == "low":
            paints = [
                partial(_blobs, sphere.to_local, 0.25, 21, _CLOUD),
                partial(_blobs, cylinder.to_local, 0.25, 22, _CLOUD),
            ]
        shown = [Body(sphere, paints[0]), Body(cylinder, paints[1])]
    cloths: dict[str, Field] = {"high": _weave, "no": _plain(0.60, 0.62, 0.65)}
    cloths["low"] = partial(_blobs, lambda p: p, 0.45, 23, _DUSK)
    lights = rc.area_light(middle, np.array([0.42, 0.0, 0.3]), np.array([0.1, 0.3, -0.35]), 9)
    return rc.World((*shown, Body(wall, cloths[style])), lights, spread=0.06)
