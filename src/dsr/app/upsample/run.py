"""The command behind ``dsr upsample``: read the user's files, and write a folder of results for each picture."""

from __future__ import annotations

import contextlib
import errno
import json
import time
from collections import Counter
from pathlib import Path

from rich.console import Console

from dsr.app.upsample.frames import Frames, find_frames
from dsr.app.upsample.outputs import INFO
from dsr.app.upsample.reporting import Reporter, listed
from dsr.app.upsample.request import UpsampleRequest
from dsr.app.upsample.stored import EXPORTS, read_info, write_scene
from dsr.app.upsample.workers import preview, work_through
from dsr.io.images import pixels_in_header
from dsr.io.inputs import read_geometry
from dsr.io.pairs import Pair
from dsr.io.reading import Shard
from dsr.io.scene_files import expect_poses
from dsr.io.trajectories import USUAL_SIZE, read_poses
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.files import expect_targets, write_text
from dsr.utils.processes import at_work
from dsr.utils.progress import clock, megabytes

_UNPOSED = {
    "gaussian": ": images, depths and depth_params.json are written, and no sparse model; --poses gives one",
    "nerfstudio": ": it stands at the origin",
}
"""What is written of a single frame without a pose, by part."""
_READ_ONLY = (errno.EACCES, errno.EPERM, errno.EROFS)


def run(request: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all pictures of a request.

    Args:
        request: the request.
        console: where progress and assumptions are shown.

    Returns:
        The problems, one line each; empty if there were none.

    Raises:
        ValueError: the pairs cannot be determined, frames lack poses that a part needs, a file would be written outside
            of the folder of results, or a command with other settings is at work in it.
        TargetError: a link, a device, a pipe or a socket is in the place of a file.

    """
    frames = find_frames(request)
    for part in request.results.of_all:
        if part.poses:
            posed = _posed(request, frames)
            expect_poses(part.name, posed)
            if not all(posed.values()):  # a single one
                show(console, f"--with {part.name}: the frame has no pose{_UNPOSED.get(part.name, '')}")
    with contextlib.ExitStack() as stack:
        if not request.results.dry_run:
            try:
                stack.enter_context(at_work(request.results.output, json.dumps(request.settings, sort_keys=True)))
            except OSError as error:
                if error.errno not in _READ_ONLY:  # where all may be complete; what is written says so itself
                    raise
        return _run(request, frames, console)


def _posed(request: UpsampleRequest, frames: Frames) -> dict[str, bool]:
    """Return whether each frame has a pose, of the file, of its capture or of its result; frames that fail count."""
    if request.frames.trajectory is not None:
        given = read_poses(request.frames.trajectory).assign(frames.whole)
        return {pair.name: pair.name in given for pair in frames.whole}

    def posed(pair: Pair) -> bool:
        info = frames.target(request.results.output, pair) / INFO
        try:
            geometry, _ = read_geometry(pair, pixels_in_header(pair.rgb) or USUAL_SIZE, request.reading)
        except (ValueError, OSError):
            return True
        if geometry.pose is not None:
            return True
        try:
            return read_info(info).get("pose") is not None
        except (ValueError, OSError):
            return False

    return {pair.name: posed(pair) for pair in frames.whole}


def _run(request: UpsampleRequest, frames: Frames, console: Console) -> list[str]:
    """Upsample frames, and return the problems."""
    wanted, shard = request.results, request.frames.shard
    started = time.monotonic()
    of_all = [] if shard is not None else [*(name for part in wanted.of_all for name in part.files), EXPORTS]
    expect_targets(wanted.output, of_all if shard is None else [_summary_of(shard)])
    _show_found(console, request, frames)
    found, single = frames.found, frames.single
    reporter, progress = Reporter(console), ConsoleProgress(console)
    problems: dict[str, list[str]] = {}
    outcomes: Counter[str] = Counter()
    targets: dict[str, Path] = {}
    size = 0.0
    scene_problems: list[str] = []
    through = preview if wanted.dry_run else work_through
    for done in through(request, frames, reporter, progress):
        if done.problem is None:
            outcomes[done.outcome] += 1
            targets[done.pair.name] = done.target
            size += done.bytes
        else:
            problems.setdefault(done.problem, []).append(done.pair.name)
    if targets and wanted.of_all and not wanted.dry_run and shard is None:
        scene = write_scene(wanted.output, targets, wanted.of_all, overwrite=wanted.overwrite)
        for part, path in scene.files.items():
            reporter.say(f"{part}: {len(targets)} frames -> {path}")
        scene_problems = scene.problems
    if not single:
        if not wanted.dry_run:
            reporter.summary(outcomes.total())
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        counts = counts or ["nothing to do"]
        pictures = "1 picture" if len(found.pairs) == 1 else f"{len(found.pairs)} pictures"
        took = "" if wanted.dry_run else f" in {clock(time.monotonic() - started)}, {megabytes(size)}"
        show(console, f"{pictures}: {', '.join(counts)}{took} -> {wanted.output}")
    if shard is not None and not wanted.dry_run:
        summary = {
            "shard": str(shard),
            "outcomes": outcomes,
            "failed": [{"problem": problem, "frames": names} for problem, names in problems.items()],
            "warnings": reporter.warnings,
            "seconds": round(time.monotonic() - started, 3),
        }
        write_text(wanted.output / _summary_of(shard), json.dumps(summary, indent=2) + "\n")
    lines = [f"{listed(names)}: {message}" if len(found.pairs) > 1 else message for message, names in problems.items()]
    return lines + scene_problems


def _summary_of(shard: Shard) -> str:
    """Return the name of the summary of a shard."""
    return f"shard-{shard.number}-of-{shard.count}.json"


def _show_found(console: Console, request: UpsampleRequest, frames: Frames) -> None:
    """Show what was found, which files have no partner, and which frames a shard works on."""
    found, total, shard = frames.found, len(frames.whole), request.frames.shard
    named = total == 1 and len(found.pairs) == 1
    lines = [f"{found.pairs[0].rgb} and {found.pairs[0].depth}" if named else f"{total} pairs of photo and depth map"]
    lines += [f"  {fact}" for fact in found.assumptions]
    if found.unpaired:
        lines.append(
            f"  {len(found.unpaired)} without a partner, left out: {listed([path.name for path in found.unpaired])}"
        )
    if shard is not None:
        block = shard.block(total)
        which = f"frames {block.start + 1} to {block.stop}" if block else "no frame"
        lines.append(f"shard {shard}: {which} of {total}")
        if request.results.of_all:
            names = ", ".join(part.name for part in request.results.of_all)
            lines.append(f"  {names}: of all frames, by the same command without --shard")
    for line in lines:
        show(console, line)
