"""Random augmentation of scenes: mirroring, quarter turns, scaling of depth, and changes of the rgb image."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import Downsampling
from dsr.sample import Scene
from dsr.training.settings import PatchSettings
from dsr.utils.guards import derived

_BLUR, _NOISE = 1.0, 0.03


def augment(scene: Scene, settings: PatchSettings, random: np.random.Generator) -> tuple[Scene, float]:
    """Return a scene changed at random, rgb, depth and camera alike, and the factor that multiplied its depth."""
    rgb = scene.rgb
    if settings.colour:
        gain = torch.from_numpy(1 + settings.colour * random.standard_normal((3, 1, 1))).float()
        rgb = (rgb * gain).clamp(0, 1)
    if random.random() < settings.photo:
        rgb = simulate_camera(rgb, random)
    scene = derived(scene, rgb=rgb)
    if settings.flip:
        for vertical in (False, True):
            if random.random() < 0.5:
                scene = mirror(scene, vertical=vertical)
    if settings.rotate:
        scene = rotate90(scene, int(random.integers(4)))
    factor = math.exp(random.uniform(-settings.depth_scale, settings.depth_scale)) if settings.depth_scale else 1.0
    return derived(scene, depth=_depth_of(scene) * factor), factor


def simulate_camera(rgb: Tensor, random: np.random.Generator) -> Tensor:
    """Return an rgb image (3, H, W) with another gamma, blur and noise, as cameras differ.

    The values are raised to the power exp(U(-0.5, 0.5)). The Gaussian blur has a standard deviation of up to one pixel,
    the Gaussian noise one of up to 0.03.
    """
    pixels = rgb.clamp(min=0).numpy() ** math.exp(random.uniform(-0.5, 0.5))
    sigma = random.uniform(0, _BLUR)
    pixels = ndimage.gaussian_filter(pixels, (0, sigma, sigma), mode="nearest")
    pixels = pixels + random.uniform(0, _NOISE) * random.standard_normal(pixels.shape)
    return torch.from_numpy(pixels.astype(np.float32)).clamp(0, 1)


def soften(scene: Scene, sigma: float = 0.0, *, halve: bool = True) -> Scene:
    """Return a scene whose depth steps are soft: truths of benchmarks have 2 to 5 mixed pixels across a step.

    Args:
        scene: a scene with a true depth.
        sigma: standard deviation in pixels of the result of a Gaussian that blurs inverse depth.
        halve: whether the result is half as large, of means of 2 x 2 pixels of the photo and of blurred inverse depth.

    """
    inverse = _depth_of(scene).reciprocal()
    if sigma:
        valid, width = inverse.isfinite(), sigma * (1 + halve)
        sums, weights = (
            ndimage.gaussian_filter(each.numpy(), (0, width, width), mode="nearest", truncate=3)
            for each in (inverse.nan_to_num(0), valid.to(inverse))
        )
        inverse = torch.where(valid, torch.from_numpy(sums) / torch.from_numpy(weights), torch.nan)
    if not halve:
        return derived(scene, depth=inverse.reciprocal())
    inverse = Downsampling("box")(inverse, 2)
    camera = scene.camera.downscale(2)
    return derived(scene, rgb=functional.avg_pool2d(scene.rgb[None], 2)[0], depth=inverse.reciprocal(), camera=camera)


def mirror(scene: Scene, *, vertical: bool = False) -> Scene:
    """Return the mirror image of a scene and its camera, left to right or, with ``vertical``, top to bottom."""
    camera = scene.camera
    if vertical:
        camera = derived(camera, cy=camera.height - 1 - camera.cy)
    else:
        camera = derived(camera, cx=camera.width - 1 - camera.cx)
    axis = -2 if vertical else -1
    return derived(scene, rgb=scene.rgb.flip(axis), depth=_depth_of(scene).flip(axis), camera=camera, measured={})


def rotate90(scene: Scene, turns: int) -> Scene:
    """Return the scene rotated counterclockwise by ``turns`` quarter turns, the camera included."""
    if turns % 4 == 0:
        return scene
    rgb, depth = scene.rgb.rot90(turns, (-2, -1)), _depth_of(scene).rot90(turns, (-2, -1))
    return derived(scene, rgb=rgb, depth=depth, camera=scene.camera.rotate90(turns), measured={})


def _depth_of(scene: Scene) -> Tensor:
    """Return the true depth, which scenes to train with have."""
    assert scene.depth is not None  # noqa: S101 - for the type checker
    return scene.depth
