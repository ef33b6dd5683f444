"""Random windows of scenes, and their variation: mirrored, turned, nearer or farther, photographed otherwise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dsr.sample import Scene

_BLUR, _NOISE = 1.0, 0.03
_LARGEST_SCALE = 3.0
"""exp(3) = 20 times nearer or farther; beyond that no scene is."""


@dataclass(frozen=True)
class Variation:
    """How windows are varied at random.

    Args:
        flip: whether they are mirrored, both ways.
        rotate: whether they are turned by quarter turns, the camera along with them.
        depth_scale: s, where depth is multiplied by exp(U(-s, s)).
        colour: standard deviation of the gain of each colour channel.
        photo: share of the windows whose photo is as cameras take them rather than as they are rendered: of another
            gamma, blurred and noisy.

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
        if not 0 <= self.depth_scale <= _LARGEST_SCALE:
            raise ValueError(f"trainer.depth_scale: expected 0 to {_LARGEST_SCALE:g}, got {self.depth_scale}")
        if not 0 <= self.colour < math.inf:
            raise ValueError(f"trainer.colour: expected 0 or more, got {self.colour}")
        if not 0 <= self.photo <= 1:
            raise ValueError(f"trainer.photo: expected a share from 0 to 1, got {self.photo}")

    def __call__(self, scene: Scene, random: np.random.Generator) -> tuple[Scene, float]:
        """Return the scene varied, and what its depth was multiplied by."""
        if self.colour:
            gain = torch.from_numpy(1 + self.colour * random.standard_normal((3, 1, 1))).float()
            scene = replace(scene, rgb=(scene.rgb * gain).clamp(0, 1))
        if random.random() < self.photo:
            scene = replace(scene, rgb=photographed(scene.rgb, random))
        if self.flip:
            for vertical in (False, True):
                if random.random() < 0.5:
                    scene = mirrored(scene, vertical=vertical)
        if self.rotate:
            scene = turned(scene, int(random.integers(4)))
        factor = math.exp(random.uniform(-self.depth_scale, self.depth_scale)) if self.depth_scale else 1.0
        depth = None if scene.depth is None else scene.depth * factor
        return replace(scene, depth=depth), factor


def photographed(rgb: Tensor, random: np.random.Generator) -> Tensor:
    """Return a photo (3, H, W) as some camera might have taken it.

    Its gamma times exp(U(-0.5, 0.5)), a Gaussian blur of up to a pixel, and Gaussian noise of up to 0.03.
    """
    pixels = rgb.clamp(min=0).numpy() ** math.exp(random.uniform(-0.5, 0.5))
    sigma = random.uniform(0, _BLUR)
    pixels = ndimage.gaussian_filter(pixels, (0, sigma, sigma), mode="nearest")
    pixels = pixels + random.uniform(0, _NOISE) * random.standard_normal(pixels.shape)
    return torch.from_numpy(pixels.astype(np.float32)).clamp(0, 1)


def window(scene: Scene, top: int, left: int, size: int) -> Scene:
    """Return a square window of a scene, its depth in float64."""
    rows, columns = slice(top, top + size), slice(left, left + size)
    depth = None if scene.depth is None else scene.depth[:, rows, columns].double()
    camera = scene.camera.crop(top, left, size, size)
    return Scene(scene.dataset, scene.name, scene.rgb[:, rows, columns], camera, depth)


def mirrored(scene: Scene, *, vertical: bool = False) -> Scene:
    """Return the mirror image: left and right change places, or top and bottom; the world is mirrored with it."""
    camera = scene.camera
    if vertical:
        camera = replace(camera, cy=camera.height - 1 - camera.cy)
    else:
        camera = replace(camera, cx=camera.width - 1 - camera.cx)
    axis = -2 if vertical else -1
    depth = None if scene.depth is None else scene.depth.flip(axis)
    return replace(scene, rgb=scene.rgb.flip(axis), depth=depth, camera=camera, measured={})


def turned(scene: Scene, turns: int) -> Scene:
    """Return the scene as a camera sees it that is turned about its axis; the image turns counterclockwise."""
    if turns % 4 == 0:
        return scene
    depth = None if scene.depth is None else scene.depth.rot90(turns, (-2, -1))
    rgb = scene.rgb.rot90(turns, (-2, -1))
    return replace(scene, rgb=rgb, depth=depth, camera=scene.camera.rotate90(turns), measured={})
