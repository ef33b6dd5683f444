"""Worker processes that end with the process that started them, and at Ctrl-C without a word of their own."""

from __future__ import annotations

import os
import signal
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Literal, ParamSpec, TypeVar

from dsr.utils import interruption

_P = ParamSpec("_P")
_T = TypeVar("_T")


class WorkerPool(ProcessPoolExecutor):
    """Worker processes to use in a ``with`` statement, at whose end they are terminated.

    Args:
        count: how many.
        prepare: function that each worker calls once; None for none.
        arguments: its arguments.
        start: ``spawn`` for new interpreters; ``fork`` for processes that share what this one has loaded, which must
            not have computed with several threads before, as these do not survive a fork.

    """

    def __init__(
        self,
        count: int,
        prepare: Callable[..., None] | None = None,
        arguments: Sequence[Any] = (),
        start: Literal["spawn", "fork"] = "spawn",
    ) -> None:
        super().__init__(count, get_context(start), _begin, (os.getpid(), prepare, arguments))

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Let a worker call a function; it is started if none is idle."""
        with interruption.starting_workers(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking with threads: those of this process sleep
            return super().submit(fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Terminate the workers, whatever they are doing."""
        for process in list((self._processes or {}).values()):
            process.terminate()
        self.shutdown(wait=True, cancel_futures=True)


def _begin(parent: int, prepare: Callable[..., None] | None, arguments: Sequence[Any]) -> None:
    """Prepare a worker; if it was forked, it has its parent's handler of SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    interruption.end_with(parent)
    if prepare is not None:
        prepare(*arguments)
