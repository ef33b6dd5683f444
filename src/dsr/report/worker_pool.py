"""The calls that draw and encode the parts of a report, in this process or in several."""

import contextlib
import os
from collections.abc import Callable, Generator, Sequence
from copy import copy
from typing import TypeVar

from dsr.evaluation.results import Results
from dsr.utils.processes import Pool
from dsr.utils.progress import SILENT

_Item = TypeVar("_Item")
_Value = TypeVar("_Value")


class WorkerPool(contextlib.ExitStack):
    """Calls functions whose first argument is the results, which each worker process gets once; 1 worker for none."""

    def __init__(self, results: Results, workers: int = 1, say: Callable[[str], None] = SILENT.say) -> None:
        super().__init__()
        self.results = results
        self._pool: Pool | None = None
        if workers > 1:
            threads = max(1, (os.cpu_count() or 1) // workers)
            self._pool = self.enter_context(Pool(workers, copy, (results,), threads, say))

    def map(self, function: Callable[[Results, _Item], _Value], items: Sequence[_Item]) -> Generator[_Value]:
        """Return what a module's function returns for the results and each item, in order; workers begin at once."""
        if self._pool is None:
            return (function(self.results, item) for item in items)
        return (value for _, value in self._pool.results(function, items, ordered=True))
