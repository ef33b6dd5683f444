"""Random scenes, one for each (seed, index): a layout, a camera, lights, a photo and its exact depth.

Layouts are rooms, tables, clutter, statues, reliefs, landscapes, porticoes, floating shapes and shelves.
Shapes, paints, cameras and lamps are made in metres; rendered depth is then scaled by a random factor,
``RandomScene.metres``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dsr.geometry.camera import Camera
from dsr.synthetic import Rendering
from dsr.synthetic.procedural import furniture, reliefs
from dsr.synthetic.procedural.materials import Body, SceneBuilder
from dsr.synthetic.procedural.photo import Lighting, Tracer, Viewpoint, aim_camera, develop, radiance, random_lighting
from dsr.synthetic.procedural.reliefs import blanket, branches, creature, curtain, figure, pebble, plant
from dsr.synthetic.procedural.shape import box, frustum, merge, place_on_ground, prism, random_rotation, random_solid
from dsr.synthetic.raycast import rotation_about

PROCEDURAL_VERSION = 1  # version of the scenes; it has to be increased whenever an image changes
_PREVIEW_SIZE = 64
_MIN_DEPTH, _MAX_MEDIAN_DEPTH = 0.25, 10.0
_LAYOUT_TRIES, _CAMERA_TRIES = 6, 10
_Box = tuple[Sequence[float], Sequence[float]]  # its corners (3,)


class SceneLayout(NamedTuple):
    """Where the cameras and lamps of a scene may be; its bodies fill the view of every camera."""

    views: Callable[[np.random.Generator], Viewpoint]
    low: Sequence[float]  # (3,) corners of the box in which lamps may hang
    high: Sequence[float]


def _from_box(eyes: _Box, targets: _Box, low: float, high: float) -> Callable[[np.random.Generator], Viewpoint]:
    """Return random cameras in a box that look into another one, with focal lengths from ``low`` to ``high``."""
    return lambda draw: aim_camera(draw, draw.uniform(*eyes), draw.uniform(*targets), low, high)


def room(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return a furnished room, seen towards a corner or a wall."""
    size = rng.uniform([2.6, 2.8, 2.2], [5.5, 6.0, 3.2])
    furniture.shell(rng, scene, size)
    furniture.fill_room(rng, scene, size)

    def views(draw: np.random.Generator) -> Viewpoint:
        eye = draw.uniform([-0.42, -0.47, 0], [0.42, -0.2, 0]) * size
        eye[2] = draw.uniform(0.7, 1.9)
        target = draw.uniform([-0.4, 0.3, 0], [0.4, 0.5, 0]) * size
        target[2] = draw.uniform(0.3, 1.3)
        return aim_camera(draw, eye, target, 0.6, 1.3)

    x, y, z = size
    return SceneLayout(views, [0.3 - x / 2, 0.3 - y / 2, 1.1], [x / 2 - 0.3, y / 2 - 0.3, z - 0.2])


def tabletop(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return many small objects on a table in front of a backdrop."""
    wide, deep = rng.uniform([0.7, 0.5], [1.6, 0.9])
    furniture.tableware(rng, scene, wide, deep)
    if rng.random() < 0.35:
        sheet = reliefs.relief(rng, (reliefs.folds, reliefs.crumple, reliefs.ground)[rng.integers(3)], 1.0)
        scene.add(sheet.scale([wide, deep, 0.35]).translate(0, 0, -0.002), "cloth", 0.5)
    high = rng.uniform(0.45, 0.8)
    legs = furniture.table(rng, (wide, deep), high)[1].translate(0, 0, -high - 0.03)
    scene.add(box([wide, deep, 0.04]).translate(0, 0, -0.041), "wood", 0.6)
    scene.add(legs, "wood", 0.3)
    furniture.backdrop(rng, scene, deep / 2 + rng.uniform(0.02, 1.5), -high - 0.03)

    def views(draw: np.random.Generator) -> Viewpoint:
        rise, yaw, far = np.deg2rad(draw.uniform(12, 65)), draw.uniform(-0.6, 0.6), draw.uniform(0.55, 1.2)
        target = draw.uniform([-0.2, -0.1, 0.0], [0.2, 0.2, 0.12])
        way = np.array([np.sin(yaw) * np.cos(rise), -np.cos(yaw) * np.cos(rise), np.sin(rise)])
        return aim_camera(draw, target + far * way, target, 0.8, 1.8)

    return SceneLayout(views, [-2, -2, 0.3], [2, deep / 2, 2])


def statue(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return one or two organic bodies on a plinth, seen from near."""
    count = 1 if rng.random() < 0.65 else 2
    for k in range(count):
        kind = rng.random()
        shape = figure(rng) if kind < 0.55 else creature(rng, 120) if kind < 0.92 else pebble(rng, 110)
        shape = shape.turn(2, rng.uniform(0, 360) if kind > 0.55 else rng.uniform(-50, 50))
        scene.add(shape.translate((k - (count - 1) / 2) * 0.7, rng.uniform(-0.1, 0.1), 0), "stone", 0.6)
    base = box([1.2, 0.8, 0.3]) if rng.random() < 0.5 else frustum(0.7, 0.6, 0.3)
    scene.add(base.translate(0, 0, -0.3), "stone", 0.6)
    furniture.backdrop(rng, scene, rng.uniform(0.5, 2.0), -0.29)
    aim, middle = rng.uniform(0.35, 0.8), 0.35 * (count - 1)

    def views(draw: np.random.Generator) -> Viewpoint:
        yaw, far = draw.uniform(-0.7, 0.7), draw.uniform(0.7, 1.9)
        target = np.array([draw.uniform(-0.1, 0.1) + middle * draw.choice([-1, 0, 1]), 0, aim])
        eye = target + far * np.array([np.sin(yaw), -np.cos(yaw), draw.uniform(-0.15, 0.5)])
        return aim_camera(draw, eye, target, 0.7, 1.6)

    return SceneLayout(views, [-2, -2, 0.2], [2, 0.3, 2.2])


def relief_wall(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return a flat or curved relief that fills the picture, sometimes with objects in front of it."""
    bend = rng.choice([0.0, 0.0, 0.12, -0.12, 0.3])
    sheet = reliefs.relief(rng, reliefs.RELIEFS[rng.integers(len(reliefs.RELIEFS))], 3.0, 340, bend)
    family = str(rng.choice(["stone", "brick", "wall", "cloth", "earth"]))
    scene.add(sheet.turn(0, 90), family, 0.8)
    scene.add(box([9, 0.1, 9]).translate(0, 0.35, -4.5), "wall", 1.0)
    for _ in range(rng.integers(0, 4) if rng.random() < 0.6 else 0):
        thing = random_solid(rng).scale(rng.uniform(0.2, 0.6))
        thing = thing.rotate(random_rotation(rng)) if rng.random() < 0.5 else thing
        scene.add(thing.translate(*rng.uniform([-0.5, -0.9, -0.5], [0.5, -0.5, 0.3])), "any", 0.3)

    def views(draw: np.random.Generator) -> Viewpoint:
        slant, lift, far = draw.uniform(-0.8, 0.8), draw.uniform(-0.45, 0.45), draw.uniform(0.9, 1.9)
        target = draw.uniform([-0.4, 0, -0.4], [0.4, 0, 0.4])
        eye = target + far * np.array([np.sin(slant) * np.cos(lift), -np.cos(slant) * np.cos(lift), np.sin(lift)])
        return aim_camera(draw, eye, target, 1.0, 1.8)

    return SceneLayout(views, [-3, -3, -2], [3, -0.5, 3])


def landscape(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return ground or rumpled cloth seen at a slant, with stones, plants or objects on it and a backdrop."""
    maker = (reliefs.ground, reliefs.ground, reliefs.crumple, reliefs.folds)[rng.integers(4)]
    sheet = reliefs.relief(rng, maker, 4.0, 340).scale([1, 1, 1.0 if maker is reliefs.ground else 1.3])
    floor = sheet.translate(0, 1.4, -np.quantile(sheet.vertices[:, 2], 0.5))
    cloth = maker in (reliefs.crumple, reliefs.folds)
    scene.add(floor, "cloth" if cloth else "earth", 0.9)
    for _ in range(rng.integers(0, 14)):
        spot = rng.uniform([-1.1, 0.2], [1.1, 2.8])
        height = floor.vertices[np.argmin(((floor.vertices[:, :2] - spot) ** 2).sum(1)), 2]
        thing = random_solid(rng) if cloth or rng.random() < 0.25 else pebble(rng)
        size = rng.uniform(0.08, 0.5)
        thing = thing.scale(size).turn(2, rng.uniform(0, 360))
        scene.add(thing.translate(spot[0], spot[1], height - 0.08 * size), "stone", size)
    root = [rng.uniform(-0.6, 0.6), rng.uniform(0.9, 1.8), -0.1]
    if rng.random() < 0.5:
        greens = plant(rng) if rng.random() < 0.5 else [branches(rng)]
        scene.add_all([part.translate(*root) for part in greens], ["plant"], 0.3)
    furniture.backdrop(rng, scene, 3.1, -0.4)

    def views(draw: np.random.Generator) -> Viewpoint:
        rise = draw.uniform(0.5, 2.0)
        eye = np.array([draw.uniform(-0.4, 0.4), -0.5, rise])
        return aim_camera(draw, eye, np.array([draw.uniform(-0.3, 0.3), draw.uniform(0.9, 1.8), 0]), 0.7, 1.5)

    return SceneLayout(views, [-3, -2, 0.8], [3, 2.6, 3.5])


def portico(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return a portico with columns, steps, arches, railings and blocks, several metres away."""
    stone, count = scene.paint("stone", 1.5), int(rng.integers(2, 6))
    pitch, high = rng.uniform(1.2, 2.4), rng.uniform(2.6, 4.0)
    shaft = furniture.column(rng, high)
    spots = (np.arange(count) - (count - 1) / 2) * pitch
    span = pitch * (count + 1)
    shapes = [shaft.translate(x, 0, 0) for x in spots]
    shapes.append(box([span, 0.7, 0.5]).translate(0, 0, high))
    shapes += [box([span + 0.6 * k, 1.2 + 0.6 * k, 0.17]).translate(0, 0, -0.17 * (k + 1) - 0.001) for k in range(4)]
    scene.bodies.append(Body(merge(shapes), stone))
    back = rng.uniform(0.8, 3.0)
    scene.add_all(furniture.arched_wall(rng, span + 4, high + 1.5, back), ["wall"], 1.5)
    if rng.random() < 0.5:
        for x in spots[:-1]:
            rail = furniture.blinds(rng, pitch - 0.5, 0.9)[0]
            scene.add(rail.translate(x + 0.25, 0, 0), "metal", 0.3)
    for _ in range(rng.integers(0, 5)):
        thing = (prism if rng.random() < 0.5 else random_solid)(rng).scale(rng.uniform(0.5, 1.1))
        scene.add(thing.translate(rng.uniform(-2.5, 2.5), rng.uniform(-3.0, -1.6), -0.68), "stone", 0.8)
    floor = box([30, 30, 0.1])
    if rng.random() < 0.4:
        floor = reliefs.relief(rng, reliefs.RELIEFS[rng.integers(2)], 16.0, 260)
    scene.add(floor.scale([1, 1, 0.15]).translate(0, 0, -0.7), "stone", 2.0)
    scene.add(box([40, 0.1, 30]).translate(0, back + 3, -5), "wall", 3.0)
    views = _from_box(([-3.0, -7.0, 0.3], [3.0, -3.6, 2.6]), ([-1, 0, 0.6], [1, 0.5, 1.9]), 0.8, 1.5)
    return SceneLayout(views, [-8, -12, 2], [8, -2, 9])


def shapes(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return a few large shapes that float in front of a backdrop."""
    count = int(rng.integers(1, 6))
    if count == 1:
        places = [rng.uniform(-0.1, 0.1, 3)]
    else:
        spots = furniture.scatter(rng, np.full(2, 1.5), count, 0.45)
        places = [np.array([x, rng.uniform(-0.4, 0.4), z]) for x, z in spots]
    for place in places:
        thing = random_solid(rng) if rng.random() < 0.8 else creature(rng, 72)
        thing = place_on_ground(thing).translate(0, 0, -0.4).rotate(random_rotation(rng)).scale(rng.uniform(0.5, 1.0))
        scene.add(thing.translate(*place), "any", 0.5)
    furniture.backdrop(rng, scene, rng.uniform(0.7, 1.6), -1.2)
    views = _from_box(([-0.8, -2.6, -0.3], [0.8, -1.7, 0.9]), ([-0.1, 0, -0.1], [0.1, 0, 0.1]), 0.9, 1.8)
    return SceneLayout(views, [-2.5, -3, -0.5], [2.5, -0.3, 2.5])


def clutter(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return many objects of all kinds at several depths, which fill the picture."""
    depth = rng.uniform(0.5, 1.0)
    for _ in range(rng.integers(14, 44)):
        place = rng.uniform([-1.1 * depth, -0.2, 0], [1.1 * depth, depth, 0])
        shapes, families = furniture.random_object(rng)
        turn = random_rotation(rng) if rng.random() < 0.25 else rotation_about(2, rng.uniform(0, 360))
        place[2] = 0.55 * place[1] * rng.random() + (0.15 if rng.random() < 0.3 else 0.0)
        scene.add_all([shape.rotate(turn).translate(*place) for shape in shapes], families, 0.3)
    for k in range(int(rng.integers(0, 4))):  # boxes in the background
        block = box(rng.uniform([0.4, 0.3, 0.2], [0.9, 0.5, 0.9])).turn(2, rng.uniform(-30, 30))
        scene.add(block.translate((k - 1.5) * 0.6, depth * rng.uniform(0.5, 1.0), 0.0), "print", 0.5)
    furniture.backdrop(rng, scene, depth + rng.uniform(0.3, 0.8), -0.002)
    views = _from_box(([-0.7, -1.7, 0.3], [0.7, -0.9, 1.3]), ([-0.2, 0.2, 0.05], [0.2, 0.4, 0.3]), 1.0, 1.8)
    return SceneLayout(views, [-2, -2, 0.4], [2, 0.4, 2.2])


def shelves(rng: np.random.Generator, scene: SceneBuilder) -> SceneLayout:
    """Return a full bookcase seen from near, sometimes behind a curtain or a grille."""
    parts = furniture.shelf(rng)
    scene.add_all(parts, ["wood", "print", "any", "cloth", "any"], 0.4)
    scene.add(box([9, 0.1, 9]).translate(0, 0.35, -3), "wall", 1.0)
    scene.add(box([9, 9, 0.1]).translate(0, 0, -0.11), "wood", 1.0)
    if rng.random() < 0.3:
        cloth = curtain(rng, 0.5, 2.4).translate(rng.choice([-0.75, 0.25]), -0.32, 0)
        scene.add(cloth, "cloth", 0.3)
    if rng.random() < 0.2:
        scene.add(furniture.blinds(rng, 1.6, 2.4)[0].translate(-0.8, -0.3, 0), "metal", 0.3)
    if rng.random() < 0.5:
        soft = blanket(rng, rng.uniform(0.4, 0.8, 2), 0.15).turn(0, rng.uniform(0, 30))
        scene.add(soft.translate(rng.uniform(-0.5, 0.5), -0.7, 0), "cloth", 0.4)
    top = float(parts[0].vertices[:, 2].max())

    def views(draw: np.random.Generator) -> Viewpoint:
        target = np.array([draw.uniform(-0.2, 0.2), 0, draw.uniform(0.25, 0.8) * top])
        eye = target + draw.uniform([-0.7, -1.9, -0.2], [0.7, -0.9, 0.6])
        eye[2] = max(eye[2], 0.15)
        return aim_camera(draw, eye, target, 0.8, 1.5)

    return SceneLayout(views, [-2, -3, 0.4], [2, -0.5, 2.6])


LAYOUTS = {
    "room": (room, 0.25),
    "tabletop": (tabletop, 0.17),
    "clutter": (clutter, 0.09),
    "statue": (statue, 0.14),
    "relief_wall": (relief_wall, 0.10),
    "landscape": (landscape, 0.06),
    "portico": (portico, 0.06),
    "shapes": (shapes, 0.07),
    "shelves": (shelves, 0.06),
}  # layouts and their relative frequencies, by name


@dataclass(frozen=True, eq=False)
class RandomScene:
    """A scene that can be rendered at any size."""

    bodies: Sequence[Body]
    tracer: Tracer
    viewpoint: Viewpoint
    lighting: Lighting
    metres: float  # factor of rendered depth, the final size of what was made as a metre
    seed: int  # of the camera's noise


def render_random_scene(seed: int, index: int, size: int = 512) -> Rendering:
    """Return the scene number ``index`` of the endless series ``seed``; the view is the same at any size in pixels.

    The scene is a function of these two numbers alone. Its depth in metres is more than 0.2 everywhere and exact for
    the surfaces that :mod:`dsr.synthetic.procedural.photo` describes.
    """
    return render(random_scene(np.random.default_rng(np.random.SeedSequence([seed, index]))), size)


def random_scene(rng: np.random.Generator, layout_name: str | None = None) -> RandomScene:
    """Return a random scene of the layout with this name in :data:`LAYOUTS`; None for a random layout."""
    names = list(LAYOUTS)
    weights = np.array([weight for _, weight in LAYOUTS.values()])
    for _ in range(_LAYOUT_TRIES):
        name = layout_name if layout_name is not None else names[rng.choice(len(names), p=weights / weights.sum())]
        builder = SceneBuilder(rng)
        layout = LAYOUTS[name][0](rng, builder)
        tracer = Tracer([body.shape for body in builder.bodies])
        for _ in range(_CAMERA_TRIES):
            viewpoint = layout.views(rng)
            seen = tracer.trace(viewpoint.eye, viewpoint.rays(make_camera(viewpoint, _PREVIEW_SIZE)))
            if not np.isfinite(seen.depth).all():  # the preview has a gap
                continue
            low, middle, high = np.quantile(seen.depth, [0.02, 0.5, 0.98])
            fractions = np.bincount(seen.body) / seen.body.size
            varied = fractions.max() < 0.985 and np.sum(fractions > 0.004) >= 2
            if seen.depth.min() > 0.17 * middle and high < 6.2 * low and varied:
                lighting = random_lighting(rng, tracer, seen, layout.low, layout.high)
                scale = min(np.exp(rng.normal(0, 0.3)), _MAX_MEDIAN_DEPTH / float(np.median(seen.depth)))
                metres = float(max(scale, 1.5 * _MIN_DEPTH / float(seen.depth.min())))  # within the limits
                seed = int(rng.integers(1 << 31))
                return RandomScene(builder.bodies, tracer, viewpoint, lighting, metres, seed)
    raise RuntimeError("no view of the scene was usable")  # pragma: no cover


def make_camera(viewpoint: Viewpoint, size: int) -> Camera:
    """Return the camera of ``size`` x ``size`` pixels."""
    focal = viewpoint.focal * size
    cx, cy = viewpoint.centre * size - 0.5
    return Camera(size, size, focal, focal, float(cx), float(cy))


def render(scene: RandomScene, size: int) -> Rendering:
    """Return the photo and the depth of a scene."""
    camera = make_camera(scene.viewpoint, size)
    linear, depth = radiance(scene.tracer, scene.bodies, scene.viewpoint, camera, scene.lighting)
    rgb = develop(linear, np.random.default_rng(scene.seed))
    return Rendering(rgb, scene.metres * depth, camera)
