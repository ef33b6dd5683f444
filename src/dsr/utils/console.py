"""Exit codes, the console and the progress display of all commands."""

import contextlib
import errno
import functools
import io
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from unicodedata import category

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, TextColumn
from rich.progress import Progress as Bars
from rich.progress import Task as Bar
from rich.text import Text

from dsr.utils.progress import Item, Progress, Task, Unit, clock, megabytes

USAGE_ERROR = 2
_OUTPUT = {errno.ENOSPC, errno.EPIPE}  # errors without a file's name that are those of printing
_LONGEST = 1000  # characters of an error's line
_TURNING = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # characters that turn the direction of text
_LOG_WIDTH = 110  # columns where the output is not a terminal
_FIRST_LINE, _NEXT_LINE = 3.0, 10.0  # seconds until the first line about running work, and between two of them
_MANY, _LONG = 50, 2.0  # of more items only those get a line that take so many seconds


def open_console() -> Console:
    """Return a console on stdout, wide enough for tables if that is not a terminal."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files may be no text
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
    """Return a text without the characters that control a terminal or turn text, which names of files may have."""
    return "".join(
        "\N{REPLACEMENT CHARACTER}" if (category(each) == "Cc" and each != "\n") or each in _TURNING else each
        for each in text
    )


def one_line(error: BaseException) -> str:
    """Return an error's message on one line."""
    if isinstance(error, OSError) and error.filename is None and error.errno in _OUTPUT:
        return f"standard output: expected to be writable, got: {error.strerror}"
    return shorten(printable(" ".join(str(error).split()))) or type(error).__name__


class ConsoleProgress(Progress):
    """Shows progress: bars on a terminal, elsewhere lines, of finished items, and of running work every ten seconds."""

    def __init__(self, console: Console, now: Callable[[], float] = time.monotonic) -> None:
        self._console, self._now, self._next_line = console, now, 0.0
        self._state = _State()
        self._bars = Bars(
            TextColumn("{task.description:<8}", markup=False),
            BarColumn(24),
            self._state,
            console=console,
            transient=True,
            get_time=now,
            disable=console.quiet or not console.is_terminal,
        )

    def say(self, line: str) -> None:
        """Show a line of text, above the bars if there are any."""
        show(self._console, line)

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        """Return a context in which a piece of work is shown; see :class:`dsr.utils.progress.Progress`."""
        if not self._bars.tasks:
            self._bars.start()
            self._next_line = self._now() + _FIRST_LINE
        self._bars.add_task(
            name, total=total, completed=done, visible=total is not None, unit=unit, remark="", before=done
        )
        bar, counted = self._bars.tasks[-1], unit == "items"

        def report(done: int, total: int | None = None, remark: str | None = None) -> None:
            nonlocal counted
            if not counted or done < bar.completed:  # a download first reports the bytes that were there before
                bar.fields["before"], counted = done, True
            bar.fields["remark"] = bar.fields["remark"] if remark is None else remark
            bar.total, bar.completed, bar.visible = bar.total if total is None else total, done, True
            now = self._now()
            if not self._console.is_terminal and done != bar.total and now >= self._next_line:
                self._next_line = now + _NEXT_LINE
                bars = [each for each in self._bars.tasks if each.visible]
                outer = (f"{_name_of(each)} ({_amount_and_times(each)[0]}): " for each in bars[: bars.index(bar)])
                self.say(f"{''.join(outer)}{name}: {self._state.render(bar).plain}")

        try:
            yield report
        finally:
            self._bars.remove_task(bar.id)
            if not self._bars.tasks:
                self._bars.stop()

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
        """Yield items, and show how many are done; see :class:`dsr.utils.progress.Progress`."""
        if total is None:
            items = list(items)
            total = len(items)
        with self.task(name, total, done=done) as task:
            bar, before = self._bars.tasks[-1], self._now()
            for number, item in enumerate(items, done):
                task(number, remark=label(item))
                yield item
                now = self._now()
                worthwhile = total <= _MANY or number + 1 == total or now - before >= _LONG
                told = lines and not self._console.is_terminal and worthwhile
                self._next_line = now + _NEXT_LINE if told else self._next_line
                task(number + 1)
                if told:
                    amount, times = _amount_and_times(bar)
                    self.say(f"{_name_of(bar)}: {', '.join((amount, f'{now - before:.1f} s', *times))}")
                before = now
        if lines and self._console.is_terminal and (bar.elapsed or 0) >= _LONG:
            amount, times = _amount_and_times(bar)
            self.say(f"{name}: {amount}, {times[0]}")


class _State(ProgressColumn):
    """The amount, the named times and the remark of a task."""

    def render(self, task: Bar) -> Text:
        amount, times = _amount_and_times(task)
        return Text(", ".join(filter(None, (amount, *times, task.fields["remark"]))), no_wrap=True)


def _name_of(bar: Bar) -> str:
    return f"{bar.description} {bar.fields['remark']}".rstrip()


def _amount_and_times(bar: Bar) -> tuple[str, list[str]]:
    """Return the amount done, of bytes with the speed, and the elapsed and, if it is known, the remaining time."""
    elapsed, left, of_bytes = bar.elapsed or 0.0, bar.remaining, bar.fields["unit"] == "bytes"
    speed = (bar.completed - bar.fields["before"]) / elapsed if elapsed else 0.0
    amount = " of ".join(
        megabytes(size) if of_bytes else f"{size:.0f}" for size in (bar.completed, bar.total) if size is not None
    )
    if of_bytes and speed:
        amount += f", {megabytes(speed)}/s"
    remaining = [f"remaining {clock(left / speed)}"] if left is not None and speed else []
    return amount, [f"elapsed {clock(elapsed)}", *remaining]
