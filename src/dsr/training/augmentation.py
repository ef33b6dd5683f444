"""Random augmentation of scenes: mirroring, quarter turns, scaling of depth, and changes of the rgb image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dsr.sample import Scene

_BLUR, _NOISE = 1.0, 0.03
_MAX_DEPTH_SCALE = 3.0
"""Depth changes by a factor of exp(3) = 20 at most."""


@dataclass(frozen=True)
class Augmentation:
    """Random changes of a scene that keep rgb, depth and camera consistent.

    Args:
        flip: whether scenes are mirrored at random, horizontally and vertically.
        rotate: whether scenes are rotated by random quarter turns, the camera included.
        depth_scale: s, where depth is multiplied by exp(U(-s, s)).
        colour: standard deviation of the gain of each colour channel.
        photo: fraction of the scenes whose rgb is changed by :func:`simulate_camera`.

    Raises:
        ValueError: a value is out of range.

    """

    flip: bool = True
    rotate: bool = True
    depth_scale: float = 0.3
    colour: float = 0.1
    photo: float = 0.5

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 <= self.depth_scale <= _MAX_DEPTH_SCALE:
            raise ValueError(f"depth_scale: expected 0 to {_MAX_DEPTH_SCALE:g}, got {self.depth_scale}")
        if not 0 <= self.colour < math.inf:
            raise ValueError(f"colour: expected 0 or more, got {self.colour}")
        if not 0 <= self.photo <= 1:
            raise ValueError(f"photo: expected a fraction from 0 to 1, got {self.photo}")

    def __call__(self, scene: Scene, random: np.random.Generator) -> tuple[Scene, float]:
        """Return the augmented scene and the factor by which its depth was multiplied."""
        if self.colour:
            gain = torch.from_numpy(1 + self.colour * random.standard_normal((3, 1, 1))).float()
            scene = replace(scene, rgb=(scene.rgb * gain).clamp(0, 1))
        if random.random() < self.photo:
            scene = replace(scene, rgb=simulate_camera(scene.rgb, random))
        if self.flip:
            for vertical in (False, True):
                if random.random() < 0.5:
                    scene = mirror(scene, vertical=vertical)
        if self.rotate:
            scene = rotate90(scene, int(random.integers(4)))
        factor = math.exp(random.uniform(-self.depth_scale, self.depth_scale)) if self.depth_scale else 1.0
        depth = None if scene.depth is None else scene.depth * factor
        return replace(scene, depth=depth), factor


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


def mirror(scene: Scene, *, vertical: bool = False) -> Scene:
    """Return the mirror image of a scene and its camera, left to right or, with ``vertical``, top to bottom."""
    camera = scene.camera
    if vertical:
        camera = replace(camera, cy=camera.height - 1 - camera.cy)
    else:
        camera = replace(camera, cx=camera.width - 1 - camera.cx)
    axis = -2 if vertical else -1
    depth = None if scene.depth is None else scene.depth.flip(axis)
    return replace(scene, rgb=scene.rgb.flip(axis), depth=depth, camera=camera, measured={})


def rotate90(scene: Scene, turns: int) -> Scene:
    """Return the scene rotated counterclockwise by ``turns`` quarter turns, the camera included."""
    if turns % 4 == 0:
        return scene
    depth = None if scene.depth is None else scene.depth.rot90(turns, (-2, -1))
    rgb = scene.rgb.rot90(turns, (-2, -1))
    return replace(scene, rgb=rgb, depth=depth, camera=scene.camera.rotate90(turns), measured={})
