"""What all commands have in common: exit codes, a console, and lines on it."""

from __future__ import annotations

import sys

from rich.console import Console

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


def print_error(message: str) -> None:
    """Print one line on stderr."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr, flush=True)  # noqa: T201


def one_line(error: BaseException) -> str:
    """Return an error's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__
