"""Progress of long-running work.

Library code takes a :class:`Progress`, which by itself shows nothing; commands pass the console's, see
:class:`dsr.utils.console.ConsoleProgress`. A method takes :data:`Steps`, a plain function; a :class:`Task` is one.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Literal, Protocol, TypeVar

Steps = Callable[[int, int], object]
"""Is called with the number of steps done and their total."""
Unit = Literal["items", "bytes"]
Item = TypeVar("Item")


class Task(Protocol):
    """A piece of work under way; it is cheap to call in a loop."""

    def __call__(self, done: int, total: int | None = None, remark: str | None = None) -> None:
        """Report how much is done.

        Args:
            done: amount of work done; less than before if the work starts again.
            total: amount of all work; None if unchanged or unknown.
            remark: short text shown beside the numbers; None if unchanged.

        """
        ...


class Progress:
    """Shows nothing; the base class of progress displays."""

    def say(self, line: str) -> None:
        """Show a line of text."""

    def task(
        self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items"
    ) -> contextlib.AbstractContextManager[Task]:
        """Return a context in which a piece of work is shown, below the one that is already under way.

        Args:
            name: what is done, such as ``train``.
            total: amount of all work; None if not yet known.
            done: amount of work done before.
            unit: what the amounts count.

        """
        return contextlib.nullcontext(_ignore)

    def track(
        self,
        items: Iterable[Item],
        name: str,
        total: int | None = None,
        *,
        label: Callable[[Item], str] = str,
        lines: bool = True,
    ) -> Iterator[Item]:
        """Yield items, and show how many are done.

        Args:
            items: things to work on, one after the other.
            name: what is done to them, such as ``predict``.
            total: number of items; None where ``items`` can be counted.
            label: returns the name of an item.
            lines: whether each item gets a line if the output is not a terminal; False if the caller prints one.

        """
        yield from items


SILENT = Progress()


class StepsProgress(Progress):
    """Reports only the steps of the outermost task, to a function.

    Args:
        steps: is called with the number of steps done and their total, at the end with both equal; None for no report.

    """

    def __init__(self, steps: Steps | None) -> None:
        self._steps, self._busy = steps, False

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        """Return a context in which the steps of a task are reported, unless it is part of another."""
        steps, all_steps = self._steps, total or 0
        if steps is None or self._busy:
            yield _ignore
            return

        def report(done: int, total: int | None = None, remark: str | None = None) -> None:
            steps(done, total or all_steps)

        self._busy = True
        try:
            yield report
        finally:
            self._busy = False
        steps(all_steps, all_steps)


def part_of(progress: Steps | None, before: int, total: int) -> Steps | None:
    """Return a function to which one of several stages reports its steps.

    Args:
        progress: the function to which all stages are reported; None for no report.
        before: number of steps of the stages before.
        total: number of steps of all stages.

    """
    return None if progress is None else lambda done, _: progress(before + done, total)


def _ignore(done: int, total: int | None = None, remark: str | None = None) -> None:
    """Report nothing."""
