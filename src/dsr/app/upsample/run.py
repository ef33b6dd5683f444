"""The command behind ``dsr upsample``: read the user's files, and write a folder of results for each picture."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from dsr.app.upsample.reporting import Reporter, listed
from dsr.app.upsample.request import UpsampleRequest
from dsr.app.upsample.scene import write_scene
from dsr.app.upsample.workers import work_through
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import PairingResult, add_confidence, find_pairs_of_lists
from dsr.utils.console import ConsoleProgress, show


def run(request: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all pictures of a request.

    Args:
        request: the request.
        console: where progress and assumptions are shown.

    Returns:
        The problems, one line each; empty if there were none.

    Raises:
        ValueError: the pairs cannot be determined.

    """
    found = _find(request)
    if request.confidence:
        found = replace(found, pairs=add_confidence(found.pairs, request.confidence))
    single = len(found.pairs) == 1 and not request.folders and not request.rgb[0].is_dir()
    _show_found(console, found)
    reporter, progress = Reporter(console), ConsoleProgress(console)
    jobs = [(pair, request.output if single else request.output / pair.name) for pair in found.pairs]
    problems: dict[str, list[str]] = {}
    outcomes: Counter[str] = Counter()
    targets: dict[str, Path] = {}
    scene_problems: list[str] = []
    for done in work_through(request, jobs, reporter, progress):
        if done.problem is None:
            outcomes[done.outcome] += 1
            targets[done.pair.name] = done.target
        else:
            problems.setdefault(done.problem, []).append(done.pair.name)
    if targets and request.scene_parts and not request.dry_run:
        scene = write_scene(request.output, targets, request.scene_parts, overwrite=request.overwrite)
        for part, path in scene.files.items():
            reporter.say(f"{part}: {len(targets)} frames -> {path}")
        scene_problems = scene.problems
    if not single:
        reporter.summary(outcomes["done"] + outcomes["to do"])
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        pictures = "1 picture" if len(found.pairs) == 1 else f"{len(found.pairs)} pictures"
        show(console, f"{pictures}: {', '.join(counts)} -> {request.output}")
    lines = [f"{listed(names)}: {message}" if len(found.pairs) > 1 else message for message, names in problems.items()]
    return lines + scene_problems


def _find(request: UpsampleRequest) -> PairingResult:
    """Return the pairs."""
    if not request.folders:
        return find_pairs_of_lists(request.rgb, request.depth, request.mask)
    parts = [find_pairs_of_folder(folder, request.output) for folder in request.folders]
    if len(parts) == 1:
        return parts[0]
    pairs = [
        replace(pair, name=f"{folder.resolve().name}/{pair.name}")
        for folder, part in zip(request.folders, parts, strict=True)
        for pair in part.pairs
    ]
    if len({pair.name for pair in pairs}) < len(pairs):
        raise ValueError("expected folders of different names; give those of one name in commands of their own")
    facts = tuple(dict.fromkeys(fact for part in parts for fact in part.assumptions))
    return PairingResult(tuple(pairs), facts, tuple(path for part in parts for path in part.unpaired))


def _show_found(console: Console, found: PairingResult) -> None:
    """Show how many pairs there are, and which files have no partner."""
    count = len(found.pairs)
    lines = [
        f"{count} pairs of photo and depth map" if count > 1 else f"{found.pairs[0].rgb} and {found.pairs[0].depth}"
    ]
    lines += [f"  {fact}" for fact in found.assumptions]
    if found.unpaired:
        lines.append(
            f"  {len(found.unpaired)} without a partner, left out: {listed([path.name for path in found.unpaired])}"
        )
    for line in lines:
        show(console, line)
