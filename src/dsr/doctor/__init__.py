"""``dsr doctor``: checks of what is installed, and of scenes' depth maps and cameras, with advice."""

import platform
import shutil
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from rich.console import Console
from rich.table import Table
from rich.text import Text

import dsr
from dsr.methods import weights
from dsr.utils.versions import RESULTS, package_versions

Level = Literal["ok", "note", "warning", "problem"]
LEVELS: tuple[Level, ...] = get_args(Level)  # from the best to the worst; from a warning on something is probably wrong
_COLOURS: dict[Level, str] = {"ok": "green", "note": "cyan", "warning": "yellow", "problem": "bold red"}


class Finding(NamedTuple):
    """A finding of one check: how bad it is, the measured values with units, and a recommended action, if any."""

    check: str
    level: Level
    message: str
    advice: str = ""


def show_findings(console: Console, title: str, findings: Sequence[Finding], *, brief: bool) -> Level:
    """Print a title and its findings, if ``brief`` without those of level ``ok``; return the worst level."""
    grid = Table.grid(padding=(0, 2))
    for wraps in (False, False, True):
        grid.add_column(no_wrap=not wraps, overflow="fold")
    for finding in findings:
        if finding.level != "ok" or not brief:
            grid.add_row(Text(f"  {finding.level}", _COLOURS[finding.level]), finding.check, Text(finding.message))
            if finding.advice:
                grid.add_row("", "", Text(f"-> {finding.advice}", "dim"))
    counts = Counter(finding.level for finding in findings)
    worst: Level = max(counts, key=LEVELS.index) if counts else "ok"
    parts = [] if worst in ("warning", "problem") else ["fine"]
    parts += [f"{counts[each]} {each}{'s' if counts[each] > 1 else ''}" for each in LEVELS[:0:-1] if counts[each]]
    console.print(Text.assemble((title, "bold"), ": ", (", ".join(parts), _COLOURS[worst])), soft_wrap=True)
    if grid.row_count:
        console.print(grid)
    if not brief:
        console.print()
    return worst


def version_lines() -> list[str]:
    """Return the lines for an error report: versions of dsr, Python, torch and the weights, and the device."""
    torch = package_versions(["torch"])["torch"]
    return [
        f"dsr {dsr.__version__}, results {RESULTS}, weights {weights.version()}",
        f"Python {platform.python_version()}, torch {torch}, {platform.platform()}",
        f"device: {', '.join(graphics_cards()) or processor()}",
    ]


def graphics_cards() -> list[str]:
    """Return the names of NVIDIA's graphics cards as the driver reports them, whether or not torch can use them."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    command = [program, "--query-gpu=name", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.strip() for line in done.stdout.splitlines() if line.strip()]


def processor() -> str:
    """Return the name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text("utf-8", "replace").splitlines() if path.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())
