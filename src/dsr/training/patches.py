"""Training data: random patches of data sets' scenes, and whole scenes for validation."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import lightning
import torch
from torch.utils.data import DataLoader, Dataset

from dsr.data.base import SceneSource, content_of
from dsr.sample import Scene
from dsr.training.cropping import Patches, PatchSettings, check_patches
from dsr.training.problem import Batch, Degradation, tensors_of


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


class WholeScenes(Dataset[Batch]):
    """The samples of whole scenes, in float64 as evaluation scores them."""

    def __init__(self, scenes: Sequence[Scene], problem: Degradation, seed: int = 0) -> None:
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
        ValueError: a data set is one to evaluate on or has too few scenes, a scene is to be trained on and validated
            with, or the scale does not divide a patch.

    """

    def __init__(
        self,
        parts: Sequence[Part],
        settings: PatchSettings,
        problem: Degradation,
        *,
        seed: int = 0,
        validation: Mapping[str, SceneSource] | None = None,
    ) -> None:
        super().__init__()
        check_patches((), settings, problem.scale)
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
    def used(self) -> list[tuple[SceneSource, list[str]]]:
        """The scenes that are trained on or validated with, by data set; those of the parts first."""
        trained = [(part.source, names) for part, names in zip(self._parts, self._training_names, strict=True)]
        return [*trained, *self._held_out.values()]

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
        if source.evaluation:
            raise ValueError(
                f"dataset={source.name}: its scenes are to evaluate on, not to train on; "
                f"+dataset@validation.{source.name}={source.name} validates with them"
            )
        names, count = source.scenes()[: self._settings.scenes], self._settings.validation_scenes
        if len(names) <= count:
            raise ValueError(
                f"trainer.validation_scenes: expected fewer than the {len(names)} scenes of {source.name}, got {count}"
            )
        self._training_names.append(names[: len(names) - count])
        if count:
            self._held_out[_unused(source.name, self._held_out)] = (source, names[len(names) - count :])

    def _refuse_leaks(self) -> None:
        """Raise where a scene is to be trained on and validated with, be it under another name."""
        trained = {
            content_of(part.source, name)
            for part, names in zip(self._parts, self._training_names, strict=True)
            for name in names
        }
        for kind, (source, names) in self._held_out.items():
            for name in names:
                if content_of(source, name) in trained:
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
