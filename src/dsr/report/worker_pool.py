"""The calls that draw and encode the parts of a report, in this process or in several."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Generator, Sequence
from typing import Any, Self, TypeVar

from dsr.evaluation.results import Results
from dsr.utils.pool import LOST, Pool
from dsr.utils.progress import SILENT

_FEW = 24
"""Number of predictions below which the start of worker processes takes longer than they save."""
_MOST = 8
"""Maximum number of workers unless more are requested; each needs about 0.5 GB."""
_PART = "a part of the report"
_results: Results | None = None
"""The results that this process works on, if it is a worker."""
_Call = tuple[Callable[[Results, Any], Any], Any]
"""A function and its second argument."""
_Item = TypeVar("_Item")
_Value = TypeVar("_Value")


def default_workers(results: Results) -> int:
    """Return the number of worker processes that a report of some results is worth: one per core, or 1 for none."""
    predictions = sum(len(run.scenes) for run in results.runs)
    return 1 if predictions < _FEW else min(os.cpu_count() or 1, _MOST)


class WorkerPool:
    """Calls functions of the results, to use in a ``with`` statement.

    Args:
        results: first argument of all functions; each worker gets it once.
        workers: number of worker processes; 1 for none.
        say: shows a line of text.

    """

    def __init__(self, results: Results, workers: int = 1, say: Callable[[str], None] = SILENT.say) -> None:
        self.results = results
        self._pool: Pool[_Call, tuple[Any]] | None = None
        if workers > 1:
            self._pool = Pool(
                workers,
                _call,
                _lost,
                say,
                start="fork" if sys.platform == "linux" else "spawn",
                prepare=_begin,
                arguments=(results,),
                label=lambda _: _PART,
                threads=max(1, (os.cpu_count() or 1) // workers),
            )

    def map(self, function: Callable[[Results, _Item], _Value], items: Sequence[_Item]) -> Generator[_Value]:
        """Return the values of ``function(results, item)`` in the order of the items.

        Workers begin at once; without them, each call is made when its value is asked for.

        Args:
            function: function of a module, since workers import it.
            items: second arguments.

        Raises:
            ChildProcessError: two workers were ended at the same call; raised with the value.

        """
        if self._pool is None:
            return (function(self.results, item) for item in items)
        calls: list[_Call] = [(function, item) for item in items]
        return (value for _, (value,) in self._pool.results(calls, ordered=True))

    def __enter__(self) -> Self:
        """Return itself."""
        if self._pool is not None:
            self._pool.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """Terminate the workers."""
        if self._pool is not None:
            self._pool.__exit__()


def _begin(results: Results) -> None:
    """Prepare a worker.

    Garbage is collected after each call: Matplotlib makes so many objects that the automatic collections would take a
    third of the time of a figure.
    """
    global _results  # noqa: PLW0603 - the worker's own
    _results = results
    gc.disable()


def _call(call: _Call) -> tuple[Any]:
    """Call a function in a worker; its value may be None."""
    if _results is None:
        raise RuntimeError("this process is no worker of a report")
    function, item = call
    try:
        return (function(_results, item),)
    finally:
        gc.collect()
        gc.freeze()  # what is left stays, such as modules, and is not gone through again


def _lost(_: _Call) -> tuple[Any]:
    """Raise an error for a call whose workers were ended."""
    raise ChildProcessError(f"{_PART}: {LOST}")
