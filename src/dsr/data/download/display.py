"""How a download goes, on a terminal and off it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from dsr.data.download.checksums import Moved
from dsr.data.download.transfer import megabytes
from dsr.utils.console import show

_LOG_SECONDS = 30.0
"""Between two lines about one download where the output is not a terminal."""


class Display:
    """Bars with speed and time left on a terminal, lines elsewhere; see :class:`dsr.data.download.inventory.Watcher`.

    Args:
        console: where they are shown.

    """

    def __init__(self, console: Console) -> None:
        self._console = console

    def say(self, line: str) -> None:
        """Show a line."""
        show(self._console, line)

    @contextlib.contextmanager
    def transfer(self, name: str) -> Iterator[Moved]:
        """Show how far one file is."""
        if self._console.is_terminal:
            with self._bar(name) as moved:
                yield moved
        else:
            with self._lines(name) as moved:
                yield moved

    @contextlib.contextmanager
    def _bar(self, name: str) -> Iterator[Moved]:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            DownloadColumn(),
            TransferSpeedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self._console, transient=True) as progress:
            task = progress.add_task(name, total=None)
            last = -1

            def moved(done: int, total: int | None) -> None:
                nonlocal last
                if last < 0 or done < last:  # what was there before is no speed
                    progress.reset(task, total=total, completed=done)
                progress.update(task, completed=done, total=total)
                last = done

            yield moved

    @contextlib.contextmanager
    def _lines(self, name: str) -> Iterator[Moved]:
        began = said = time.monotonic()
        first = last = -1

        def moved(done: int, total: int | None) -> None:
            nonlocal said, first, last
            first, last = (done, done) if first < 0 or done < last else (first, done)
            if time.monotonic() - said > _LOG_SECONDS:
                said = time.monotonic()
                speed = (done - first) / (said - began)
                left = f", {(total - done) / speed / 60:.0f} min left" if total and speed else ""
                whole = f" of {megabytes(total)}" if total else ""
                self.say(f"{name}: {megabytes(done)}{whole}, {megabytes(speed)}/s{left}")

        yield moved
