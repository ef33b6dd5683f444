"""Training batches: random patches of scenes, and whole scenes for validation.

Patch number i of a run is a pure function of (seed, i), so a run that is interrupted goes on with the very patches that
it would have seen, whatever the number of workers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import lightning
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from dsr.data.base import SceneSource
from dsr.degrade import Downsampling, make_sample
from dsr.geometry.camera import VIRTUAL_BASELINE, to_range
from dsr.sample import DepthSample, Scene

Batch = dict[str, Tensor]
_TRIES, _MOST_TRIES = 10, 1000
_LEAST_KNOWN = 0.5
_LEAST_SIZE = 16


@dataclass(frozen=True)
class PatchSettings:
    """How patches are cut and varied.

    Args:
        size: height and width in pixels; the scale divides it.
        batch: patches per step.
        steps: steps per epoch, that is between two validations.
        validation_scenes: how many of the data set's last scenes are never trained on, but validated with.
        flip: whether patches are mirrored at random, both ways.
        colour: standard deviation of the random gain of each colour channel.
        workers: processes that cut patches; 0 for none beside the trainer's.

    Raises:
        ValueError: a value is out of range.

    """

    size: int = 128
    batch: int = 16
    steps: int = 250
    validation_scenes: int = 4
    flip: bool = True
    colour: float = 0.1
    workers: int = 0

    def __post_init__(self) -> None:
        """Check the values."""
        if self.size < _LEAST_SIZE:
            raise ValueError(f"trainer.patch: expected at least {_LEAST_SIZE} pixels, got {self.size}")
        positive = {"batch": self.batch, "validate_every": self.steps, "validation_scenes": self.validation_scenes}
        for name, value in positive.items():
            if value < 1:
                raise ValueError(f"trainer.{name}: expected a positive number, got {value}")
        for name in ("workers", "colour"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"trainer.{name}: expected 0 or more, got {getattr(self, name)}")


def tensors_of(sample: DepthSample, dtype: torch.dtype = torch.float32) -> Batch:
    """Return a sample as the tensors that a network on disparities trains on.

    Returns:
        ``rgb`` (3, H, W) float32; ``disparity_lr`` (1, h, w) float32, in pixels of the photo's camera; and in ``dtype``
        ``depth`` (1, H, W) metres, ``rays`` (3, H, W), ``stereo`` (1, 1, 1) baseline times fx, ``doffs`` (1, 1, 1).

    """
    if sample.depth is None:
        raise ValueError(f"{sample.scene}: expected a true depth to train with, there is none")
    camera = sample.camera
    baseline = VIRTUAL_BASELINE if camera.baseline is None else camera.baseline
    return {
        "rgb": sample.rgb.float(),
        "disparity_lr": (sample.scale * to_range(sample.depth_lr, sample.camera_lr, "disparity")).float(),
        "depth": sample.depth.to(dtype),
        "rays": camera.rays(dtype=dtype),
        "stereo": torch.full((1, 1, 1), baseline * camera.fx, dtype=dtype),
        "doffs": torch.full((1, 1, 1), camera.doffs, dtype=dtype),
    }


class Patches(Dataset[Batch]):
    """Random patches ``first`` .. ``first + count - 1`` of a run.

    Args:
        scenes: what to cut from; each has a true depth and is at least a patch in size.
        settings: how.
        scale, downsampling: as for :func:`dsr.degrade.make_sample`.
        seed: of the run.
        first, count: numbers of the patches.

    Raises:
        ValueError: a scene is too small, or lacks a true depth.

    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        settings: PatchSettings,
        scale: int,
        downsampling: Downsampling,
        *,
        seed: int = 0,
        first: int = 0,
        count: int = 1,
    ) -> None:
        _check(scenes, settings, scale)
        if not scenes:
            raise ValueError("patches: expected a scene or more to train on")
        self._scenes, self._settings, self._scale, self._downsampling = scenes, settings, scale, downsampling
        self._seed, self._first, self._count = seed, first, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Batch:
        """Return patch number ``first + index``; one with at least half of its depth known, if ten tries find one."""
        random = np.random.default_rng([self._seed, self._first + index])
        scene = _varied(self._window(random), self._settings, random)
        return tensors_of(make_sample(scene, self._scale, self._downsampling, "disparity"))

    def _window(self, random: np.random.Generator) -> Scene:
        """Return a random window: the first whose depth is known well enough, else the best of ten."""
        best, most = None, 0.0
        for tries in range(_MOST_TRIES):
            scene = self._scenes[int(random.integers(len(self._scenes)))]
            size = self._settings.size
            top, left = (int(random.integers(length - size + 1)) for length in scene.rgb.shape[-2:])
            share = _share_known(scene, top, left, size)
            if share > most:
                best, most = (scene, top, left), share
            if best is not None and (most >= _LEAST_KNOWN or tries >= _TRIES - 1):
                return _cut(*best, size)
        raise ValueError("patches: expected scenes with more known depth than a few pixels")


class WholeScenes(Dataset[Batch]):
    """The samples of whole scenes, in float64 as evaluation scores them."""

    def __init__(self, scenes: Sequence[Scene], scale: int, downsampling: Downsampling) -> None:
        self._samples = [make_sample(scene, scale, downsampling, "disparity") for scene in scenes]

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Batch:
        """Return one sample's tensors."""
        return tensors_of(self._samples[index], torch.float64)


class PatchData(lightning.LightningDataModule):
    """Patches of a data set's scenes to train on, its last scenes whole to validate with.

    Args:
        source: the data set.
        settings: how patches are cut.
        scale, downsampling: as for :func:`dsr.degrade.make_sample`.
        seed: of the patches.

    Raises:
        ValueError: the data set has too few scenes, or the scale does not divide a patch.

    """

    def __init__(
        self, source: SceneSource, settings: PatchSettings, scale: int, downsampling: Downsampling, seed: int = 0
    ) -> None:
        super().__init__()
        names = source.scenes()
        held_out = settings.validation_scenes
        if len(names) <= held_out:
            raise ValueError(f"trainer.validation_scenes: expected fewer than the {len(names)} scenes, got {held_out}")
        _check((), settings, scale)
        self.training_names, self.validation_names = names[:-held_out], names[-held_out:]
        self.source = source
        self._settings, self._scale, self._downsampling, self._seed = settings, scale, downsampling, seed
        self._training: list[Scene] = []
        self._validation: list[Scene] = []

    def setup(self, stage: str = "fit") -> None:
        """Load the scenes; ``stage`` is Lightning's and makes no difference.

        Raises:
            ValueError: a scene is smaller than a patch, or lacks a true depth.

        """
        if not self._training:
            self._training = [_light(self.source.load(name)) for name in self.training_names]
            self._validation = [self.source.load(name) for name in self.validation_names]
            _check([*self._training, *self._validation], self._settings, self._scale)

    def some_patches(self, count: int) -> list[Batch]:
        """Return the first patches of the run, once the scenes are loaded."""
        patches = self._patches(0, count)
        return [patches[index] for index in range(count)]

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return the patches of the current epoch."""
        epoch, steps = 0, self._settings.steps
        if self.trainer is not None:
            epoch = self.trainer.current_epoch
            if self.trainer.max_steps > 0:  # the last epoch ends with the training, lest it went without validation
                steps = max(1, min(steps, self.trainer.max_steps - epoch * steps))
        patches = self._patches(epoch * self._settings.steps * self._settings.batch, steps * self._settings.batch)
        workers: dict[str, Any] = {"num_workers": self._settings.workers}
        return DataLoader(patches, batch_size=self._settings.batch, pin_memory=torch.cuda.is_available(), **workers)

    def _patches(self, first: int, count: int) -> Patches:
        settings, scale, downsampling = self._settings, self._scale, self._downsampling
        return Patches(self._training, settings, scale, downsampling, seed=self._seed, first=first, count=count)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return the whole validation scenes, one at a time."""
        return DataLoader(WholeScenes(self._validation, self._scale, self._downsampling), batch_size=1)


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


def _cut(scene: Scene, top: int, left: int, size: int) -> Scene:
    """Return a window of a scene."""
    rows, columns = slice(top, top + size), slice(left, left + size)
    depth = None if scene.depth is None else scene.depth[:, rows, columns].double()
    camera = scene.camera.crop(top, left, size, size)
    return Scene(scene.dataset, scene.name, scene.rgb[:, rows, columns], camera, depth)


def _varied(scene: Scene, settings: PatchSettings, random: np.random.Generator) -> Scene:
    """Return the scene mirrored and recoloured at random."""
    if settings.colour:
        gain = torch.from_numpy(1 + settings.colour * random.standard_normal((3, 1, 1))).float()
        scene = replace(scene, rgb=(scene.rgb * gain).clamp(0, 1))
    if settings.flip and scene.depth is not None:
        for axis, length, centre in ((-1, scene.camera.width, "cx"), (-2, scene.camera.height, "cy")):
            if random.random() < 0.5:
                camera = replace(scene.camera, **{centre: length - 1 - getattr(scene.camera, centre)})
                scene = replace(scene, rgb=scene.rgb.flip(axis), depth=scene.depth.flip(axis), camera=camera)
    return scene
