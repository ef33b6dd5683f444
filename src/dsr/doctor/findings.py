"""Findings of the checks of ``dsr doctor``, and how they are printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

from rich.console import Console
from rich.table import Table
from rich.text import Text

Level = Literal["ok", "note", "warning", "problem"]
LEVELS: tuple[Level, ...] = get_args(Level)  # from the best to the worst; from a warning on something is probably wrong
FINE, FAULTY = 0, 1  # exit codes
_COLOURS: dict[Level, str] = {"ok": "green", "note": "cyan", "warning": "yellow", "problem": "bold red"}


class Finding(NamedTuple):
    """A finding of one check: how bad it is, the measured values with units, and a recommended action, if any."""

    check: str
    level: Level
    message: str
    advice: str = ""


def worst(findings: Sequence[Finding]) -> Level:
    """Return the worst level; ``ok`` without findings."""
    return max((finding.level for finding in findings), key=LEVELS.index, default="ok")


def show_findings(console: Console, title: str, findings: Sequence[Finding], *, brief: bool) -> None:
    """Print the verdict and the findings of a scene or a machine; if ``brief``, without those of level ``ok``."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for finding in findings:
        if finding.level != "ok" or not brief:
            grid.add_row(Text(f"  {finding.level}", _COLOURS[finding.level]), finding.check, Text(finding.message))
            if finding.advice:
                grid.add_row("", "", Text(f"-> {finding.advice}", "dim"))
    level, counts = worst(findings), Counter(finding.level for finding in findings)
    parts = [] if level in ("warning", "problem") else ["fine"]
    parts += [f"{counts[each]} {each}{'s' if counts[each] > 1 else ''}" for each in LEVELS[:0:-1] if counts[each]]
    console.print(Text.assemble((title, "bold"), ": ", (", ".join(parts), _COLOURS[level])), soft_wrap=True)
    if grid.row_count:
        console.print(grid)
    if not brief:
        console.print()
