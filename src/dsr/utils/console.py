"""Exit codes, the console and the progress display of all commands."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from unicodedata import category

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from dsr.utils.progress import Item, Progress, Unit, clock, megabytes

USAGE_ERROR = 2
_OUTPUT = {errno.ENOSPC, errno.EPIPE}
"""Errors without a file's name that are those of printing, as a file without space raises FullDiskError."""
_LONGEST = 1000
"""Most characters of an error's line."""
_TURNING = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
"""Characters that turn the direction of text, so that the name of a file reads as another."""
_LOG_WIDTH = 110
"""Columns where the output is not a terminal."""
_FIRST_LINE, _NEXT_LINE = 3.0, 10.0
"""Seconds until the first line about running work, and between two such lines, if the output is not a terminal."""
_TICK = 0.5
_MANY = 50
"""Largest number of items that each get a line, if the output is not a terminal."""
_TELLING = 0.25
"""Smallest share of the time of an item from which the time of the rest is estimated."""
_LONG = 2.0
"""Smallest duration in seconds of an item among many that gets a line, and of a pass over items that gets a line on a
terminal."""


_CREDENTIALS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*://)(?:[^\s/]*|\S*:\S*)@")
"""An address up to its host; a password may have a slash or an @ that should be written %2F and %40."""


def open_console() -> Console:
    """Return a console on stdout, wide enough for tables if that is not a terminal.

    What stdout cannot encode, such as the name of a file that is no text, is shown with escapes.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    console = Console()
    return console if console.is_terminal else Console(width=_LOG_WIDTH)


def show(console: Console, line: str) -> None:
    """Show a line without markup or highlighting."""
    console.print(printable(line), markup=False, highlight=False, soft_wrap=True)


def print_error(message: str) -> None:
    """Print one line on stderr; of a very long message the beginning, which names the file or key, and the end."""
    print(shorten(f"error: {printable(' '.join(message.split()))}"), file=sys.stderr, flush=True)  # noqa: T201


@functools.cache
def note_once(note: str) -> None:
    """Print a note on stderr, once in a process."""
    print(f"note: {printable(note)}", file=sys.stderr)  # noqa: T201


def shorten(text: str, most: int = _LONGEST) -> str:
    """Return a text of at most ``most`` characters: three quarters from its beginning and the rest from its end."""
    if len(text) <= most:
        return text
    first = 3 * most // 4
    return f"{text[:first]} ... {text[len(text) - (most - first - 5) :]}"


def printable(text: str) -> str:
    """Return a text in the form in which commands print texts.

    It is without the characters that control a terminal or turn text, which names of files may have, and without the
    names and passwords of addresses, see :func:`without_credentials`.
    """
    return "".join(
        "\N{REPLACEMENT CHARACTER}" if (category(each) == "Cc" and each != "\n") or each in _TURNING else each
        for each in without_credentials(text)
    )


def without_credentials(text: str) -> str:
    """Return a text with its addresses as ``https://host/path`` instead of ``https://name:password@host/path``."""
    return _CREDENTIALS.sub(r"\1", text)


def one_line(error: BaseException) -> str:
    """Return an error's message on one line."""
    if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT:
        return f"standard output: expected to be writable, got: {error.strerror}"
    return shorten(printable(" ".join(str(error).split()))) or type(error).__name__


class ConsoleProgress(Progress):
    """Shows progress with named times: bars on a terminal, elsewhere plain lines.

    If the output is not a terminal, each finished item gets a line, and running work gets one every ten seconds. In a
    process that is forked from the one that made it, only lines of text are shown.

    Args:
        console: where it is shown.
        now: returns the time in seconds.
        since: time from which the outermost tasks count as under way; None for their own beginning.

    """

    def __init__(self, console: Console, now: Callable[[], float] = time.monotonic, since: float | None = None) -> None:
        self._console, self._now, self._since, self._process = console, now, since, os.getpid()
        self._tasks: list[_ConsoleTask] = []  # from the outermost to the innermost
        self._next_line = 0.0

    def say(self, line: str) -> None:
        """Show a line of text, above the bars if there are any."""
        show(self._console if os.getpid() == self._process else open_console(), line)

    @contextlib.contextmanager
    def task(
        self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items"
    ) -> Iterator[_ConsoleTask]:
        """Return a context in which a piece of work is shown; see :class:`dsr.utils.progress.Progress`."""
        task = _ConsoleTask(name, total, done, unit, self._now, self._tasks)
        if os.getpid() != self._process:
            yield task
            return
        outermost = not self._tasks
        if outermost and self._since is not None:
            task.started = self._since
        self._tasks.append(task)
        try:
            with self._display() if outermost else contextlib.nullcontext():
                yield task
        finally:
            self._tasks.remove(task)

    def track(
        self,
        items: Iterable[Item],
        name: str,
        total: int | None = None,
        *,
        label: Callable[[Item], str] = str,
        lines: bool = True,
        shares: Mapping[str, float] | None = None,
    ) -> Iterator[Item]:
        """Yield items, and show how many are done; see :class:`dsr.utils.progress.Progress`."""
        if total is None:
            items = list(items)
            total = len(items)
        with self.task(name, total) as task:
            task.shares = dict(shares or {})
            before = self._now()
            for done, item in enumerate(items):
                task(done, remark=label(item))
                yield item
                task(done + 1)
                now = self._now()
                if lines and not self._console.is_terminal:
                    self._show_item(task, now - before)
                before = now
        if lines and self._console.is_terminal and task.elapsed >= _LONG:
            self.say(f"{name}: {task.amount}, elapsed {clock(task.elapsed)}")

    def stage(self, name: str, seconds: float | None = None) -> None:
        """Say that an item begins a stage; see :class:`dsr.utils.progress.Progress`."""
        if self._tasks and os.getpid() == self._process:
            self._tasks[-1].begin(name, seconds)

    def tick(self) -> None:
        """Print a line about running work if one is due and the output is not a terminal."""
        tasks = [task for task in tuple(self._tasks) if task.is_shown]
        if not tasks or tasks[-1].done == tasks[-1].total or self._now() < self._next_line:
            return
        self._next_line = self._now() + _NEXT_LINE
        self.say(": ".join([*(outer.heading for outer in tasks[:-1]), tasks[-1].line]))

    def _show_item(self, task: _ConsoleTask, seconds: float) -> None:
        """Print a line about a finished item, unless it is one of many short ones."""
        if task.total is not None and (task.total <= _MANY or task.done == task.total or seconds >= _LONG):
            self._next_line = self._now() + _NEXT_LINE
            self.say(f"{task.name} {task.remark}: {task.amount}, {seconds:.1f} s, {', '.join(task.times)}")

    def _display(self) -> contextlib.AbstractContextManager[object]:
        """Return a context in which the tasks are shown."""
        if self._console.is_terminal:
            return Live(console=self._console, get_renderable=self._table, transient=True, refresh_per_second=8)
        self._next_line = self._now() + _FIRST_LINE
        return self._ticking()

    @contextlib.contextmanager
    def _ticking(self) -> Iterator[None]:
        """Call :meth:`tick` from a thread, so that there are lines however long a step takes."""
        ended = threading.Event()

        def run() -> None:
            with contextlib.suppress(OSError):  # the main thread meets a full disk, too
                while not ended.wait(_TICK):
                    self.tick()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _table(self) -> Table:
        """Return a row with a bar for each task."""
        grid = Table.grid(padding=(0, 1))
        for task in tuple(self._tasks):
            if task.is_shown:
                bar = ProgressBar(task.total, task.done, width=24, pulse=task.total is None)
                elapsed, remaining = (*task.times, "remaining -:--:--")[:2]
                cells = (f"{task.name:<8}", bar, task.amount, elapsed, remaining, task.remark)
                grid.add_row(*(Text(cell, no_wrap=True) if isinstance(cell, str) else cell for cell in cells))
        return grid


class _ConsoleTask:
    """A piece of work under way, with its times.

    What is left is estimated from the units that are done, and for this one from the task within it or the stages
    that it goes through. It is never less than a second, or a tenth of what the unit at hand has taken beyond
    expectation, until all is done.
    """

    def __init__(
        self, name: str, total: int | None, done: int, unit: Unit, now: Callable[[], float], tasks: list[_ConsoleTask]
    ) -> None:
        self.name, self.total, self.done, self.remark = name, total, done, ""
        self.shares: dict[str, float] = {}
        self._unit, self._now, self._tasks = unit, now, tasks
        self.started = self._measured = self._updated = now()
        self._before: int | None = (
            done if unit == "items" else None
        )  # a download first reports the bytes that were there before
        self._stage, self._began, self._guess = "", 0.0, None  # type: str, float, float | None
        self._spent: dict[str, float] = {}  # by the stages of the item at hand that are over; 0 if left out
        self._items: list[dict[str, float]] = []

    def __call__(self, done: int, total: int | None = None, remark: str | None = None) -> None:
        """Report how much is done; see :class:`dsr.utils.progress.Task`."""
        self._updated = self._now()
        if self._before is None or done < self.done:
            self._before, self._measured = done, self._updated
        if done > self.done and self._stage:
            self.begin("")
            if self.shares.keys() <= self._spent.keys():  # the time of one that failed is of no use
                self._items.append(self._spent)
            self._spent = {}
        self.done = done
        if total is not None:
            self.total = total
        if remark is not None:
            self.remark = remark

    def begin(self, stage: str, seconds: float | None = None) -> None:
        """Begin a stage; see :meth:`dsr.utils.progress.Progress.stage`."""
        now = self._now()
        if self._stage:
            took = 0.0 if self._guess == 0 else now - self._began
            self._spent[self._stage] = self._spent.get(self._stage, 0.0) + took
        self._stage, self._began, self._guess = stage, now, seconds

    @property
    def is_shown(self) -> bool:
        """Whether the task is shown: not before it has a total or has reported progress."""
        return self.total is not None or self.done > 0

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return self._now() - self.started

    @property
    def remaining(self) -> float | None:
        """Seconds to the end; None if unknown."""
        if self.total is None:
            return None
        left = self.total - self.done
        if left <= 0:
            return 0.0 if self._speed else None
        at_hand, each = self._times_of_item()
        if each is None:
            return None
        waited = self._now() - self._updated
        if at_hand is None:
            at_hand = _left(each, waited)
        return max(at_hand + (left - 1) * each, 1.0)

    def _times_of_item(self) -> tuple[float | None, float | None]:
        """Return the seconds that are left for the unit at hand, and those of a whole one; None if unknown."""
        usual = self._expected(None) if self._items else None
        each = sum(usual.values()) if usual else 1 / self._speed if self._speed else None
        tasks = tuple(self._tasks)
        inner = tasks[tasks.index(self) + 1 :] if self in tasks else ()
        within = (inner[0].remaining or None) if inner else None  # None if its steps are over, and it is not
        if not self._stage:
            return within, each or (None if within is None else self._now() - self._updated + within)
        waited = self._now() - self._began
        guess = self._guess and waited + _left(self._guess, waited)  # later stages take longer, too
        expected = self._expected(guess if within is None else waited + within)
        if expected is None:
            return None, None
        names = list(self.shares)
        rest = _left(expected[self._stage], waited) if within is None else within
        return rest + sum(expected[name] for name in names[names.index(self._stage) + 1 :]), sum(expected.values())

    def _expected(self, seconds: float | None) -> dict[str, float] | None:
        """Return the seconds of each stage, by the items that are done, else by the one at hand and the usual shares.

        Args:
            seconds: of the stage at hand; None if unknown.

        Items that left a stage out do not count in its mean, which is 0 if all items left it out.

        """
        done = self._items[1:] or self._items  # the first one also loads what all need
        if done:
            taken = {name: [item[name] for item in done if item[name]] for name in self.shares}
            return {name: sum(each) / max(len(each), 1) for name, each in taken.items()}
        known = {self._stage: seconds} if seconds else {name: took for name, took in self._spent.items() if took}
        share = sum(self.shares[name] for name in known)
        if share < _TELLING:
            return None
        whole = sum(known.values()) / share
        return {name: known.get(name, whole * part) for name, part in self.shares.items()}

    @property
    def amount(self) -> str:
        """The amount done and the total."""
        if self._unit == "items":
            return f"{self.done}" if self.total is None else f"{self.done} of {self.total}"
        total = "" if self.total is None else f" of {megabytes(self.total)}"
        return f"{megabytes(self.done)}{total}" + (f", {megabytes(self._speed)}/s" if self._speed else "")

    @property
    def times(self) -> tuple[str, ...]:
        """The named times."""
        remaining = self.remaining
        return (f"elapsed {clock(self.elapsed)}", *([] if remaining is None else [f"remaining {clock(remaining)}"]))

    @property
    def heading(self) -> str:
        """The task with its amount and remaining time, as the beginning of a line about a part of it."""
        about = ", ".join((self.amount, *self.times[1:]))
        return f"{self.name} {self.remark} ({about})" if self.remark else f"{self.name} ({about})"

    @property
    def line(self) -> str:
        """The task's state in one line."""
        return f"{self.name}: {', '.join(filter(None, (self.amount, *self.times, self.remark)))}"

    @property
    def _speed(self) -> float:
        """Amount per second, 0 if unknown."""
        passed = self._updated - self._measured
        return 0.0 if self._before is None or passed <= 0 else (self.done - self._before) / passed


def _left(expected: float, waited: float) -> float:
    """Return the seconds that are left: what was expected, or a tenth of what it takes longer."""
    return max(expected - waited, 0.1 * (waited - expected))
