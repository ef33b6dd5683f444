"""Worker processes: new interpreters that call functions of items; if one is killed, new ones take over, once."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import pickle
import signal
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Self, TypeVar

from dsr.utils import interruption

_Item = TypeVar("_Item")
_Value = TypeVar("_Value")
_SECONDS_TO_END = 2.0  # in which a worker may remove its temporary files
LOST = "worker processes were killed twice, perhaps for want of memory; fewer workers need less"


class Pool:
    """Worker processes, to use in a ``with`` statement; the end of an interrupted one terminates them.

    Each worker first calls ``prepare(*arguments)``, and computes with a number of threads, or with those of torch.
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
        self._plan = (pickle.dumps((prepare, arguments)), threads)
        self._count, self._say = count, say
        self._executors: list[ProcessPoolExecutor] = []

    def __enter__(self) -> Self:
        """Return itself."""
        self._others = set(multiprocessing.active_children())
        self._executors.append(self._executor())
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
        self, function: Callable[[_Item], _Value], items: Sequence[_Item], *, ordered: bool = False
    ) -> Generator[tuple[_Item, _Value]]:
        """Begin to work on items, and return each with its value, as they come or in their order.

        What a killed worker has left is begun again. If workers are killed twice, a ChildProcessError is raised.
        """
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
        self, function: Callable[[_Item], _Value], items: Sequence[_Item]
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
                raise ChildProcessError(LOST)
            self._say("a worker process was killed; others begin again what it left")
            self._executors.append(self._executor())

    def _executor(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self._count, multiprocessing.get_context("spawn"), _begin, self._plan)


def _begin(plan: bytes, threads: int | None) -> None:
    """Prepare a worker, which ends with its parent."""
    interruption.end_with(os.getppid())
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    _set_threads(threads)
    prepare, arguments = pickle.loads(plan)  # noqa: S301 - of the parent
    if prepare is not None:
        prepare(*arguments)
    gc.freeze()  # imported modules are not gone through again


def _call(function: Callable[[_Item], _Value], item: _Item) -> _Value:
    """Call a function in a worker; when it is terminated, temporary files are removed first."""
    try:
        return function(item)
    except (SystemExit, KeyboardInterrupt):
        os._exit(143)


@contextlib.contextmanager
def computing_threads(count: int | None) -> Iterator[None]:
    """Set the number of threads that torch and OpenCV compute with within the context; None leaves it."""
    import cv2  # noqa: PLC0415 - as below
    import torch  # noqa: PLC0415

    before = torch.get_num_threads(), cv2.getNumThreads()
    _set_threads(count)
    try:
        yield
    finally:
        if count is not None:
            torch.set_num_threads(before[0])
            cv2.setNumThreads(before[1])


def _set_threads(count: int | None) -> None:
    """Set the number of threads that torch and OpenCV compute with; None leaves it."""
    import cv2  # noqa: PLC0415 - workers import them, and not before they have taken in what they get
    import torch  # noqa: PLC0415

    if count is not None:
        torch.set_num_threads(count)
        cv2.setNumThreads(count)
