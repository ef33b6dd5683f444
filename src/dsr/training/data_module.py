"""Training data: random patches of the scenes of data sets, and whole scenes for validation."""

import functools
import math
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from dsr.data.scene_source import SceneSource, as_source
from dsr.degradation.downsampling import encode_facts
from dsr.degradation.random_degradation import Everything
from dsr.methods.classical.interpolation import Interpolation
from dsr.sample import Scene
from dsr.training.degradation import Batch, Degradation, to_tensors
from dsr.training.device_patches import DevicePatches, made_by_workers
from dsr.training.patches import Patches, check_patches
from dsr.training.settings import PatchSettings
from dsr.utils import interruption
from dsr.utils.guards import derived

_EPOCH = 1000  # about how many batches an epoch has where the trainer has no number of steps


@dataclass(frozen=True)
class Part:
    """A data set to train on, and how often patches come from it, relative to the other parts."""

    source: SceneSource
    share: float = 1.0


class WholeScenes(Dataset[Batch]):
    """Batches of one whole scene in float64, as evaluation scores it; ``hinted`` adds hints, of sharp steps."""

    def __init__(
        self, scenes: Sequence[Scene], degradation: Degradation, seed: int = 0, *, hinted: bool = False
    ) -> None:
        self._samples = [degradation.sample(scene, seed) for scene in scenes]
        self._facts = None
        if hinted:
            kernel = degradation.downsampling.assumed_model().kernel
            self._facts = encode_facts(kernel, soft=False, noise=degradation.noise is None)

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Batch:
        """Return a scene's tensors, its ``unit``, hints if there are any, and ``bicubic``, (1, 1, H, W) in metres."""
        sample = self._samples[index]
        tensors = to_tensors(sample, torch.float64)
        tensors["bicubic"] = Interpolation("bicubic")(sample).double()
        if self._facts is not None:
            tensors |= {"noise": torch.zeros_like(tensors["disparity_lr"]).float(), "facts": self._facts}
        return {**{name: value[None] for name, value in tensors.items()}, "unit": asdict(sample.unit)}


class PatchData(lightning.LightningDataModule):
    """Patches of data sets to train on, and whole scenes to validate with: the last ones of each, and other data sets.

    Scenes to validate with that lack a true depth are left out. ``everything`` is a distribution of degradations to
    train on in place of ``degradation``, ``patches_per_step`` is of all devices and batches of a step, None for one
    batch, and ``device`` is what ``auto`` in ``settings`` depends on if there is no trainer yet.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        settings: PatchSettings,
        degradation: Degradation,
        *,
        seed: int = 0,
        validation: Mapping[str, SceneSource] | None = None,
        everything: Everything | None = None,
        patches_per_step: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        self._device = torch.device(device)
        check_patches((), settings, degradation.scale)
        self._everything, self._per_step = everything, patches_per_step
        self.patches, self._degradation, self._seed = settings, degradation, seed
        self._shares = [part.share for part in parts]
        self.trained: list[tuple[SceneSource, list[str]]] = []  # data sets and names of their scenes to train on
        # likewise to validate with, by validation set; scenes without a true depth leave it at ``setup``
        self.held_out: dict[str, tuple[SceneSource, list[str]]] = {}
        self._makes_patches()  # before scenes are rendered
        held_out: list[tuple[str, SceneSource, list[str]]] = []
        for part in parts:
            if not 0 <= part.share < math.inf:
                raise ValueError(f"share of {part.source.name}: expected 0 or a positive number, got {part.share}")
            source = as_source(part.source)
            names, kept = _split(source, settings)
            self.trained.append((source, names))
            if kept:
                held_out.append((source.name, source, kept))
        held_out += [(name, as_source(source), source.scenes()) for name, source in (validation or {}).items()]
        if not held_out:
            raise ValueError("validation_scenes: expected a positive number where there is no other validation")
        trained = {source.content(name) for source, names in self.trained for name in names}
        for name, source, scenes in held_out:
            kind, number = name, 1
            while kind in self.held_out:
                number += 1
                kind = f"{name}_{number}"
            self.held_out[kind] = (source, scenes)
            for scene in scenes:
                if source.content(scene) in trained:  # under whatever name
                    raise ValueError(f"validation.{kind}: expected scenes that are not trained on, got {scene}")
        self._validation: list[list[Scene]] = []

    def setup(self, stage: str = "fit") -> None:
        """Load the scenes; Lightning's ``stage`` makes no difference."""
        if self._validation:
            return
        groups = [  # of float32, which takes half the memory
            [derived(scene, depth=scene.true_depth.float()) for scene in map(source.load, names)]
            for source, names in self.trained
        ]
        self._cut = (DevicePatches if self._makes_patches(groups) else Patches)(
            groups, self.patches, self._degradation, shares=self._shares, seed=self._seed, everything=self._everything,
            per_step=self._per_step,
        )  # fmt: skip
        for kind, (source, names) in self.held_out.items():
            known = [scene for scene in map(source.load, names) if scene.depth is not None]
            if not known:
                raise ValueError(f"validation.{kind}: expected scenes with a true depth, there is none")
            self.held_out[kind] = (source, [scene.name for scene in known])
            self._validation.append(known)

    @property
    def _net(self) -> Any:
        return getattr(getattr(self.trainer, "lightning_module", None), "net", None)

    def _training_device(self) -> torch.device:
        return self._device if self.trainer is None else self.trainer.strategy.root_device

    def _makes_patches(self, groups: Sequence[Sequence[Scene]] = ()) -> bool:
        """Return whether the training's device makes the patches; a ValueError if it is to make what it cannot."""
        wanted = self.patches.on_device
        if not wanted or (wanted == "auto" and self._training_device().type == "cpu"):
            return False
        left_to_workers = made_by_workers(self._degradation, self._everything)
        if any(bool(scene.true_depth.isnan().any()) for group in groups for scene in group):
            left_to_workers = left_to_workers or "a true depth with holes"
        if left_to_workers and wanted is True:
            raise ValueError(f"on_device: expected false or auto, {left_to_workers} is left to workers")
        return not left_to_workers

    def first_patches(self, count: int) -> list[Batch]:
        """Return the first ``count`` patches of the run."""
        self.setup()
        if not isinstance(self._cut, DevicePatches):
            return [self._cut[number] for number in range(count)]
        self._cut.store(torch.device("cpu"))
        made = [self._cut.make(self._cut.collate([self._cut[number]])) for number in range(count)]
        tensors = ({key: each for key, each in patch.items() if isinstance(each, Tensor)} for patch in made)
        return [{key: each[0] for key, each in patch.items()} for patch in tensors]

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Make the patches of a training's batch on its device, if they are to be made there."""
        if "places" not in batch or not isinstance(self._cut, DevicePatches):
            return batch
        patches = self._cut.make(batch)
        offset = patches["doffs"] if getattr(self._net, "of_inverse_depth", False) else 0
        patches["filled"] = patches["disparity_lr"] + offset  # there are no holes to fill
        prepare: Callable[[Batch], Batch] = getattr(self._net, "prepare", dict)
        return prepare(patches)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return a loader of an epoch's patches, which begins at the trainer's current step."""
        self.setup()
        prepare = getattr(self._net, "prepare", None)
        collate: Callable[..., Batch] | None = functools.partial(_collate_prepared, prepare) if prepare else None
        wanted, workers = self.patches.workers, 0
        if isinstance(self._cut, DevicePatches):
            self._cut.store(self._training_device())
            collate = self._cut.collate
        elif wanted != "auto":
            workers = wanted
        elif self._training_device().type != "cpu":
            devices = 1 if self.trainer is None else self.trainer.num_devices  # of this machine, a process each
            # of which a cluster's job has a part
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            workers = max(1, cores // devices - 1)
        return _PatchLoader(
            self._cut,
            batch_sampler=_PatchNumbers(self.trainer, self.patches.batch),
            collate_fn=collate,
            num_workers=workers,
            worker_init_fn=functools.partial(_begin_worker, os.getpid()),
            pin_memory=torch.cuda.is_available(),
        )

    def val_dataloader(self) -> list[DataLoader[Batch]]:
        """Return a loader for each validation set, of whole scenes, one at a time; each device has a part of them."""
        rank, devices = (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
        parts = (scenes[rank::devices] for scenes in self._validation)
        hinted = self._everything is not None
        batches: Any = (  # an empty one where a device has no scene: Lightning would leave it out of the validation
            WholeScenes(part, self._degradation, self._seed, hinted=hinted) if part else [{}] for part in parts
        )
        return [DataLoader(each, batch_size=None) for each in batches]

    test_dataloader = predict_dataloader = val_dataloader


def _split(source: SceneSource, settings: PatchSettings) -> tuple[list[str], list[str]]:
    """Return the scenes of a data set to train on, and the last ones, to validate with."""
    if source.evaluation:
        raise ValueError(
            f"dataset={source.name}: its scenes are to evaluate on, not to train on; "
            f"+dataset@validation.{source.name}={source.name} validates with them"
        )
    names, count = source.scenes()[: settings.scenes], settings.validation_scenes
    if len(names) <= count:
        raise ValueError(f"validation_scenes: expected less than {source.name}'s {len(names)} scenes, got {count}")
    return names[: len(names) - count], names[len(names) - count :]


class _PatchNumbers:
    """The patch numbers of one device's batches in an epoch, from the trainer's current step on."""

    def __init__(self, trainer: lightning.Trainer | None, batch: int) -> None:
        self._trainer, self._batch = trainer, batch
        self._accumulate, steps, self._rank, self._devices = 1, -1, 0, 1
        if trainer is not None:
            self._accumulate, steps = trainer.accumulate_grad_batches, trainer.max_steps
            self._rank, self._devices = trainer.global_rank, trainer.world_size
        self._length = self._accumulate * (steps if steps > 0 else max(1, _EPOCH // self._accumulate))

    def __len__(self) -> int:
        return self._length  # of the whole epoch: Lightning subtracts the batches done before an interruption

    def __iter__(self) -> Iterator[list[int]]:
        done = 0 if self._trainer is None else self._trainer.global_step * self._accumulate
        for number in range(done, done - done % self._length + self._length):
            first = (number * self._devices + self._rank) * self._batch
            yield list(range(first, first + self._batch))


class _PatchLoader(DataLoader[Batch]):
    """A loader whose workers do not end before the training, if all get a signal, as from a cluster or a terminal."""

    def __iter__(self) -> Any:  # a type that torch does not export
        with interruption.starting_workers(signal.SIGTERM):
            return super().__iter__()


def _collate_prepared(prepare: Callable[[Batch], Batch], samples: list[Batch]) -> Batch:
    """Return a batch of patches with what the network wants to have computed before a step."""
    return prepare(default_collate(samples))


def _begin_worker(parent: int, _: int) -> None:
    """Prepare a worker; torch looks after the parent only every five seconds."""
    interruption.end_with(parent)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # to the whole group: the parent may need it to complete a step
