"""Training patches: random windows of scenes.

Patch number i of a run is a pure function of (seed, i), and of the number of patches of a step where factors are drawn.
So an interrupted run continues with the same patches, whatever the number of workers, and the patches of a step are the
same on one device and on several.
"""

from __future__ import annotations

import contextlib
import copy
import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dsr.degradation.random_degradation import Everything
from dsr.geometry.camera import baseline_times_focal
from dsr.methods.networks.normalisation import compute_min_max
from dsr.sample import AllHolesError, DepthSample, Scene
from dsr.training.augmentation import augment, soften
from dsr.training.degradation import Batch, Degradation, to_tensors
from dsr.training.settings import PatchSettings
from dsr.utils.guards import derived

_WINDOW_TRIES, _SCENE_TRIES = 10, 100
_MIN_VALID_FRACTION = 0.5
_SOFT, _SOFTEST = 0.5, 1.3
"""Pixels; the smallest and the largest standard deviation of what blurs soft depth steps, 0 where means do it, too."""


class Patches(Dataset[Batch]):
    """Random patches ``first`` .. ``first + count - 1`` of a run.

    Args:
        groups: groups of scenes, each with a true depth and at least as large as a patch.
        settings: how patches are cropped and augmented.
        degradation: how their low-resolution maps are made.
        shares: relative frequency of each group; None for equal frequencies.
        seed: seed of the run.
        first: number of the first patch.
        count: number of patches.
        everything: the distribution of degradations to draw from in place of ``degradation``; all patches of a step
            have one factor.
        per_step: number of patches of a step; None for those of a batch.

    """

    def __init__(
        self,
        groups: Sequence[Sequence[Scene]],
        settings: PatchSettings,
        degradation: Degradation,
        *,
        shares: Sequence[float] | None = None,
        seed: int = 0,
        first: int = 0,
        count: int = 1,
        everything: Everything | None = None,
        per_step: int | None = None,
    ) -> None:
        scales = [degradation.scale]
        if everything is not None and everything.scales is not None:
            scales = [int(scale) for scale in everything.scales]
        for group, scale in itertools.product(groups, scales):
            check_patches(group, settings, scale)
        self._everything, self._per_step = everything, per_step or settings.batch
        weights = np.array([1.0] * len(groups) if shares is None else shares, dtype=np.float64)
        if not groups or not all(groups):
            raise ValueError("patches: expected a scene or more to train on")
        if not weights.sum() > 0:
            raise ValueError("shares: expected a positive number among them, all are 0")
        self._groups, self._settings, self._degradation = groups, settings, degradation
        self._limits = np.cumsum(weights / weights.sum())
        self._seed, self._first, self._count = seed, first, count
        self._depth_ranges: dict[tuple[int, int], tuple[float, float]] = {}  # by group and number of the scene

    def __len__(self) -> int:
        return self._count

    def select(self, first: int, count: int) -> Patches:
        """Return the patches ``first`` .. ``first + count - 1`` of the same run."""
        other = copy.copy(self)
        other._first, other._count = first, count
        return other

    def __getitem__(self, index: int) -> Batch:
        """Return patch number ``first + index``, at least half of whose depth is valid if ten tries find such a window.

        Another window is taken where noise makes all of its depth missing, as a sensor's limits of range may.
        """
        number = self._first + index
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
        group = min(int(np.searchsorted(self._limits, random.random(), "right")), len(self._groups) - 1)
        soft = everything is not None and random.random() < everything.soft
        halved = soft and min(min(scene.rgb.shape[-2:]) for scene in self._groups[group]) >= 2 * size
        window = 2 * size if halved else size
        index, top, left = self._window(group, random, window)
        scene = derived(self._groups[group][index].crop(top, left, window, window), measured={})
        if soft:
            scene = soften(scene, random.uniform(0 if halved else _SOFT, _SOFTEST), halve=halved)
        if everything is None and scene.depth is not None:
            scene = derived(scene, depth=scene.depth.double())
        scene, factor = augment(scene, self._settings, random)
        generator = torch.Generator().manual_seed(int(random.integers(2**63)))
        if everything is None:
            sample = self._degradation.sample(scene, generator)
            patch = to_tensors(sample)
            whole = self._depth_range(group, index)
            patch["min_max"] = self._blend_min_max(patch["min_max"], whole, sample, factor, random)
            return patch
        of_step = np.random.default_rng([self._seed, number // self._per_step, 1])
        drawing = torch.Generator().manual_seed(int(of_step.integers(2**62)))
        scale = everything.draw_scale(self._degradation.scale, drawing)
        sample, hints = everything(scene, scale, generator, soft=soft)
        return {**to_tensors(sample), **hints._asdict(), "soft": torch.tensor(float(soft))}

    def _window(self, group: int, random: np.random.Generator, size: int) -> tuple[int, int, int]:
        """Return a random window of a group: the number of the scene, the top and the left.

        The first window of a random scene with enough valid depth is taken, else the best of ten. Another scene is
        taken only where all ten have no valid depth, so that scenes with many holes are not trained on less often.
        """
        scenes = self._groups[group]
        for _ in range(_SCENE_TRIES):
            number, best, highest = int(random.integers(len(scenes))), None, 0.0
            for _ in range(_WINDOW_TRIES):
                top, left = (int(random.integers(length - size + 1)) for length in scenes[number].rgb.shape[-2:])
                window = scenes[number].depth[:, top : top + size, left : left + size]  # type: ignore[index]  # checked
                fraction = float(window.isfinite().float().mean())
                if fraction > highest:
                    best, highest = (number, top, left), fraction
                if highest >= _MIN_VALID_FRACTION:
                    break
            if best is not None:
                return best
        raise ValueError("patches: expected scenes with more known depth than a few pixels")

    @staticmethod
    def _blend_min_max(
        own: Tensor, depth_range: tuple[float, float], sample: DepthSample, factor: float, random: np.random.Generator
    ) -> Tensor:
        """Return the disparities (2, 1, 1) that become 0 and 1 when a patch is normalised.

        In use a network sees whole images, whose disparities have a larger range than a patch's. So half of the patches
        are normalised with the range of the scene's low-resolution map, the others with a random range between it and
        their own.
        """
        near, far = depth_range
        bf, doffs = baseline_times_focal(sample.camera), sample.camera.doffs
        whole = torch.tensor([bf / (factor * far) - doffs, bf / (factor * near) - doffs]).view(2, 1, 1)
        whole = torch.stack((torch.minimum(whole[0], own[0]), torch.maximum(whole[1], own[1])))
        weight = random.random() if random.random() < 0.5 else 1.0
        return own + weight * (whole - own)

    def _depth_range(self, group: int, number: int) -> tuple[float, float]:
        """Return the nearest and the farthest depth of a scene's low-resolution map, in metres."""
        key = group, number
        if key not in self._depth_ranges:
            depth = self._degradation.sample(self._groups[group][number], clean=True).depth_lr
            low, high = compute_min_max(depth[None]).flatten().tolist()
            self._depth_ranges[key] = (low, high)
        return self._depth_ranges[key]


def check_patches(scenes: Sequence[Scene], settings: PatchSettings, scale: int) -> None:
    """Check that patches of these settings can be cropped."""
    if settings.patch % scale:
        raise ValueError(f"patch: expected a size that scale={scale} divides, got {settings.patch}")
    for scene in scenes:
        if scene.depth is None:
            raise ValueError(f"{scene.name}: expected a true depth to train with, there is none")
        height, width = scene.rgb.shape[-2:]
        if min(height, width) < settings.patch:
            raise ValueError(f"patch: expected at most {scene.name}'s {height} x {width}, got {settings.patch}")
