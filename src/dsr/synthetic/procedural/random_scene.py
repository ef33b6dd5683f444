"""Random scenes, one for each (seed, index): a layout, a camera, lights, a photo and its exact depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dsr.geometry.camera import Camera
from dsr.synthetic.procedural.arrangements import LAYOUTS
from dsr.synthetic.procedural.lighting import Hits, Lighting, Tracer, random_lighting
from dsr.synthetic.procedural.materials import SceneBuilder
from dsr.synthetic.procedural.photo import Body, Viewpoint, develop, radiance
from dsr.synthetic.rendering import Rendering

PROCEDURAL_VERSION = 1  # version of the scenes; it has to be increased whenever an image changes
_PREVIEW_SIZE = 64
_MIN_DEPTH, _MAX_MEDIAN_DEPTH = 0.25, 10.0
_LAYOUT_TRIES, _CAMERA_TRIES = 6, 10


@dataclass(frozen=True, eq=False)
class RandomScene:
    """A scene that can be rendered at any size."""

    layout_name: str  # key of its layout in LAYOUTS
    bodies: Sequence[Body]
    tracer: Tracer
    viewpoint: Viewpoint
    lighting: Lighting
    metres: float  # metres per unit of length of the layout
    seed: int  # of the camera's noise


def render_random_scene(seed: int, index: int, size: int = 512) -> Rendering:
    """Return the scene number ``index`` of the endless series ``seed``; the view is the same at any size in pixels.

    The scene is a function of these two numbers alone. Its depth in metres is more than 0.2 everywhere and exact for
    the surfaces that :mod:`dsr.synthetic.procedural.lighting` describes.
    """
    for name, value, least in (("seed", seed, 0), ("index", index, 0), ("size", size, 1)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
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
            if _is_usable(seen):
                lighting = random_lighting(rng, tracer, seen, layout.low, layout.high)
                scale = min(np.exp(rng.normal(0, 0.3)), _MAX_MEDIAN_DEPTH / float(np.median(seen.depth)))
                metres = float(max(scale, 1.5 * _MIN_DEPTH / float(seen.depth.min())))  # per unit, within the limits
                return RandomScene(
                    name, builder.bodies, tracer, viewpoint, lighting, metres, int(rng.integers(1 << 31))
                )
    raise RuntimeError("no view of the scene was usable")  # pragma: no cover


def _is_usable(seen: Hits) -> bool:
    """Return whether a preview has no gap, is neither too near nor too deep, and shows more than one object."""
    if not np.isfinite(seen.depth).all():
        return False
    low, middle, high = np.quantile(seen.depth, [0.02, 0.5, 0.98])
    fractions = np.bincount(seen.body) / seen.body.size
    near = seen.depth.min() > 0.17 * middle
    return bool(near and high < 6.2 * low and fractions.max() < 0.985 and np.sum(fractions > 0.004) >= 2)


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
