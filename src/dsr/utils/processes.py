"""Several processes at work: locks in the directory of a run, and worker processes.

Locks lie in ``.locks``; the system releases them when their process ends, however it ends. Workers are new interpreters
that call functions of items; if one is killed, new ones take over, once.
"""

import contextlib
import functools
import gc
import hashlib
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Self, TypeVar

from filelock import FileLock, Timeout

from dsr.utils import interruption

_Item = TypeVar("_Item")
_Value = TypeVar("_Value")
LOCKS = ".locks"
_BETWEEN_LOOKS = 0.3
_SECONDS_TO_END = 2.0  # in which a worker may remove its temporary files
_own: Any = None  # what this process, if it is a worker, has prepared
_LOST = "worker processes were killed twice, perhaps for want of memory; fewer workers need less"


class InUseError(ValueError):
    """A command with other settings is at work in a directory."""


@contextlib.contextmanager
def at_work(folder: Path, settings: str) -> Iterator[None]:
    """Within this context a directory belongs to commands with the same settings; InUseError for others."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    place = folder / LOCKS
    beginning = f"command-{_digest(settings)}-"
    own = place / f"{beginning}{socket.gethostname()}-{os.getpid()}.lock"
    lock = FileLock(own)
    while not lock.is_locked:
        place.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # the last command has just removed the directory
            lock.acquire()
    try:
        for other in place.glob("command-*"):
            if not other.name.startswith(beginning) and _is_held(other):
                host, _, process = other.stem.split("-", 2)[2].rpartition("-")
                owner = f"process {process} of {host}"
                raise InUseError(f"{folder}: {owner} is at work there; wait for its end, or take another folder")
        yield
    finally:
        lock.release()
        own.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # the directory is not empty, or another command removes the locks
            if not any(map(_is_held, place.glob("command-*"))):
                for each in place.iterdir():
                    each.unlink()
            for each in (place, *made):
                each.rmdir()


def scene_lock(folder: Path, name: str) -> FileLock:
    """Return the lock of a scene, or of another part of a run, for one process at a time."""
    (folder / LOCKS).mkdir(parents=True, exist_ok=True)
    return FileLock(folder / LOCKS / f"{_digest(name)}.lock")


def free_first(folder: Path, scenes: Sequence[str], *, wait: bool = True) -> Iterator[str]:
    """Yield each scene while its lock is held; those that other processes work on come last, or not if not ``wait``."""
    waiting = list(scenes)
    while waiting:
        for scene in tuple(waiting):
            try:
                held = scene_lock(folder, scene).acquire(blocking=False)
            except Timeout:
                continue
            with held:
                waiting.remove(scene)
                yield scene
        if not wait:
            return
        if waiting:
            time.sleep(_BETWEEN_LOOKS)


def _is_held(path: Path) -> bool:
    try:
        with FileLock(path).acquire(blocking=False):
            return False
    except Timeout:
        return True


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:24]


class Pool:
    """Worker processes, to use in a ``with`` statement; the end of an interrupted one terminates them.

    Each worker first calls ``prepare(*arguments)``, and computes with a number of threads, or with those of torch. What
    that returns, if anything, is the first argument of the functions that it calls afterwards.
    """

    def __init__(
        self,
        count: int,
        prepare: Callable[..., object] | None = None,
        arguments: Sequence[Any] = (),
        threads: int | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        # as bytes, which a worker takes in at once: else each one would be waited for until it has imported all of it
        plan = (pickle.dumps((prepare, arguments)), threads)
        context = multiprocessing.get_context("spawn")
        self._new_executor = functools.partial(ProcessPoolExecutor, count, context, _begin, plan)
        self._say = say
        self._executors: list[ProcessPoolExecutor] = []

    def __enter__(self) -> Self:
        self._others = set(multiprocessing.active_children())
        self._executors.append(self._new_executor())
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the workers: at an error, whatever they are doing."""
        if kind is not None:
            workers = set(multiprocessing.active_children()) - self._others
            for worker in workers:
                worker.terminate()
            for worker in workers:
                worker.join(_SECONDS_TO_END)
                worker.kill()
        for executor in self._executors:
            executor.shutdown(cancel_futures=True)

    def results(
        self, function: Callable[..., _Value], items: Sequence[_Item], *, ordered: bool = False
    ) -> Generator[tuple[_Item, _Value]]:
        """Begin to work on items; yield each with its value as they come, or ``ordered``. ChildProcessError ends it."""
        left, executor = self._submit(function, items)

        def values() -> Generator[tuple[_Item, _Value]]:
            nonlocal left, executor
            while left:
                try:
                    for future in list(left) if ordered else as_completed(left):
                        value = future.result()
                        yield left.pop(future), value
                except BrokenProcessPool:
                    self._replace(executor)
                    left, executor = self._submit(function, list(left.values()))

        return values()

    def _submit(
        self, function: Callable[..., _Value], items: Sequence[_Item]
    ) -> tuple[dict[Future[_Value], _Item], ProcessPoolExecutor]:
        while True:
            executor = self._executors[-1]
            try:
                with interruption.starting_workers():
                    return {executor.submit(_call, function, item): item for item in items}, executor
            except BrokenProcessPool:
                self._replace(executor)

    def _replace(self, broken: ProcessPoolExecutor) -> None:
        """Replace a broken executor, unless that is done; the second one that breaks is an error."""
        if broken is self._executors[-1]:
            if len(self._executors) > 1:
                raise ChildProcessError(_LOST)
            self._say("a worker process was killed; others begin again what it left")
            self._executors.append(self._new_executor())


def _begin(plan: bytes, threads: int | None) -> None:
    global _own  # noqa: PLW0603 - the worker's
    interruption.end_with(os.getppid())
    if threads is not None:
        _set_threads(threads, threads)
    prepare, arguments = pickle.loads(plan)  # noqa: S301 - of the parent
    if prepare is not None:
        _own = prepare(*arguments)
    gc.freeze()  # imported modules are not gone through again
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # until here it just ends this process


def _call(function: Callable[..., _Value], item: Any) -> _Value:
    """Call a function in a worker; when it is terminated, temporary files are removed first."""
    try:
        return function(item) if _own is None else function(_own, item)
    except (SystemExit, KeyboardInterrupt):
        os._exit(143)


@contextlib.contextmanager
def computing_threads(count: int) -> Iterator[None]:
    """Set the number of threads that torch and OpenCV compute with within the context."""
    import cv2  # noqa: PLC0415 - as below
    import torch  # noqa: PLC0415

    before = torch.get_num_threads(), cv2.getNumThreads()
    _set_threads(count, count)
    try:
        yield
    finally:
        _set_threads(*before)


def _set_threads(of_torch: int, of_opencv: int) -> None:
    import cv2  # noqa: PLC0415 - workers import them, and not before they have taken in what they get
    import torch  # noqa: PLC0415

    torch.set_num_threads(of_torch)
    cv2.setNumThreads(of_opencv)
