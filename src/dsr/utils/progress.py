"""Progress of long-running work, and times, sizes and lengths as text."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Literal, Protocol, TypeVar

Steps = Callable[[int, int], object]  # is called with the number of steps done and their total
Unit = Literal["items", "bytes"]
Item = TypeVar("Item")


class Task(Protocol):
    """A piece of work under way; it is cheap to call in a loop."""

    def __call__(self, done: int, total: int | None = None, remark: str | None = None) -> None:
        """Report how much is done, of how much, and a short text shown beside the numbers; None if unchanged."""
        ...


class Progress:
    """Shows nothing; the base class of progress displays."""

    def say(self, line: str) -> None:
        """Show a line of text."""

    def task(
        self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items"
    ) -> contextlib.AbstractContextManager[Task]:
        """Return a context in which a piece of work is shown, ``done`` units of which were done before."""
        return contextlib.nullcontext(ignore)

    def track(
        self,
        items: Iterable[Item],
        name: str,
        total: int | None = None,
        *,
        done: int = 0,
        label: Callable[[Item], str] = str,
        lines: bool = True,
    ) -> Iterator[Item]:
        """Yield items, and show how many are done.

        ``total``: of the items, those included that are ``done`` already; None where they can be counted. ``lines``:
        whether each item gets a line if the output is not a terminal; False if the caller prints one.
        """
        yield from items


SILENT = Progress()


class StepsProgress(Progress):
    """Passes the progress of the task ``steps`` on to a function, last with all steps done; None for nothing."""

    def __init__(self, steps: Steps | None) -> None:
        self._steps = steps

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        """Return a context in which the steps of a task are reported."""
        steps, all_steps = self._steps, total or 0
        if steps is None or name != "steps":
            yield ignore
            return

        def report(done: int, total: int | None = None, remark: str | None = None) -> None:
            steps(done, total or all_steps)

        yield report
        steps(all_steps, all_steps)


def part_of(progress: Steps | None, before: int, total: int) -> Steps | None:
    """Return a function to which one of several stages reports its steps."""
    return None if progress is None else lambda done, _: progress(before + done, total)


def ignore(done: int, total: int | None = None, remark: str | None = None) -> None:
    """Report nothing."""


def duration(seconds: float) -> str:
    """Return an estimated time: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def clock(seconds: float) -> str:
    """Return a measured time in hours, minutes and seconds: 0:04:29."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def megabytes(size: float) -> str:
    """Return a number of bytes: 31 kB, 3.2 MB, 45 MB, 1.3 GB."""
    if size < 5e4:
        return f"{size / 1e3:.0f} kB"
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.{0 if size >= 1e7 else 1}f} MB"


def show_length(metres: float, digits: int = 3) -> str:
    """Return a length with significant digits in the unit that suits its size: 12 km, 2.5 m, 8.3 mm, 0.04 mm."""
    metres = float(f"{metres:.{digits}g}")  # so that the unit is that of what is shown
    value, unit = (metres / 1e3, "km") if metres >= 1e3 else (metres, "m") if metres >= 0.1 else (metres * 1e3, "mm")
    return f"{value:.9g} {unit}"
