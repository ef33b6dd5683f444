"""The report of ``dsr upsample --dry-run``, which reads one frame of each kind, and at most headers of the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from dsr.app.upsample.checks import alike
from dsr.app.upsample.frame import COMPLETE, TO_DO, FrameWork
from dsr.app.upsample.frames import Frames
from dsr.app.upsample.reporting import Messages
from dsr.app.upsample.request import UpsampleRequest, files_of
from dsr.app.upsample.workers import Done, attempt
from dsr.io.images import pixels_in_header
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.utils.progress import Progress, duration, megabytes


def preview(request: UpsampleRequest, frames: Frames, reporter: Messages, progress: Progress) -> Iterator[Done]:
    """Report what :func:`dsr.app.upsample.workers.work_through` would do, and how long it would take."""
    reading = request.reading
    targets = {pair.name: frames.target(request.results.output, pair) for pair in frames.found.pairs}
    work = FrameWork(request, frames)
    work.check_together([(pair, targets[pair.name]) for pair in frames.found.pairs])
    kinds: dict[tuple[object, ...], list[Pair]] = {}
    for number, group in enumerate(alike(frames.found.pairs)):
        for pair in group:
            if work.is_to_do(pair, targets[pair.name]):
                kinds.setdefault((number, *_kind(pair, reading)), []).append(pair)
            else:
                yield Done(pair, targets[pair.name], COMPLETE, None)
    total: float | None = 0.0
    size = 0.0
    for kind in kinds.values():
        done = None
        while kind and (done is None or done.problem):  # until one of them can be read
            pair = kind.pop(0)
            done = attempt(work, pair, targets[pair.name], reporter, progress)
            yield done
        if kind:
            reporter.say(f"  {len(kind)} more of these sizes: their headers were read, not their values")
        if done is not None and not done.problem:
            total = None if total is None or work.seconds is None else total + work.seconds * (1 + len(kind))
            size += work.bytes * (1 + len(kind))
        for pair in kind:
            yield Done(pair, targets[pair.name], TO_DO, None)
    if size and not frames.single:
        time = "" if total is None else f"{duration(max(total, 1))} on two CPU cores, and "
        reporter.say(f"in all about {time}{megabytes(size)}")


def _kind(pair: Pair, reading: Reading) -> tuple[object, ...]:
    """Return what pictures have to have in common for one to stand for the others; a lost file has its own kind."""
    files: dict[str, Path] = files_of(pair, reading)
    lost = tuple(path for path in files.values() if not path.exists())
    return pixels_in_header(pair.rgb), pixels_in_header(pair.depth), pair.rgb.suffix, pair.depth.suffix, *files, *lost
