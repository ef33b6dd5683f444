"""Random scenes, one for each (seed, index): a layout, a camera that sees something, lights, a photo, exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsr.geometry.camera import Camera
from dsr.synthetic.procedural.layouts import LAYOUTS
from dsr.synthetic.procedural.lighting import Lighting, random_lighting
from dsr.synthetic.procedural.photo import View, developed, radiance
from dsr.synthetic.procedural.stage import MaterialSampler, SceneLayout, Viewpoint
from dsr.synthetic.procedural.tracer import Hits, Tracer
from dsr.synthetic.rendering import Rendering

PROCEDURAL_VERSION = 1
"""Raised whenever an image would change."""
_PREVIEW = 64
_NEAR, _FAR = 0.25, 10.0  # metres: the nearest depth at least, the median depth at most
_TRIES = (6, 10)  # layouts, and cameras in each


@dataclass(frozen=True, eq=False)
class RandomScene:
    """A scene that can be rendered at any size.

    Args:
        layout: its name.
        stage, tracer, viewpoint, lighting: what is seen, from where, by what light.
        metres: metres for each unit of the stage.
        seed: of the camera's noise.

    """

    layout: str
    stage: SceneLayout
    tracer: Tracer
    viewpoint: Viewpoint
    lighting: Lighting
    metres: float
    seed: int


def render_random_scene(seed: int, index: int, size: int = 512) -> Rendering:
    """Return the scene number ``index`` of the endless series ``seed``, with one view at any size.

    Args:
        seed: which series, from 0.
        index: which scene of it, from 0; nothing but these two decides about the scene.
        size: height and width in pixels.

    Returns:
        The photo and its depth in metres, more than 0.2 everywhere and exact for the surfaces that
        :mod:`dsr.synthetic.procedural.tracer` describes.

    Raises:
        ValueError: a number is negative, or the size is not positive.

    """
    for name, value, least in (("seed", seed, 0), ("index", index, 0), ("size", size, 1)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    return render(random_scene(np.random.default_rng(np.random.SeedSequence([seed, index]))), size)


def random_scene(rng: np.random.Generator, layout: str | None = None) -> RandomScene:
    """Return a scene of the ``layout``, one of :data:`LAYOUTS`, or of any."""
    names = list(LAYOUTS)
    weights = np.array([weight for _, weight in LAYOUTS.values()])
    for _ in range(_TRIES[0]):
        name = layout if layout is not None else names[rng.choice(len(names), p=weights / weights.sum())]
        stage = LAYOUTS[name][0](rng, MaterialSampler(rng))
        tracer = Tracer([body.shape for body in stage.bodies])
        for _ in range(_TRIES[1]):
            viewpoint = stage.views(rng)
            view = _view(viewpoint, camera_of(viewpoint, _PREVIEW))
            seen = tracer.hits(view.eye, view.rays.reshape(3, -1))
            if _worth_a_photo(seen):
                lighting = random_lighting(rng, tracer, seen, stage.low, stage.high)
                metres = _metres(rng, seen)
                return RandomScene(name, stage, tracer, viewpoint, lighting, metres, int(rng.integers(1 << 31)))
    raise RuntimeError("no view of the scene was usable")  # pragma: no cover


def _worth_a_photo(seen: Hits) -> bool:
    """Return whether a coarse picture is closed, neither too near nor too deep, and shows more than one thing."""
    if not np.isfinite(seen.depth).all():
        return False
    low, middle, high = np.quantile(seen.depth, [0.02, 0.5, 0.98])
    shares = np.bincount(seen.body) / seen.body.size
    near = seen.depth.min() > 0.17 * middle
    return bool(near and high < 6.2 * low and shares.max() < 0.985 and np.sum(shares > 0.004) >= 2)


def _metres(rng: np.random.Generator, seen: Hits) -> float:
    """Return a random scale that keeps the scene between the nearest and the farthest depth allowed."""
    scale = np.exp(rng.normal(0, 0.3))
    scale = min(scale, _FAR / float(np.median(seen.depth)))
    return float(max(scale, 1.5 * _NEAR / float(seen.depth.min())))


def camera_of(viewpoint: Viewpoint, size: int) -> Camera:
    """Return the camera of ``size`` x ``size`` pixels."""
    focal = viewpoint.focal * size
    cx, cy = viewpoint.centre * size - 0.5
    return Camera(size, size, focal, focal, float(cx), float(cy))


def _view(viewpoint: Viewpoint, camera: Camera) -> View:
    """Return the camera's rays in the frame of the stage."""
    axes = viewpoint.axes()
    rays = np.einsum("ik,ihw->khw", axes, camera.rays().numpy())
    return View(viewpoint.eye, rays, axes[0] / camera.fx, axes[1] / camera.fy)


def render(scene: RandomScene, size: int) -> Rendering:
    """Return the photo and the depth of a scene."""
    camera = camera_of(scene.viewpoint, size)
    view = _view(scene.viewpoint, camera)
    linear, depth = radiance(scene.tracer, scene.stage.bodies, view, scene.lighting)
    rgb = developed(linear, np.random.default_rng(scene.seed))
    return Rendering(rgb, scene.metres * depth, camera)
