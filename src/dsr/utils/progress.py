"""How work that takes long reports its progress.

Library code takes a :class:`Progress`, which shows nothing by itself; commands pass the one on the console, see
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
            done: amount of work done; less than before where the work starts again.
            total: amount of all work; None where it is as before, or not known.
            remark: short text shown beside the numbers; None for the one before.

        """
        ...


class Progress:
    """Shows nothing; the base of what shows something."""

    def say(self, line: str) -> None:
        """Show a line of text."""

    def task(
        self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items"
    ) -> contextlib.AbstractContextManager[Task]:
        """Return a context in which a piece of work is shown, below the one that is already under way.

        Args:
            name: what is done, such as ``train``.
            total: amount of all work; None where it is not known yet.
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
            lines: whether each item gets a line where the output is no terminal; False where the caller prints one.

        """
        yield from items


SILENT = Progress()


class StepsProgress(Progress):
    """Reports the steps of the outermost task to a function, and nothing else.

    Args:
        steps: is called with the number of steps done and their total, at the end with both the same; None for nothing.

    """

    def __init__(self, steps: Steps | None) -> None:
        self._steps, self._busy = steps, False

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        """Return a context in which the steps of a task are reported, unless it is part of another."""
        steps, whole = self._steps, total or 0
        if steps is None or self._busy:
            yield _ignore
            return

        def report(done: int, total: int | None = None, remark: str | None = None) -> None:
            steps(done, total or whole)

        self._busy = True
        try:
            yield report
        finally:
            self._busy = False
        steps(whole, whole)


def part_of(progress: Steps | None, before: int, total: int) -> Steps | None:
    """Return what one of several stages reports its steps to.

    Args:
        progress: what the whole is reported to; None for nothing.
        before: number of steps of the stages before.
        total: number of steps of all stages.

    """
    return None if progress is None else lambda done, _: progress(before + done, total)


def _ignore(done: int, total: int | None = None, remark: str | None = None) -> None:
    """Report nothing."""
