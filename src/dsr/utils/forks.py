"""Worker processes forked from this one, which share what it has loaded and outlive each other.

Where a :class:`dsr.utils.workers.WorkerPool` starts new interpreters, these begin at once and take functions that
cannot be pickled. One that is killed is replaced, and its item is given to another. The process that forks must not
have computed with several threads before: the threads of OpenMP do not survive a fork.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from dsr.utils import interruption

_T = TypeVar("_T")
_R = TypeVar("_R")
_BETWEEN_TRIES = 0.3
"""Seconds until an item is tried again that somebody else is working on."""
_SECONDS_TO_END = 2.0
"""Seconds in which a worker may end by itself."""


class _Died:
    """The answer of a worker that ended without one."""


class Forks(Generic[_T, _R]):
    """Forked worker processes to use in a ``with`` statement, at whose end they are terminated.

    Args:
        count: how many.
        work: function of an item that the workers call; None as its result says that the item is taken elsewhere and
            has to be tried again. What it raises is raised here and ends the work.
        lost: function of an item that returns its result after it has cost two workers their lives.
        say: shows a line of text.

    """

    def __init__(
        self,
        count: int,
        work: Callable[[_T], _R | None],
        lost: Callable[[_T], _R],
        say: Callable[[str], None],
    ) -> None:
        self._work, self._lost, self._say = work, lost, say
        self._busy: dict[Connection, _T | None] = {}
        self._processes: dict[Connection, BaseProcess] = {}
        self._count = count

    def __enter__(self) -> Self:
        """Start the workers."""
        try:
            for _ in range(self._count):
                self._start()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Terminate the workers, whatever they are doing."""
        self._end()

    def results(self, items: Sequence[_T], meanwhile: Callable[[], None] | None = None) -> Iterator[tuple[_T, _R]]:
        """Yield each item with its result, as they come.

        Args:
            items: what to work on.
            meanwhile: function that is called once the workers have begun; None for none.

        """
        waiting, later = deque(items), deque[tuple[float, _T]]()
        deaths: Counter[_T] = Counter()
        while waiting or later or self._is_busy:
            while later and later[0][0] <= time.monotonic():
                waiting.append(later.popleft()[1])
            self._give(waiting)
            if meanwhile is not None:
                meanwhile()
                meanwhile = None
            for item, answer in self._answers(_BETWEEN_TRIES if later else None):
                if isinstance(answer, _Died):
                    deaths[item] += 1
                    if deaths[item] == 1:
                        self._say(f"{item}: the worker was ended before it had a result; another one begins it again")
                        waiting.appendleft(item)
                    else:
                        yield item, self._lost(item)
                elif answer is None:
                    later.append((time.monotonic() + _BETWEEN_TRIES, item))
                else:
                    yield item, answer

    @property
    def _is_busy(self) -> bool:
        """Whether a worker has something to do."""
        return any(item is not None for item in self._busy.values())

    def _give(self, waiting: deque[_T]) -> None:
        """Give items to the idle workers."""
        for connection in [each for each, item in self._busy.items() if item is None]:
            if not waiting:
                return
            try:
                connection.send(waiting[0])
            except OSError:  # it has just ended
                self._replace(connection)
            else:
                self._busy[connection] = waiting.popleft()

    def _answers(self, timeout: float | None) -> Iterator[tuple[_T, _R | _Died | None]]:
        """Yield what the workers answer within some seconds, with None as soon as one does."""
        for connection in wait(list(self._busy), timeout):
            assert isinstance(connection, Connection)  # noqa: S101 - wait is also for other things
            item = self._busy[connection]
            try:
                fine, answer = connection.recv()
            except (EOFError, OSError):
                self._replace(connection)
                if item is not None:
                    yield item, _Died()
                continue
            self._busy[connection] = None
            if not fine:
                raise answer
            if item is not None:
                yield item, answer

    def _start(self) -> None:
        """Start a worker."""
        context = multiprocessing.get_context("fork")
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there, os.getpid(), self._work), daemon=True)
        with interruption.starting_workers(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads: those of this process sleep
            process.start()
        there.close()
        self._processes[here], self._busy[here] = process, None

    def _replace(self, connection: Connection) -> None:
        """Start a worker in place of one that ended."""
        self._busy.pop(connection)
        process = self._processes.pop(connection)
        connection.close()
        process.kill()
        process.join()
        self._start()

    def _end(self) -> None:
        """Terminate the workers."""
        for process in self._processes.values():
            process.terminate()
        waits = interruption.is_ctrl_c()
        with interruption.deferred(lambda: interruption.MESSAGE) if waits else contextlib.nullcontext():
            for connection, process in self._processes.items():
                process.join(None if waits else _SECONDS_TO_END)  # for the step that it is at
                process.kill()  # whatever kept it from ending
                process.join()
                connection.close()
        self._processes, self._busy = {}, {}


def _serve(connection: Connection, parent: int, work: Callable[[Any], Any]) -> None:
    """Work on items in a worker, until it is terminated."""
    interruption.end_with(parent)
    while True:
        item = connection.recv()
        try:
            answer = (True, work(item))
        except KeyboardInterrupt:  # SIGTERM came while the work noted signals, to save what it has
            return
        except Exception as error:
            answer = (False, error)
        connection.send(answer)
