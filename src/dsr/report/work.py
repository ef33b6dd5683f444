"""The calls that draw and encode the parts of a report, in this process or in several."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from multiprocessing.queues import Queue
from types import TracebackType
from typing import Self, TypeVar

import cv2
import torch

from dsr.evaluation.results import Results
from dsr.utils.workers import WorkerPool

_FEW = 24
"""Number of predictions below which the start of worker processes takes longer than they save."""
_MOST = 8
"""Maximum number of workers unless more are requested; each needs about 0.5 GB."""
_results: Results | None = None
"""The results that this process works on, if it is a worker."""
_Item = TypeVar("_Item")
_Value = TypeVar("_Value")


def default_workers(results: Results) -> int:
    """Return the number of worker processes that a report of some results is worth: one per core, or 1 for none."""
    predictions = sum(len(run.scenes) for run in results.runs)
    return 1 if predictions < _FEW else min(os.cpu_count() or 1, _MOST)


class Work:
    """Calls functions of the results, to use in a ``with`` statement.

    Args:
        results: first argument of all functions; each worker gets it once.
        workers: number of worker processes; 1 for none.

    """

    def __init__(self, results: Results, workers: int = 1) -> None:
        self.results = results
        self._pool: WorkerPool | None = None
        self._threads = torch.get_num_threads(), cv2.getNumThreads()
        if workers > 1:
            _set_threads(cores := max(1, (os.cpu_count() or 1) // workers))  # a fork inherits them, and cannot set them
            if sys.platform == "linux":
                self._pool = WorkerPool(workers, _begin, (results,), "fork")
            else:
                self._pool = WorkerPool(workers, _begin, (_queued(results, workers), cores))

    def map(self, function: Callable[[Results, _Item], _Value], items: Sequence[_Item]) -> Generator[_Value]:
        """Return the values of ``function(results, item)`` in the order of the items.

        Workers begin at once; without them, each call is made when its value is asked for.

        Args:
            function: function of a module, since workers import it.
            items: second arguments.

        Raises:
            ChildProcessError: a worker was ended; raised with the value.

        """
        if self._pool is None:
            return (function(self.results, item) for item in items)
        return _in_order([self._pool.submit(_call, function, item) for item in items])

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Terminate the workers."""
        if self._pool is not None:
            self._pool.__exit__(kind, error, trace)
            _set_threads(*self._threads)


def _in_order(futures: Sequence[Future[_Value]]) -> Generator[_Value]:
    """Yield values as they are done; those that nobody asks for are not begun."""
    try:
        for future in futures:
            yield future.result()
    except BrokenProcessPool as error:
        message = "a worker of the report ended, perhaps for want of memory; fewer --workers need less"
        raise ChildProcessError(message) from error
    finally:
        for future in futures:
            future.cancel()


def _queued(results: Results, workers: int) -> Queue[Results]:
    """Return a queue with the results for each worker.

    Ctrl-C would cut off arguments larger than a pipe's buffer while a worker starts, so it asks for them.
    """
    queue: Queue[Results] = get_context("spawn").Queue()
    queue.cancel_join_thread()
    for _ in range(workers):
        queue.put(results)
    return queue


def _set_threads(of_torch: int, of_opencv: int | None = None) -> None:
    """Set the numbers of threads that torch and OpenCV compute with, equal ones if one is given."""
    torch.set_num_threads(of_torch)
    cv2.setNumThreads(of_torch if of_opencv is None else of_opencv)


def _begin(results: Results | Queue[Results], cores: int | None = None) -> None:
    """Prepare a worker.

    Garbage is collected after each call: Matplotlib makes so many objects that the automatic collections would take a
    third of the time of a figure.
    """
    global _results  # noqa: PLW0603 - the worker's own
    _results = results if isinstance(results, Results) else results.get()
    gc.disable()
    if cores is not None:
        _set_threads(cores)


def _call(function: Callable[[Results, _Item], _Value], item: _Item) -> _Value:
    """Call a function in a worker."""
    if _results is None:
        raise RuntimeError("this process is no worker of a report")
    try:
        return function(_results, item)
    finally:
        gc.collect()
        gc.freeze()  # what is left stays, such as modules, and is not gone through again
