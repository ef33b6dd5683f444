"""Training patches: random windows of scenes.

Patch number i of a run is a pure function of (seed, i), so a run that is interrupted goes on with the very patches that
it would have seen, whatever the number of workers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from dsr.geometry.camera import baseline_times_focal
from dsr.sample import AllHolesError, DepthSample, Scene
from dsr.training.augmentation import Variation, window
from dsr.training.problem import Batch, Degradation, tensors_of

_TRIES, _MOST_TRIES = 10, 100
"""Of windows in a scene, and of scenes."""
_LEAST_KNOWN = 0.5
_LEAST_SIZE = 16


@dataclass(frozen=True)
class PatchSettings(Variation):
    """How patches are cut and varied.

    Args:
        size: height and width in pixels; the scale divides it.
        batch: patches per step and device.
        validation_scenes: how many of each data set's last scenes are never trained on, but validated with.
        scenes: how many of each data set's scenes to use, the first ones; None for all.
        workers: processes that cut patches; 0 for none beside the trainer's.
        flip, rotate, depth_scale, colour, photo: see :class:`dsr.training.augmentation.Variation`.

    Raises:
        ValueError: a value is out of range.

    """

    size: int = 96
    batch: int = 16
    validation_scenes: int = 4
    scenes: int | None = None
    workers: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.size < _LEAST_SIZE:
            raise ValueError(f"trainer.patch: expected at least {_LEAST_SIZE} pixels, got {self.size}")
        if self.batch < 1:
            raise ValueError(f"trainer.batch: expected a positive number, got {self.batch}")
        if self.scenes is not None and self.scenes < 1:
            raise ValueError(f"trainer.scenes: expected a positive number, or null for all, got {self.scenes}")
        for name in ("workers", "validation_scenes"):
            if getattr(self, name) < 0:
                raise ValueError(f"trainer.{name}: expected 0 or more, got {getattr(self, name)}")


class Patches(Dataset[Batch]):
    """Random patches ``first`` .. ``first + count - 1`` of a run.

    Args:
        groups: scenes to cut from, each with a true depth and at least a patch in size, in groups.
        settings: how.
        problem: what is to be undone.
        shares: how often patches come from each group; None for equally often.
        seed: of the run.
        first: number of the first patch.
        count: how many.

    Raises:
        ValueError: a scene is too small or lacks a true depth, or there is none.

    """

    def __init__(
        self,
        groups: Sequence[Sequence[Scene]],
        settings: PatchSettings,
        problem: Degradation,
        *,
        shares: Sequence[float] | None = None,
        seed: int = 0,
        first: int = 0,
        count: int = 1,
    ) -> None:
        for group in groups:
            check_patches(group, settings, problem.scale)
        weights = np.array([1.0] * len(groups) if shares is None else shares, dtype=np.float64)
        if not groups or not all(groups):
            raise ValueError("patches: expected a scene or more to train on")
        if not weights.sum() > 0:
            raise ValueError("dataset.shares: expected a positive number among them, all are 0")
        self._groups, self._settings, self._problem = groups, settings, problem
        self._limits = np.cumsum(weights / weights.sum())
        self._seed, self._first, self._count = seed, first, count
        self._extents: dict[tuple[int, int], tuple[float, float]] = {}  # by group and number: workers have other ids

    def __len__(self) -> int:
        return self._count

    def starting(self, first: int, count: int) -> Patches:
        """Return other patches of the same run."""
        other = Patches.__new__(Patches)
        other.__dict__ = {**self.__dict__, "_first": first, "_count": count}
        return other

    def __getitem__(self, index: int) -> Batch:
        """Return patch number ``first + index``; one with at least half of its depth known, if ten tries find one.

        Where noise leaves nothing of a window, as a sensor's limits of range may, another one is taken.
        """
        random = np.random.default_rng([self._seed, self._first + index])
        for _ in range(_MOST_TRIES):
            with contextlib.suppress(AllHolesError):
                return self._patch(random)
        raise ValueError(
            "patches: expected low-resolution maps with a known pixel or more; noise makes all of them holes"
        )

    def _patch(self, random: np.random.Generator) -> Batch:
        """Return a random patch."""
        group = min(int(np.searchsorted(self._limits, random.random(), "right")), len(self._groups) - 1)
        number, top, left = self._window(group, random)
        source = self._groups[group][number]
        scene, factor = self._settings(window(source, top, left, self._settings.size), random)
        generator = torch.Generator().manual_seed(int(random.integers(2**63)))
        sample = self._problem.sample(scene, generator)
        patch = tensors_of(sample)
        patch["bounds"] = self._blend(patch["bounds"], self._extent(group, number), sample, factor, random)
        return patch

    def _window(self, group: int, random: np.random.Generator) -> tuple[int, int, int]:
        """Return a random window of a group, the number of its scene, its top and its left.

        The first window of the scene whose depth is known well enough, else the best of ten; another scene only where
        all ten are holes, so that scenes with many holes get their share of the patches.
        """
        size, scenes = self._settings.size, self._groups[group]
        for _ in range(_MOST_TRIES):
            number, best, most = int(random.integers(len(scenes))), None, 0.0
            for _ in range(_TRIES):
                top, left = (int(random.integers(length - size + 1)) for length in scenes[number].rgb.shape[-2:])
                share = _share_known(scenes[number], top, left, size)
                if share > most:
                    best, most = (number, top, left), share
                if most >= _LEAST_KNOWN:
                    break
            if best is not None:
                return best
        raise ValueError("patches: expected scenes with more known depth than a few pixels")

    @staticmethod
    def _blend(
        own: Tensor, extent: tuple[float, float], sample: DepthSample, factor: float, random: np.random.Generator
    ) -> Tensor:
        """Return the bounds to normalise a patch with, (2, 1, 1).

        In use a network sees whole images, whose disparities span more than a patch's. So half of the patches get the
        bounds of the scene that they are cut from (of its low-resolution map), the others something in between.
        """
        near, far = extent
        stereo, doffs = baseline_times_focal(sample.camera), sample.camera.doffs
        whole = torch.tensor([stereo / (factor * far) - doffs, stereo / (factor * near) - doffs]).view(2, 1, 1)
        whole = torch.stack((torch.minimum(whole[0], own[0]), torch.maximum(whole[1], own[1])))
        share = random.random() if random.random() < 0.5 else 1.0
        return own + share * (whole - own)

    def _extent(self, group: int, number: int) -> tuple[float, float]:
        """Return the nearest and the farthest depth of a scene's low-resolution map, in metres."""
        key = group, number
        if key not in self._extents:
            depth = self._problem.sample(self._groups[group][number], clean=True).depth_lr
            known = depth[depth.isfinite()]
            self._extents[key] = (float(known.min()), float(known.max()))
        return self._extents[key]


def check_patches(scenes: Sequence[Scene], settings: PatchSettings, scale: int) -> None:
    """Raise where patches of these settings cannot be cut."""
    if settings.size % scale:
        raise ValueError(f"trainer.patch: expected a size that scale={scale} divides, got {settings.size}")
    for scene in scenes:
        if scene.depth is None:
            raise ValueError(f"{scene.name}: expected a true depth to train with, there is none")
        height, width = scene.rgb.shape[-2:]
        if min(height, width) < settings.size:
            raise ValueError(f"trainer.patch: expected at most {scene.name}'s {height} x {width}, got {settings.size}")


def _share_known(scene: Scene, top: int, left: int, size: int) -> float:
    """Return how much of a window's depth is known."""
    if scene.depth is None:
        return 0.0
    return float(scene.depth[:, top : top + size, left : left + size].isfinite().float().mean())
