"""The command behind ``dsr upsample``: read the user's files, and write a folder of results for each picture."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from dsr.app.upsample.frame import Done, FrameWork, Message, Tell
from dsr.app.upsample.frames import Frames, find_frames
from dsr.app.upsample.request import UpsampleRequest
from dsr.app.upsample.stored import EXPORTS, read_complete, write_scene
from dsr.io.images import pixels_in_header
from dsr.io.inputs import read_geometry
from dsr.io.pairs import Pair
from dsr.io.reading import Shard
from dsr.io.scene_files import expect_poses
from dsr.io.trajectories import USUAL_SIZE, read_poses
from dsr.notes import Assumption
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.files import expect_targets, write_text
from dsr.utils.processes import Pool, at_work
from dsr.utils.progress import Progress, clock, megabytes

_UNPOSED = {  # what is written of a single frame without a pose, by part
    "gaussian": ": images, depths and depth_params.json are written, and no sparse model; --poses gives one",
    "nerfstudio": ": it stands at the origin",
}
_READ_ONLY = (errno.EACCES, errno.EPERM, errno.EROFS)
_SHOWN = 5  # number of names that a line lists; further ones are only counted
_work: FrameWork | None = None  # of this process, if it is a worker


class Reporter:
    """Shows every note once, and counts the pictures that it applies to."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._counts: Counter[str] = Counter()
        self._warned: dict[str, Assumption] = {}

    def tell(self, message: Message) -> None:
        """Show a line, or the notes that no earlier picture had."""
        if isinstance(message, str):
            show(self._console, message)
            return
        for note in message:
            if not self._counts[note.statement]:
                show(self._console, f"  {note}")
            self._counts[note.statement] += 1
            if note.code:
                self._warned.setdefault(note.statement, note)

    @property
    def warnings(self) -> list[dict[str, Any]]:
        """The warnings as values for JSON, each once, as of the first of so many ``pictures``."""
        return [{**note.record(), "pictures": self._counts[text]} for text, note in self._warned.items()]

    def summary(self, pictures: int) -> None:
        """Show the notes that apply to some of the pictures only."""
        for text, count in self._counts.items():
            if count < pictures:
                show(self._console, f"  {count} of {pictures} pictures: {text}")


def run(request: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all pictures of a request, and return the problems, one line each.

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


def _run(request: UpsampleRequest, frames: Frames, console: Console) -> list[str]:
    """Upsample frames, and return the problems."""
    wanted, shard, pairs = request.results, request.frames.shard, frames.found.pairs
    started = time.monotonic()
    of_all = [*(name for part in wanted.of_all for name in part.files), EXPORTS]
    expect_targets(wanted.output, of_all if shard is None else [_summary_of(shard)])
    for line in _found(request, frames):
        show(console, line)
    reporter = Reporter(console)
    outcomes: Counter[str] = Counter()
    problems: dict[str, list[str]] = {}
    targets: dict[str, Path] = {}
    size = 0
    for done in work_through(request, frames, reporter.tell, ConsoleProgress(console)):
        if done.problem is None:
            outcomes[done.outcome] += 1
            targets[done.pair.name] = done.target
            size += done.size
        else:
            problems.setdefault(done.problem, []).append(done.pair.name)
    lines = [f"{_listed(names)}: {message}" if len(pairs) > 1 else message for message, names in problems.items()]
    if targets and wanted.of_all and not wanted.dry_run and shard is None:
        scene = write_scene(wanted.output, targets, wanted.of_all, overwrite=wanted.overwrite)
        for part, path in scene.files.items():
            show(console, f"{part}: {len(targets)} frames -> {path}")
        lines += scene.problems
    if not frames.single:
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        took = ""
        if not wanted.dry_run:
            reporter.summary(outcomes.total())
            took = f" in {clock(time.monotonic() - started)}, {megabytes(size)}"
        pictures = "1 picture" if len(pairs) == 1 else f"{len(pairs)} pictures"
        show(console, f"{pictures}: {', '.join(counts) or 'nothing to do'}{took} -> {wanted.output}")
    if shard is not None and not wanted.dry_run:
        summary = {
            "shard": str(shard),
            "outcomes": outcomes,
            "failed": [{"problem": problem, "frames": names} for problem, names in problems.items()],
            "warnings": reporter.warnings,
            "seconds": round(time.monotonic() - started, 3),
        }
        write_text(wanted.output / _summary_of(shard), json.dumps(summary, indent=2) + "\n")
    return lines


def work_through(request: UpsampleRequest, frames: Frames, tell: Tell, progress: Progress) -> Iterator[Done]:
    """Upsample pictures in ``--workers`` processes, each with its share of the cores; yield each once it is done.

    Notes are shown in the order of the pictures, or as they come from several workers.
    """
    jobs = [(pair, frames.target(request.results.output, pair)) for pair in frames.found.pairs]
    workers = min(request.frames.workers, len(jobs))
    work = FrameWork(request, frames)  # raises for poses that do not fit
    frames = work.check_together(jobs)
    if workers <= 1:
        for job in progress.track(jobs, "upsample", label=lambda job: job[0].name, lines=False):
            yield work(*job, tell, progress)
        return
    left, threads = list(jobs), max(1, (os.cpu_count() or 1) // workers)
    with Pool(workers, _begin, (request, frames), threads, progress.say) as pool:
        results = pool.results(_remote, jobs)
        try:
            for job, (done, messages) in progress.track(
                results, "upsample", len(jobs), label=lambda each: each[0][0].name
            ):
                left.remove(job)
                for message in messages:
                    tell(message)
                yield done
        except ChildProcessError as error:
            yield from (Done(*job, problem=str(error)) for job in left)


def _begin(request: UpsampleRequest, frames: Frames) -> None:
    """Prepare a worker."""
    global _work  # noqa: PLW0603 - the process's own
    _work = FrameWork(request, frames)


def _remote(job: tuple[Pair, Path]) -> tuple[Done, list[Message]]:
    """Upsample a picture in a worker, and return what is to be told of it, too."""
    assert _work is not None  # noqa: S101 - workers begin with _begin
    messages: list[Message] = []
    return _work(*job, messages.append, Progress()), messages


def _posed(request: UpsampleRequest, frames: Frames) -> dict[str, bool]:
    """Return whether each frame has a pose, of the file, of its capture or of its result; frames that fail count."""
    if request.frames.trajectory is not None:
        given = read_poses(request.frames.trajectory).assign(frames.whole)
        return {pair.name: pair.name in given for pair in frames.whole}

    def posed(pair: Pair) -> bool:
        try:
            geometry, _ = read_geometry(pair, pixels_in_header(pair.rgb) or USUAL_SIZE, request.reading)
        except (ValueError, OSError):
            return True
        if geometry.pose is not None:
            return True
        try:
            return read_complete(frames.target(request.results.output, pair)).get("pose") is not None
        except (ValueError, OSError):
            return False

    return {pair.name: posed(pair) for pair in frames.whole}


def _summary_of(shard: Shard) -> str:
    """Return the name of the summary of a shard."""
    return f"shard-{shard.number}-of-{shard.count}.json"


def _found(request: UpsampleRequest, frames: Frames) -> Iterator[str]:
    """Yield lines on what was found, which files have no partner, and which frames a shard works on."""
    found, total, shard = frames.found, len(frames.whole), request.frames.shard
    named = total == 1 and len(found.pairs) == 1
    yield f"{found.pairs[0].rgb} and {found.pairs[0].depth}" if named else f"{total} pairs of photo and depth map"
    yield from (f"  {fact}" for fact in found.assumptions)
    if found.unpaired:
        names = _listed([path.name for path in found.unpaired])
        yield f"  {len(found.unpaired)} without a partner, left out: {names}"
    if shard is not None:
        block = shard.block(total)
        yield f"shard {shard}: {f'frames {block.start + 1} to {block.stop}' if block else 'no frame'} of {total}"
        if request.results.of_all:
            names = ", ".join(part.name for part in request.results.of_all)
            yield f"  {names}: of all frames, by the same command without --shard"


def _listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
