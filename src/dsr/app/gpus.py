"""A GPU for each process of a sweep on this machine: Hydra's joblib launcher shows all of them to every job."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

from filelock import FileLock, Timeout

_VISIBLE = "CUDA_VISIBLE_DEVICES"
_FOLDER = ".gpus"
_taken: list[FileLock] = []
"""The lock of this process on its GPU, which the operating system releases when the process ends."""


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    named = os.environ.get(_VISIBLE)
    if named is not None:
        return [name.strip() for name in named.split(",") if name.strip()]
    import torch  # noqa: PLC0415 - it takes seconds

    return [str(number) for number in range(torch.cuda.device_count())]


def count_gpus(otherwise: int) -> int:
    """Return the number of visible GPUs, or on a machine without one ``otherwise``."""
    return len(visible_gpus()) or otherwise


def take_gpu(folder: Path) -> None:
    """Make one GPU the only visible one of this process, until it ends; with one or none nothing happens.

    It is one that the fewest processes of the same sweep have taken. To be called before CUDA is used.

    Args:
        folder: of the sweep.

    """
    gpus = visible_gpus()
    if _taken or len(gpus) < 2:
        return
    (folder / _FOLDER).mkdir(parents=True, exist_ok=True)
    for turn, gpu in ((turn, gpu) for turn in itertools.count() for gpu in gpus):
        lock = FileLock(folder / _FOLDER / f"{gpu}.{turn}")
        try:
            lock.acquire(blocking=False)
        except Timeout:
            continue
        _taken.append(lock)
        os.environ[_VISIBLE] = gpu
        return
