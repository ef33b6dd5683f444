"""Run all checks on scenes and print the findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from dsr.data.detection import find_scenes
from dsr.doctor.camera_checks import check_intrinsics, check_planes, check_registration, check_size
from dsr.doctor.depth_checks import LEVELS, Finding, Level, check_holes, check_precision, check_units, with_depth, worst
from dsr.sample import Scene
from dsr.utils.console import USAGE_ERROR, ConsoleProgress, one_line, open_console, print_error
from dsr.utils.ratios import round_ratio

FINE, FAULTY = 0, 1
CHECKS: tuple[Callable[[Scene], list[Finding]], ...] = (
    check_units,
    check_intrinsics,
    check_registration,
    check_holes,
    check_precision,
    check_planes,
    check_size,
)
_COLOURS: dict[Level, str] = {"ok": "green", "note": "cyan", "warning": "yellow", "problem": "bold red"}
_MANY = 8
"""Number of scenes beyond which checks without a finding are not listed."""


def examine_directory(folder: Path, most: int | None = None) -> int:
    """Examine the scenes of a directory, or a single scene, and print the findings.

    Args:
        folder: directory of any layout that :func:`dsr.data.detection.find_scenes` supports.
        most: maximum number of scenes, taken at equal distances from all; None for all.

    Returns:
        Exit status: 0 without warnings and problems, 1 with warnings or problems, 2, with one line on stderr, if there
        is no scene to examine.

    """
    try:
        scenes = list(find_scenes(folder)) if folder.is_dir() else []
        if not scenes:
            came = "no scene in it" if folder.is_dir() else "no such directory"
            raise ValueError(f"{folder}: expected a scene or a directory of scenes, got {came}")
    except (ValueError, OSError) as error:
        print_error(str(error))
        return USAGE_ERROR
    console = open_console()
    if most is not None and len(scenes) > most:
        console.print(f"{most} of {len(scenes)} scenes, at equal distances", highlight=False)
        scenes = [scenes[index * len(scenes) // most] for index in range(most)]
    verdicts: Counter[Level] = Counter()
    for name, load in ConsoleProgress(console).track(scenes, "examine", label=lambda scene: scene[0], lines=False):
        title, findings = _examine(name, load)
        show_findings(console, title, findings, brief=len(scenes) > _MANY)
        verdicts[worst(findings)] += 1
    console.print(_summary(verdicts), style="bold", highlight=False)
    return FAULTY if verdicts["warning"] or verdicts["problem"] else FINE


def examine(scene: Scene) -> list[Finding]:
    """Run all checks on a scene and return their findings, in the order of :data:`CHECKS`."""
    scene = with_depth(scene)
    return [finding for check in CHECKS for finding in check(scene)]


def _examine(name: str, load: Callable[[], Scene]) -> tuple[str, list[Finding]]:
    """Return a title and the findings of a scene; a failure to load it is a finding."""
    try:
        scene = load()
    except (ValueError, OSError) as error:
        message = f"cannot be read: {one_line(error)}"
        return name, [Finding("files", "problem", message, "correct the file or its description")]
    if scene.depth is None:
        return f"{name} (the map measured at x{round_ratio(min(scene.measured))})", examine(scene)
    return name, examine(scene)


def show_findings(console: Console, title: str, findings: list[Finding], *, brief: bool) -> None:
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
    level = worst(findings)
    console.print(Text.assemble((title, "bold"), ": ", (_verdict(findings), _COLOURS[level])), soft_wrap=True)
    if grid.row_count:
        console.print(grid)
    if not brief:
        console.print()


def _verdict(findings: list[Finding]) -> str:
    """Return the number of findings of a scene by level."""
    counts = Counter(finding.level for finding in findings)
    parts = [f"{counts[level]} {level}{'s' if counts[level] > 1 else ''}" for level in LEVELS[:0:-1] if counts[level]]
    if worst(findings) in ("warning", "problem"):
        return ", ".join(parts)
    return ", ".join(["fine", *parts])


def _summary(verdicts: Counter[Level]) -> str:
    """Return the number of scenes by verdict."""
    total, fine = sum(verdicts.values()), verdicts["ok"] + verdicts["note"]
    parts = [f"{fine} fine"] if fine else []
    parts += [f"{verdicts[level]} with {level}s" for level in ("warning", "problem") if verdicts[level]]
    return f"{total} scene{'s' if total > 1 else ''}: {', '.join(parts)}"
