"""The scenes of a run, worked through by several processes, each scene by one: of this command, and of others.

See :mod:`dsr.evaluation.claims` for commands that share a directory, perhaps from several machines.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from dsr.evaluation.claims import Claim, Claims
from dsr.utils.pool import Pool, computing_threads
from dsr.utils.progress import Progress

_R = TypeVar("_R")
_BETWEEN_TRIES = 0.3
_MEMORY = 1 << 30
"""Bytes of free memory that the automatic number of workers leaves to each."""


@dataclass(frozen=True)
class Workers:
    """How many processes work at a time, and how.

    Args:
        count: how many; 1 for this one.
        threads: of each; None for those that torch has. Sums of many numbers depend on it in their last bits, on
            ``count`` they do not.

    """

    count: int = 1
    threads: int | None = None


ALONE = Workers()


def choose_workers(workers: int | None, threads: int | None, scenes: int, cores: int, *, together: bool) -> Workers:
    """Return how a run is worked through.

    Args:
        workers: given number of processes; None to choose it: as many as the cores and the free memory allow.
        threads: given number of threads of each; None to choose it. It must not depend on the number of workers.
        scenes: number of scenes.
        cores: number of threads that this machine runs at a time.
        together: whether scenes are worked on together if nothing is given: each then gets a share of the cores.
            Otherwise they come one after the other with all cores, as a method that is long at work needs.

    """
    if threads is None:
        threads = max(1, cores // max(1, scenes)) if together else cores
    if workers is None:
        workers = min(max(1, cores // threads), max(1, _free_memory() // _MEMORY)) if together else 1
    return Workers(max(1, min(workers, scenes)), threads)


def can_fork() -> bool:
    """Return whether this system has the processes that several workers need."""
    return hasattr(os, "fork")


def share(
    scenes: Sequence[str],
    claims: Claims,
    name: str,
    ready: Callable[[str], _R | None],
    work: Callable[[str, Progress], _R],
    lost: Callable[[str], _R],
    workers: Workers,
    progress: Progress,
    meanwhile: Callable[[], None] | None = None,
) -> dict[str, _R]:
    """Work through scenes, but for those that other commands work on; wait for these.

    Args:
        scenes: the scenes.
        claims: the claims of this command.
        name: what is done to the scenes, such as ``predict``.
        ready: function that returns the result of a scene if it is there already.
        work: function that makes it, and leaves it where ``ready`` finds it.
        lost: function that returns the result of a scene whose workers were killed.
        workers: how many at a time.
        progress: display of the completed scenes.
        meanwhile: function that is called while workers are busy, or else at once; None for none.

    Returns:
        The results by scene, in the order of ``scenes``.

    """
    found: dict[str, _R] = {}
    if workers.count == 1 or len(scenes) < 2:
        if meanwhile is not None:
            meanwhile()
        with computing_threads(workers.threads):
            attempts = _attempts(scenes, claims, name, ready)
            for scene, attempt in progress.track(attempts, name, len(scenes), label=_scene_of):
                if isinstance(attempt, Claim):
                    with attempt:
                        result = ready(scene)
                        found[scene] = work(scene, progress) if result is None else result
                else:
                    found[scene] = attempt
        return {scene: found[scene] for scene in scenes}

    def attempt_once(scene: str) -> _R | None:
        attempt = _attempt(scene, claims, name, ready)
        if not isinstance(attempt, Claim):
            return attempt
        with attempt:
            result = ready(scene)
            return work(scene, Progress()) if result is None else result

    with Pool(workers.count, attempt_once, lost, progress.say, threads=workers.threads) as pool:
        results = pool.results(scenes)
        if meanwhile is not None:
            meanwhile()
        for scene, result in progress.track(results, name, len(scenes), label=_scene_of):
            found[scene] = result
    return {scene: found[scene] for scene in scenes}


def _attempts(
    scenes: Sequence[str], claims: Claims, name: str, ready: Callable[[str], _R | None]
) -> Iterator[tuple[str, _R | Claim]]:
    """Yield each scene once, with its result or a claim on it."""
    waiting = list(scenes)
    while waiting:
        before = len(waiting)
        for scene in tuple(waiting):
            attempt = _attempt(scene, claims, name, ready)
            if attempt is not None:
                waiting.remove(scene)
                yield scene, attempt
        if len(waiting) == before:
            time.sleep(_BETWEEN_TRIES)


def _attempt(scene: str, claims: Claims, name: str, ready: Callable[[str], _R | None]) -> _R | Claim | None:
    """Return the result of a scene if it is there, or a claim on it; None if somebody else works on it."""
    result = ready(scene)
    return claims.take(f"{name} {scene}") if result is None else result


def _scene_of(pair: tuple[str, object]) -> str:
    """Return the scene of a scene and something about it."""
    return pair[0]


def _free_memory() -> int:
    """Return the bytes of memory that are free; where the system does not tell it, those of a large machine."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        return 1 << 40
