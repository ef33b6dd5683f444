"""Training batches: random patches of scenes, and whole scenes for validation.

Patch number i of a run is a pure function of (seed, i), so a run that is interrupted goes on with the very patches that
it would have seen, whatever the number of workers.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dsr.data.augment import Variation, window
from dsr.data.base import SceneSource
from dsr.degrade import Downsampling, Noise, make_sample
from dsr.geometry.camera import VIRTUAL_BASELINE, Camera, to_range
from dsr.sample import DepthSample, Scene

Batch = dict[str, Tensor]
_TRIES, _MOST_TRIES = 10, 1000
_LEAST_KNOWN = 0.5
_LEAST_SIZE = 16
_LEAST_SPAN = 1e-3
"""Of the bounds of a flat patch, as a share of its disparity."""


@dataclass(frozen=True)
class PatchSettings:
    """How patches are cut and varied.

    Args:
        size: height and width in pixels; the scale divides it.
        batch: patches per step and device.
        validation_scenes: how many of each data set's last scenes are never trained on, but validated with.
        workers: processes that cut patches; 0 for none beside the trainer's.
        flip, rotate, depth_scale, colour: see :class:`dsr.data.augment.Variation`.

    Raises:
        ValueError: a value is out of range.

    """

    size: int = 96
    batch: int = 16
    validation_scenes: int = 4
    workers: int = 0
    flip: bool = True
    rotate: bool = True
    depth_scale: float = 0.3
    colour: float = 0.1

    def __post_init__(self) -> None:
        """Check the values."""
        if self.size < _LEAST_SIZE:
            raise ValueError(f"trainer.patch: expected at least {_LEAST_SIZE} pixels, got {self.size}")
        if self.batch < 1:
            raise ValueError(f"trainer.batch: expected a positive number, got {self.batch}")
        for name in ("workers", "validation_scenes"):
            if getattr(self, name) < 0:
                raise ValueError(f"trainer.{name}: expected 0 or more, got {getattr(self, name)}")
        self.variation()

    def variation(self) -> Variation:
        """Return how patches are varied."""
        return Variation(self.flip, self.rotate, self.depth_scale, self.colour)


@dataclass(frozen=True)
class Problem:
    """What is to be undone: how coarse maps come from fine ones.

    Args:
        scale, downsampling, noise: as for :func:`dsr.degrade.make_sample`.

    """

    scale: int
    downsampling: Downsampling
    noise: Noise = None

    def sample(self, scene: Scene, generator: torch.Generator | int = 0, *, clean: bool = False) -> DepthSample:
        """Return the problem that a scene poses, its coarse map made of disparity."""
        noise = None if clean else self.noise
        return make_sample(scene, self.scale, self.downsampling, "disparity", noise, generator)


def tensors_of(sample: DepthSample, dtype: torch.dtype = torch.float32, bounds: Tensor | None = None) -> Batch:
    """Return a sample as the tensors that a network on disparities trains on.

    Args:
        sample: with a true depth.
        dtype: of all but the photo and the bounds.
        bounds: (2, 1, 1) lowest and highest disparity to normalise with; None for those of the coarse map.

    Returns:
        ``rgb`` (3, H, W), ``bounds`` (2, 1, 1), float32; in ``dtype`` ``disparity_lr`` (1, h, w) in pixels of the
        photo's camera, ``depth`` (1, H, W) metres, ``rays`` (3, H, W), ``stereo`` (1, 1, 1) baseline times fx
        and ``doffs`` (1, 1, 1).

    """
    if sample.depth is None:
        raise ValueError(f"{sample.scene}: expected a true depth to train with, there is none")
    camera = sample.camera
    disparity = sample.scale * to_range(sample.depth_lr, sample.camera_lr, "disparity")
    return {
        "rgb": sample.rgb.float(),
        "disparity_lr": disparity.to(dtype),
        "depth": sample.depth.to(dtype),
        "rays": camera.rays(dtype=dtype),
        "stereo": torch.full((1, 1, 1), _stereo(camera), dtype=dtype),
        "doffs": torch.full((1, 1, 1), camera.doffs, dtype=dtype),
        "bounds": (_bounds(disparity) if bounds is None else bounds).float(),
    }


@dataclass(frozen=True)
class Part:
    """A data set to train on.

    Args:
        source: the data set.
        share: how often patches come from it, relative to the other parts' shares.

    Raises:
        ValueError: the share is negative or no number.

    """

    source: SceneSource
    share: float = 1.0

    def __post_init__(self) -> None:
        """Check the share."""
        if not 0 <= self.share < math.inf:
            raise ValueError(f"dataset.shares: expected 0 or a positive number, got {self.share}")


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
        problem: Problem,
        *,
        shares: Sequence[float] | None = None,
        seed: int = 0,
        first: int = 0,
        count: int = 1,
    ) -> None:
        for group in groups:
            _check(group, settings, problem.scale)
        weights = np.array([1.0] * len(groups) if shares is None else shares, dtype=np.float64)
        if not groups or not all(groups) or not weights.sum() > 0:
            raise ValueError("patches: expected a scene or more to train on")
        self._groups, self._settings, self._problem = groups, settings, problem
        self._limits = np.cumsum(weights / weights.sum())
        self._variation = settings.variation()
        self._seed, self._first, self._count = seed, first, count
        self._extents: dict[int, tuple[float, float]] = {}

    def __len__(self) -> int:
        return self._count

    def starting(self, first: int, count: int) -> Patches:
        """Return other patches of the same run."""
        other = Patches.__new__(Patches)
        other.__dict__ = {**self.__dict__, "_first": first, "_count": count}
        return other

    def __getitem__(self, index: int) -> Batch:
        """Return patch number ``first + index``; one with at least half of its depth known, if ten tries find one."""
        random = np.random.default_rng([self._seed, self._first + index])
        source, top, left = self._window(random)
        scene, factor = self._variation(window(source, top, left, self._settings.size), random)
        generator = torch.Generator().manual_seed(int(random.integers(2**63)))
        sample = self._problem.sample(scene, generator)
        return tensors_of(sample, bounds=self._blend(source, sample, factor, random))

    def _window(self, random: np.random.Generator) -> tuple[Scene, int, int]:
        """Return a random window: the first whose depth is known well enough, else the best of ten."""
        best, most = None, 0.0
        size = self._settings.size
        for tries in range(_MOST_TRIES):
            group = self._groups[
                min(int(np.searchsorted(self._limits, random.random(), "right")), len(self._groups) - 1)
            ]
            scene = group[int(random.integers(len(group)))]
            top, left = (int(random.integers(length - size + 1)) for length in scene.rgb.shape[-2:])
            share = _share_known(scene, top, left, size)
            if share > most:
                best, most = (scene, top, left), share
            if best is not None and (most >= _LEAST_KNOWN or tries >= _TRIES - 1):
                return best
        raise ValueError("patches: expected scenes with more known depth than a few pixels")

    def _blend(self, source: Scene, sample: DepthSample, factor: float, random: np.random.Generator) -> Tensor:
        """Return the bounds to normalise a patch with, (2, 1, 1).

        In use a network sees whole images, whose disparities span more than a patch's. So half of the patches get the
        bounds of the scene that they are cut from (of its coarse map), the others something in between.
        """
        own = _bounds(sample.scale * to_range(sample.depth_lr, sample.camera_lr, "disparity"))
        near, far = self._extent(source)
        stereo, doffs = _stereo(sample.camera), sample.camera.doffs
        whole = torch.tensor([stereo / (factor * far) - doffs, stereo / (factor * near) - doffs]).view(2, 1, 1)
        whole = torch.stack((torch.minimum(whole[0], own[0]), torch.maximum(whole[1], own[1])))
        share = random.random() if random.random() < 0.5 else 1.0
        return own + share * (whole - own)

    def _extent(self, scene: Scene) -> tuple[float, float]:
        """Return the nearest and the farthest depth of a scene's coarse map, in metres."""
        if id(scene) not in self._extents:
            depth = self._problem.sample(scene, clean=True).depth_lr
            known = depth[depth.isfinite()]
            self._extents[id(scene)] = (float(known.min()), float(known.max()))
        return self._extents[id(scene)]


class WholeScenes(Dataset[Batch]):
    """The samples of whole scenes, in float64 as evaluation scores them."""

    def __init__(self, scenes: Sequence[Scene], problem: Problem, seed: int = 0) -> None:
        self._samples = [problem.sample(scene, seed) for scene in scenes]

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Batch:
        """Return one sample's tensors."""
        return tensors_of(self._samples[index], torch.float64)


class PatchData(lightning.LightningDataModule):
    """Patches of data sets' scenes to train on; the last scenes of each, and other data sets, whole to validate with.

    Args:
        parts: the data sets to train on.
        settings: how patches are cut.
        problem: what is to be undone.
        seed: of the patches, and of the noise of validation scenes.
        validation: more data sets to validate with, by name; scenes without a true depth are left out.

    Raises:
        ValueError: a data set has too few scenes, a scene is to be trained on and validated with, or the scale does not
            divide a patch.

    """

    def __init__(
        self,
        parts: Sequence[Part],
        settings: PatchSettings,
        problem: Problem,
        *,
        seed: int = 0,
        validation: Mapping[str, SceneSource] | None = None,
    ) -> None:
        super().__init__()
        _check((), settings, problem.scale)
        self._parts, self._settings, self._problem, self._seed = list(parts), settings, problem, seed
        self._training_names: list[list[str]] = []
        self._held_out: dict[str, tuple[SceneSource, list[str]]] = {}
        for part in parts:
            self._split(part.source)
        for name, source in (validation or {}).items():
            self._held_out[_unused(name, self._held_out)] = (source, source.scenes())
        if not self._held_out:
            raise ValueError("trainer.validation_scenes: expected a positive number where there is no other validation")
        self._refuse_leaks()
        self._patches: Patches | None = None
        self._validation: list[list[Scene]] = []

    @property
    def sources(self) -> list[SceneSource]:
        """All data sets, those of the parts first."""
        return [*(part.source for part in self._parts), *(source for source, _ in self._held_out.values())]

    @property
    def validation_sets(self) -> list[str]:
        """The names of the validation sets, in the order of the loaders."""
        return list(self._held_out)

    @property
    def training_count(self) -> int:
        """How many scenes are trained on."""
        return sum(map(len, self._training_names))

    def validation_scenes(self) -> dict[str, tuple[SceneSource, list[str]]]:
        """Return the scenes of each validation set: the data set that has them, and their names."""
        return dict(self._held_out)

    def setup(self, stage: str = "fit") -> None:
        """Load the scenes; ``stage`` is Lightning's and makes no difference.

        Raises:
            ValueError: a scene is smaller than a patch, or lacks a true depth.

        """
        if self._patches is not None:
            return
        groups = [
            [_light(part.source.load(name)) for name in names]
            for part, names in zip(self._parts, self._training_names, strict=True)
        ]
        shares = [part.share for part in self._parts]
        self._patches = Patches(groups, self._settings, self._problem, shares=shares, seed=self._seed)
        for kind, (source, names) in self._held_out.items():
            scenes = [scene for scene in map(source.load, names) if scene.depth is not None]
            if not scenes:
                raise ValueError(f"validation.{kind}: expected scenes with a true depth, there is none")
            self._held_out[kind] = (source, [scene.name for scene in scenes])
            self._validation.append(scenes)

    def some_patches(self, count: int) -> list[Batch]:
        """Return the first patches of the run, once the scenes are loaded."""
        patches = self._loaded().starting(0, count)
        return [patches[index] for index in range(count)]

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return the patches of the run from the trainer's step on, without an end.

        A loader without a length: of one with a length, Lightning would count off what was trained before it was made.
        """
        per_step, done, rank = self._settings.batch, 0, 0
        if self.trainer is not None:
            per_step *= self.trainer.accumulate_grad_batches * self.trainer.world_size
            done, rank = self.trainer.global_step, self.trainer.global_rank
        stride = 1 if self.trainer is None else self.trainer.world_size
        numbers = _Numbers(done * per_step, self._settings.batch, rank, stride)
        workers: dict[str, Any] = {"num_workers": self._settings.workers}
        pin = torch.cuda.is_available()
        return DataLoader(self._loaded().starting(0, sys.maxsize), batch_sampler=numbers, pin_memory=pin, **workers)

    def val_dataloader(self) -> list[DataLoader[Batch]]:
        """Return the whole validation scenes, one at a time, a loader per set."""
        return [DataLoader(WholeScenes(scenes, self._problem, self._seed), batch_size=1) for scenes in self._validation]

    def _loaded(self) -> Patches:
        if self._patches is None:
            self.setup()
        assert self._patches is not None  # noqa: S101 - for the type checker
        return self._patches

    def _split(self, source: SceneSource) -> None:
        """Hold the last scenes of a data set out."""
        names, count = source.scenes(), self._settings.validation_scenes
        if len(names) <= count:
            raise ValueError(
                f"trainer.validation_scenes: expected fewer than the {len(names)} scenes of {source.name}, got {count}"
            )
        self._training_names.append(names[: len(names) - count])
        if count:
            self._held_out[_unused(source.name, self._held_out)] = (source, names[len(names) - count :])

    def _refuse_leaks(self) -> None:
        """Raise where a scene is to be trained on and validated with."""
        trained = {
            (name, part.source.fingerprint(name))
            for part, names in zip(self._parts, self._training_names, strict=True)
            for name in names
        }
        for kind, (source, names) in self._held_out.items():
            for name in names:
                if (name, source.fingerprint(name)) in trained:
                    raise ValueError(f"validation.{kind}: expected scenes that are not trained on, got {name}")


class _Numbers:
    """The numbers of the patches of one device's batches, endlessly; deliberately without a length.

    Args:
        first: number of the first patch of all devices.
        batch: patches per batch.
        rank: of the device.
        stride: how many devices there are.

    """

    def __init__(self, first: int, batch: int, rank: int, stride: int) -> None:
        self._first, self._batch, self._rank, self._stride = first, batch, rank, stride

    def __iter__(self) -> Iterator[list[int]]:
        for start in itertools.count(self._first + self._rank * self._batch, self._stride * self._batch):
            yield list(range(start, start + self._batch))


def _stereo(camera: Camera) -> float:
    """Return baseline times fx, in metre pixels."""
    return (VIRTUAL_BASELINE if camera.baseline is None else camera.baseline) * camera.fx


def _bounds(disparity: Tensor) -> Tensor:
    """Return the lowest and the highest known value, (2, 1, 1), some way apart."""
    known = disparity[disparity.isfinite()]
    low, high = known.min(), known.max()
    return torch.stack((low, torch.maximum(high, low + _LEAST_SPAN * high.abs().clamp(min=_LEAST_SPAN)))).view(2, 1, 1)


def _unused(name: str, names: Mapping[str, Any]) -> str:
    """Return the name, with a number where it is taken."""
    candidate, number = name, 1
    while candidate in names:
        number += 1
        candidate = f"{name}_{number}"
    return candidate


def _light(scene: Scene) -> Scene:
    """Return a scene whose depth takes half the memory."""
    return scene if scene.depth is None else replace(scene, depth=scene.depth.float())


def _check(scenes: Sequence[Scene], settings: PatchSettings, scale: int) -> None:
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
