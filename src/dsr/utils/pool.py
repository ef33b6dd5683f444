"""Fault-tolerant worker processes: one that is killed is replaced, and its item is retried once.

Forked workers begin at once, share what this process has loaded, and take functions that cannot be pickled; spawned
ones are new interpreters. Whatever this process has computed before, forked ones do not hang, see
:mod:`dsr.utils.threads`.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, Literal, Self, TypeVar, cast

import cv2
import torch

from dsr.utils import interruption

_T = TypeVar("_T")
_R = TypeVar("_R")
_BETWEEN_TRIES = 0.3
"""Seconds until an item is tried again that somebody else is working on."""
_SECONDS_TO_END = 2.0
"""Seconds in which a worker may end by itself."""
LOST = "two workers ended at it without a result, perhaps for want of memory; fewer workers need less"
"""Why there is no result of an item, for a message that names it."""


class _Task(Generic[_T, _R]):
    """An item, and what became of it; once it is done it is in ``finished``."""

    def __init__(self, item: _T, finished: deque[_Task[_T, _R]]) -> None:
        self.item, self._finished = item, finished
        self.deaths, self.not_before, self.done = 0, 0.0, False
        self.value: _R | None = None
        self.error: Exception | None = None

    def finish(self, value: _R | None, error: Exception | None = None) -> None:
        """Note the result."""
        self.done, self.value, self.error = True, value, error
        self._finished.append(self)


class Pool(Generic[_T, _R]):
    """Worker processes to use in a ``with`` statement, at whose end they are terminated.

    Args:
        count: how many at most.
        work: function of an item that the workers call; None as its result says that the item is taken elsewhere and
            has to be tried again. What it raises is raised where its result is asked for.
        lost: function of an item that returns its result, or raises, after it has cost two workers their lives.
        say: shows a line of text.
        start: ``fork``, or ``spawn`` for new interpreters: functions and arguments are pickled then.
        prepare: function that each worker calls once; None for none.
        arguments: its arguments.
        label: function that returns the name of an item for a line of text.
        threads: of each worker; None for those that this process has, or a new one takes.

    """

    def __init__(
        self,
        count: int,
        work: Callable[[_T], _R | None],
        lost: Callable[[_T], _R],
        say: Callable[[str], None] = lambda _: None,
        *,
        start: Literal["fork", "spawn"] = "fork",
        prepare: Callable[..., None] | None = None,
        arguments: Sequence[Any] = (),
        label: Callable[[_T], str] = str,
        threads: int | None = None,
    ) -> None:
        self._count, self._lost, self._say, self._label = count, lost, say, label
        self._context = multiprocessing.get_context(start)
        self._forks, self._threads = start == "fork", threads
        self._plan = (work, prepare, arguments, threads)
        self._queue: deque[_Task[_T, _R]] = deque()
        self._later: list[_Task[_T, _R]] = []
        self._busy: dict[Connection, _Task[_T, _R] | None] = {}
        self._processes: dict[Connection, BaseProcess] = {}
        self._without_plan: set[Connection] = set()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Return itself."""
        self._stack.enter_context(interruption.with_workers())
        if self._forks:  # they inherit it: to set it in them can wait for ever for a thread that only this process has
            self._stack.enter_context(computing_threads(self._threads))
        return self

    def __exit__(self, *_: object) -> None:
        """Terminate the workers, whatever they are doing."""
        for process in self._processes.values():
            process.terminate()
        waits, deadline = interruption.is_ctrl_c(), time.monotonic() + _SECONDS_TO_END
        with interruption.deferred(lambda: interruption.MESSAGE) if waits else contextlib.nullcontext():
            for connection, process in self._processes.items():
                # for the step that it is at, or for the end of what it is writing
                process.join(None if waits else max(0.0, deadline - time.monotonic()))
                process.kill()  # whatever kept it from ending
                process.join()
                connection.close()
        self._processes, self._busy = {}, {}
        self._stack.close()

    def results(self, items: Sequence[_T], *, ordered: bool = False) -> Generator[tuple[_T, _R]]:
        """Begin to work on items, and return each with its result.

        Several of these generators may be open at a time. What is not begun when one is closed is dropped.

        Args:
            ordered: whether they are returned in the order of ``items``, not as they come.

        """
        finished: deque[_Task[_T, _R]] = deque()
        tasks = [_Task(item, finished) for item in items]
        self._queue.extend(tasks)
        self._give()
        return self._yield(tasks, finished, ordered=ordered)

    def _yield(
        self, tasks: Sequence[_Task[_T, _R]], finished: deque[_Task[_T, _R]], *, ordered: bool
    ) -> Generator[tuple[_T, _R]]:
        """Yield each item with its result."""
        try:
            for each in tasks:
                while not (each.done if ordered else finished):
                    self._take()
                task = each if ordered else finished.popleft()
                if task.error is not None:
                    raise task.error
                yield task.item, cast("_R", task.value)
        finally:
            dropped = set(tasks)
            self._queue = deque(task for task in self._queue if task not in dropped)
            self._later = [task for task in self._later if task not in dropped]

    def _give(self) -> None:
        """Give items to idle workers, which are started if there are too few."""
        due = [task for task in self._later if task.not_before <= time.monotonic()]
        self._later = [task for task in self._later if task not in due]
        self._queue.extend(due)
        while self._queue:
            idle = [connection for connection, task in self._busy.items() if task is None]
            missing = min(self._count - len(self._busy), len(self._queue) - len(idle))
            idle += [self._start() for _ in range(missing)]
            if not idle:
                return
            for connection in idle[: len(self._queue)]:
                self._send(connection, self._queue.popleft())

    def _send(self, connection: Connection, task: _Task[_T, _R]) -> None:
        """Give an item to an idle worker."""
        self._busy[connection] = task
        try:
            if connection in self._without_plan:
                self._without_plan.remove(connection)
                connection.send(self._plan)
            connection.send(task.item)
        except OSError:  # it has just ended
            self._bury(connection)

    def _take(self) -> None:
        """Wait for answers of workers, or until an item may be tried again, and go on with the next items."""
        for connection in cast("list[Connection]", wait(list(self._busy), _BETWEEN_TRIES if self._later else None)):
            try:
                fine, answer = connection.recv()
            except (EOFError, OSError):
                self._bury(connection)
                continue
            task, self._busy[connection] = self._busy[connection], None
            if task is None:
                continue
            if not fine:
                task.finish(None, answer)
            elif answer is None:
                task.not_before = time.monotonic() + _BETWEEN_TRIES
                self._later.append(task)
            else:
                task.finish(answer)
        self._give()

    def _bury(self, connection: Connection) -> None:
        """Note the end of a worker: its item is given to another one, or else lost."""
        task = self._busy.pop(connection)
        process = self._processes.pop(connection)
        self._without_plan.discard(connection)
        connection.close()
        process.kill()
        process.join()
        if task is None:
            return
        task.deaths += 1
        if task.deaths > 1:
            task.finish(self._lost(task.item))
            return
        name = self._label(task.item)
        self._say(f"{name}: the worker was ended before it had a result; another one begins it again")
        self._queue.appendleft(task)

    def _start(self) -> Connection:
        """Start a worker."""
        here, there = self._context.Pipe()
        arguments = (there, os.getpid(), self._plan if self._forks else None)
        if not self._forks and os.name == "posix":
            resource_tracker.ensure_running()  # else the first start begins it, and lets SIGINT through to the worker
        process = self._context.Process(target=_serve, args=arguments, daemon=True)  # type: ignore[attr-defined]
        with interruption.starting_workers(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads: those of this process sleep
            process.start()
        there.close()
        self._processes[here], self._busy[here] = process, None
        if not self._forks:
            self._without_plan.add(here)  # it gets it when all are started: one that is large waits for the worker
        return here


def _serve(connection: Connection, parent: int, plan: tuple[Any, ...] | None) -> None:
    """Work on items in a worker, until it is terminated."""
    interruption.end_with(parent, terminated=True)
    with contextlib.suppress(EOFError, KeyboardInterrupt):  # the parent was interrupted, or has ended this process
        work, prepare, arguments, threads = connection.recv() if plan is None else plan
        if plan is None:
            _set_threads(threads)
        if prepare is not None:
            prepare(*arguments)
        while True:
            item = connection.recv()
            try:
                answer = (True, work(item))
            except Exception as error:
                answer = (False, error)
            connection.send(answer)


@contextlib.contextmanager
def computing_threads(count: int | None) -> Iterator[None]:
    """Set the number of threads that torch and OpenCV compute with within the context; None leaves it."""
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
    if count is not None:
        torch.set_num_threads(count)
        cv2.setNumThreads(count)
