"""``dsr upsample`` on a Ray cluster: frames in a data set of Ray Data, and actors that each keep a device busy.

An actor that dies is started again, and its frames are given to another: what it had finished is complete already, and
what it had begun is begun anew. Ray is optional: ``pip install dsr[ray]``.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch

from dsr.app.upsample.frame import FrameWork
from dsr.app.upsample.frames import Frames, find_frames
from dsr.app.upsample.reporting import Record
from dsr.app.upsample.request import UpsampleRequest
from dsr.app.upsample.workers import attempt
from dsr.utils.progress import Progress

if TYPE_CHECKING:
    import ray.data

BATCH = 4
"""Frames that an actor takes at a time, and that are given to another if it dies."""


class FrameActor:
    """Upsamples batches of frames, for ``map_batches`` of Ray Data; an actor makes one and keeps it.

    Args:
        request: the request, which has to be alike in all actors.
        frames: the frames of :func:`dsr.app.upsample.frames.find_frames`; None to read them from the manifest.
        threads: number of threads to compute with.

    Raises:
        ValueError: the file of poses is damaged, or does not fit the pictures.

    """

    def __init__(self, request: UpsampleRequest, frames: Frames | None = None, threads: int = 1) -> None:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
        frames = find_frames(request) if frames is None else frames
        self._output, self._frames = request.output, frames
        self._work = FrameWork(request, frames.whole, frames.firsts)

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Upsample a batch.

        Args:
            batch: ``number``, (n,) places of frames among those of ``frames``.

        Returns:
            ``name``, ``outcome`` and ``problem``, (n,) texts each; the outcome of a frame that failed is empty.

        """
        rows = []
        for number in batch["number"]:
            pair = self._frames.found.pairs[int(number)]
            done = attempt(self._work, pair, self._frames.target(self._output, pair), Record(), Progress())
            rows.append((pair.name, done.outcome, done.problem or ""))
        return {key: np.array(values) for key, values in zip(("name", "outcome", "problem"), zip(*rows, strict=True),
                                                             strict=True)}  # fmt: skip


def upsample_dataset(request: UpsampleRequest, actors: int, *, cpus: float = 1, gpus: float = 0) -> ray.data.Dataset:
    """Return a data set of Ray Data whose rows are the outcomes of frames: ``name``, ``outcome`` and ``problem``.

    The frames are upsampled when the rows are taken, and the results written where ``dsr upsample`` writes them, which
    has to be a folder that all machines see, as are those of the frames.

    Args:
        request: what to upsample; with a ``shard``, only that.
        actors: number of actors, one for each device.
        cpus: processor cores of each, and the number of its threads.
        gpus: devices of each, 1 or a fraction; Ray shows it no others.

    Raises:
        ValueError: Ray is not installed, or the frames cannot be determined.

    """
    if importlib.util.find_spec("ray") is None:
        raise ValueError("expected the library ray, which `pip install dsr[ray]` installs")
    import ray.data  # noqa: PLC0415 - optional, and takes seconds

    request = replace(request, output=request.output.absolute())
    frames = find_frames(request)
    numbers = [{"number": number} for number in range(len(frames.found.pairs))]
    blocks = max(1, min(len(numbers) // BATCH, 64 * actors))
    # no task makes these rows, so that actors on all cores do not keep it waiting
    return ray.data.from_items(numbers, override_num_blocks=blocks).map_batches(
        FrameActor,
        fn_constructor_kwargs={
            "request": request,
            "frames": None if request.manifest is not None else frames,
            "threads": max(1, int(cpus)),
        },
        batch_size=BATCH,
        concurrency=actors,
        num_cpus=cpus,
        num_gpus=gpus,
    )


def upsample_frames(request: UpsampleRequest, actors: int, *, cpus: float = 1, gpus: float = 0) -> Iterator[Any]:
    """Upsample, and yield the rows of :func:`upsample_dataset` as they come, in no order."""
    yield from upsample_dataset(request, actors, cpus=cpus, gpus=gpus).iter_rows()
