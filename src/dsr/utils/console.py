"""What all commands have in common: exit codes, a console, lines and bars on it."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

USAGE_ERROR = 2
INTERRUPTED = 130
_LOG_WIDTH = 110
"""Columns where the output is not a terminal."""


def open_console() -> Console:
    """Return a console on stdout, wide enough for tables where that is no terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=_LOG_WIDTH)


def show(console: Console, line: str) -> None:
    """Show a line as it is."""
    console.print(line, markup=False, highlight=False, soft_wrap=True)


def bar(console: Console, *, transient: bool = False) -> Progress:
    """Return a bar of a name, how much of how much, the time passed and left, and a remark; on a terminal only.

    Args:
        console: where it is shown.
        transient: whether it goes away at the end.

    """
    columns = (
        TextColumn("{task.description:<8}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(elapsed_when_finished=False),
        TextColumn("{task.fields[remark]}", markup=False),
    )
    return Progress(*columns, console=console, transient=transient, disable=not console.is_terminal)


def print_error(message: str) -> None:
    """Print one line on stderr."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr, flush=True)  # noqa: T201


def one_line(error: BaseException) -> str:
    """Return an error's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__
