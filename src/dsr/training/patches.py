"""Training patches: random windows of scenes, mirrored, turned, scaled in depth and changed in colour at random.

Patch number i of a run is a pure function of (seed, i), and of the number of patches of a step where factors are drawn.
So an interrupted run continues with the same patches, whatever the number of workers and devices.
"""

import contextlib
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import ndimage
from torch.nn import functional
from torch.utils.data import Dataset

from dsr.degradation.downsampling import Downsampling
from dsr.degradation.random_degradation import Everything
from dsr.geometry.camera import Camera, baseline_times_focal
from dsr.methods.images import compute_min_max
from dsr.sample import AllHolesError, Scene
from dsr.training.degradation import Batch, Degradation, to_tensors
from dsr.training.settings import PatchSettings
from dsr.utils.guards import derived

_WINDOW_TRIES, _SCENE_TRIES = 10, 100
_MIN_VALID_FRACTION = 0.5
_SOFT, _SOFTEST = 0.5, 1.3  # pixels: blur of soft depth steps, from 0 where means do it, too


class Patches(Dataset[Batch]):
    """The random patches of a run, by their numbers, without an end.

    The scenes of each group have a true depth and are at least as large as a patch; ``shares`` are the frequencies of
    the groups, equal if None. ``everything`` is a distribution of degradations to draw from in place of
    ``degradation``, with one factor for all patches of a step, ``per_step`` or those of a batch.
    """

    def __init__(
        self,
        groups: Sequence[Sequence[Scene]],
        settings: PatchSettings,
        degradation: Degradation,
        *,
        shares: Sequence[float] | None = None,
        seed: int = 0,
        everything: Everything | None = None,
        per_step: int | None = None,
    ) -> None:
        drawn = None if everything is None else everything.scales
        for group, scale in itertools.product(groups, drawn or (degradation.scale,)):
            check_patches(group, settings, int(scale))
        self._everything, self._per_step = everything, per_step or settings.batch
        weights = np.array([1.0] * len(groups) if shares is None else shares, dtype=np.float64)
        if not groups or not all(groups):
            raise ValueError("patches: expected a scene or more to train on")
        if not (weights >= 0).all() or not 0 < weights.sum() < math.inf:
            raise ValueError(f"shares: expected numbers of 0 or more, one of them positive, got {weights.tolist()}")
        self._groups, self._settings, self._degradation = groups, settings, degradation
        self._limits = np.cumsum(weights / weights.sum())
        self._seed = seed
        self._depth_ranges: dict[tuple[int, int], list[float]] = {}  # by group and number of the scene

    def __getitem__(self, number: int) -> Batch:
        """Return a patch, at least half of whose depth is valid if ten tries find such a window.

        Another window is taken where noise makes all of its depth missing, as a sensor's limits of range may.
        """
        random = np.random.default_rng([self._seed, number])
        for _ in range(_SCENE_TRIES):
            with contextlib.suppress(AllHolesError):
                return self._patch(number, random)
        raise ValueError(
            "patches: expected low-resolution maps with a known pixel or more; noise makes all of them holes"
        )

    def _patch(self, number: int, random: np.random.Generator) -> Batch:
        """Return a random patch; with a distribution of degradations, ``noise`` and ``facts`` are hints."""
        everything, size = self._everything, self._settings.patch
        group = self._draw_group(random)
        soft = everything is not None and random.random() < everything.soft
        halved = soft and min(min(scene.rgb.shape[-2:]) for scene in self._groups[group]) >= 2 * size
        window = 2 * size if halved else size
        index, top, left = self._window(group, random, window)
        scene = derived(self._groups[group][index].crop(top, left, window, window), measured={})
        if soft:
            scene = soften(scene, random.uniform(0 if halved else _SOFT, _SOFTEST), halve=halved)
        if everything is None:
            scene = derived(scene, depth=scene.true_depth.double())
        scene, factor = augment(scene, self._settings, random)
        generator = torch.Generator().manual_seed(int(random.integers(2**63)))
        if everything is None:
            sample = self._degradation.sample(scene, generator)
            patch = to_tensors(sample)
            low, high, weight = self._draw_extent(group, index, factor, sample.camera, random)
            extent, own = torch.tensor([low, high]).view(2, 1, 1), patch["min_max"]
            extent = torch.stack((torch.minimum(extent[0], own[0]), torch.maximum(extent[1], own[1])))
            patch["min_max"] = own + weight * (extent - own)
            return patch
        sample, hints = everything(scene, self._draw_scale(number), generator, soft=soft)
        return {**to_tensors(sample), **hints._asdict(), "soft": torch.tensor(float(soft))}

    def _draw_group(self, random: np.random.Generator) -> int:
        return min(int(np.searchsorted(self._limits, random.random(), "right")), len(self._groups) - 1)

    def _draw_scale(self, number: int) -> int:
        """Return the factor of the step that a patch belongs to."""
        assert self._everything is not None  # noqa: S101 - the caller's case
        of_step = np.random.default_rng([self._seed, number // self._per_step, 1])
        drawing = torch.Generator().manual_seed(int(of_step.integers(2**62)))
        return self._everything.draw_scale(self._degradation.scale, drawing)

    def _draw_extent(
        self, group: int, index: int, factor: float, camera: Camera, random: np.random.Generator
    ) -> tuple[float, float, float]:
        """Return the range of disparity of a scene's whole map, and its weight beside the patch's own range.

        In use a network sees whole images, whose disparities have a larger range than a patch's. So half of the patches
        are normalised with the range of the scene's map, the others with one between it and their own.
        """
        if (group, index) not in self._depth_ranges:  # of the scene's low-resolution map, in metres
            whole = self._degradation.sample(self._groups[group][index], clean=True).depth_lr
            self._depth_ranges[group, index] = compute_min_max(whole[None]).flatten().tolist()
        near, far = self._depth_ranges[group, index]
        bf, doffs = baseline_times_focal(camera), camera.doffs
        weight = random.random() if random.random() < 0.5 else 1.0
        return bf / (factor * far) - doffs, bf / (factor * near) - doffs, weight

    def _window(self, group: int, random: np.random.Generator, size: int) -> tuple[int, int, int]:
        """Return a random window of a group: the number of the scene, the top and the left."""
        # The first with enough valid depth of ten of a random scene, else the best. Another scene only if none has any,
        # so that scenes with many holes are not trained on less often.
        scenes = self._groups[group]
        for _ in range(_SCENE_TRIES):
            number, best, highest = int(random.integers(len(scenes))), None, 0.0
            for _ in range(_WINDOW_TRIES):
                top, left = (int(random.integers(length - size + 1)) for length in scenes[number].rgb.shape[-2:])
                window = scenes[number].true_depth[:, top : top + size, left : left + size]
                fraction = float(window.isfinite().float().mean())
                if fraction > highest:
                    best, highest = (number, top, left), fraction
                if highest >= _MIN_VALID_FRACTION:
                    break
            if best is not None:
                return best
        raise ValueError("patches: expected scenes with more known depth than a few pixels")


class Changes(NamedTuple):
    """How a patch is changed at random."""

    gain: Any  # of each colour channel, (3, 1, 1)
    photo: tuple[float, float, float, Any] | None  # its exponent, blur in pixels, and noise: its strength and values
    mirrored: tuple[bool, bool]  # left to right, top to bottom
    turns: int  # quarter turns counterclockwise, after that
    factor: float  # of depth


def draw_changes(settings: PatchSettings, random: np.random.Generator, shape: Sequence[int] | None = None) -> Changes:
    """Draw the changes of a patch; ``shape`` (3, H, W) is that of a photo's noise, None if it is drawn elsewhere."""
    gain = 1 + settings.colour * random.standard_normal((3, 1, 1)) if settings.colour else np.ones((3, 1, 1))
    photo = None
    if random.random() < settings.photo:
        exponent, sigma, strength = math.exp(random.uniform(-0.5, 0.5)), random.uniform(0, 1.0), random.uniform(0, 0.03)
        photo = exponent, sigma, strength, None if shape is None else random.standard_normal(shape)
    mirrored = (random.random() < 0.5, random.random() < 0.5) if settings.flip else (False, False)
    turns = int(random.integers(4)) if settings.rotate else 0
    factor = math.exp(random.uniform(-settings.depth_scale, settings.depth_scale)) if settings.depth_scale else 1.0
    return Changes(gain, photo, mirrored, turns, factor)


def augment(scene: Scene, settings: PatchSettings, random: np.random.Generator) -> tuple[Scene, float]:
    """Return a scene changed at random, rgb, depth and camera alike, and the factor that multiplied its depth."""
    changes = draw_changes(settings, random, scene.rgb.shape)
    rgb = scene.rgb
    if settings.colour:
        rgb = (rgb * torch.from_numpy(changes.gain).float()).clamp(0, 1)
    if changes.photo is not None:
        exponent, sigma, strength, noise = changes.photo
        pixels = rgb.clamp(min=0).numpy() ** exponent
        pixels = ndimage.gaussian_filter(pixels, (0, sigma, sigma), mode="nearest") + strength * noise
        rgb = torch.from_numpy(pixels.astype(np.float32)).clamp(0, 1)
    scene = derived(scene, rgb=rgb)
    for vertical, mirrored in enumerate(changes.mirrored):
        if mirrored:
            scene = mirror(scene, vertical=bool(vertical))
    scene = rotate90(scene, changes.turns)
    return derived(scene, depth=scene.true_depth * changes.factor), changes.factor


def soften(scene: Scene, sigma: float = 0.0, *, halve: bool = True) -> Scene:
    """Return a scene whose depth steps are soft: truths of benchmarks have 2 to 5 mixed pixels across a step.

    Inverse depth is blurred by a Gaussian of ``sigma`` pixels of the result, which ``halve`` makes half as large.
    """
    inverse = scene.true_depth.reciprocal()
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
    axis, camera = -2 if vertical else -1, mirror_camera(scene.camera, vertical=vertical)
    return derived(scene, rgb=scene.rgb.flip(axis), depth=scene.true_depth.flip(axis), camera=camera, measured={})


def mirror_camera(camera: Camera, *, vertical: bool = False) -> Camera:
    """Return the camera of a mirror image."""
    if vertical:
        return derived(camera, cy=camera.height - 1 - camera.cy)
    return derived(camera, cx=camera.width - 1 - camera.cx)


def rotate90(scene: Scene, turns: int) -> Scene:
    """Return the scene rotated counterclockwise by ``turns`` quarter turns, the camera included."""
    if turns % 4 == 0:
        return scene
    rgb, depth = scene.rgb.rot90(turns, (-2, -1)), scene.true_depth.rot90(turns, (-2, -1))
    return derived(scene, rgb=rgb, depth=depth, camera=scene.camera.rotate90(turns), measured={})


def check_patches(scenes: Sequence[Scene], settings: PatchSettings, scale: int) -> None:
    """Check that patches of these settings can be cropped."""
    if settings.patch % scale:
        raise ValueError(f"patch: expected a size that scale={scale} divides, got {settings.patch}")
    for scene in scenes:
        height, width = scene.rgb.shape[-2:]
        if min(height, width) < settings.patch:
            raise ValueError(f"patch: expected at most {scene.name}'s {height} x {width}, got {settings.patch}")
