"""The pictures of ``dsr upsample``, one after another or several at a time in processes of their own; its dry run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dsr.app.upsample.checks import alike
from dsr.app.upsample.frame import COMPLETE, TO_DO, FrameWork
from dsr.app.upsample.frames import Frames
from dsr.app.upsample.reporting import Messages, Record, Reporter
from dsr.app.upsample.request import UpsampleRequest, files_of
from dsr.io.images import pixels_in_header
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.utils.console import one_line
from dsr.utils.guards import refusing_excess
from dsr.utils.processes import Pool
from dsr.utils.progress import Progress, duration, megabytes

_Job = tuple[Pair, Path]  # a picture and the folder of its results
_work: FrameWork | None = None  # of this process, if it is a worker


class Done(NamedTuple):
    """A picture that was worked on: the outcome with the size of its results, or the problem in one line."""

    pair: Pair
    target: Path
    outcome: str
    problem: str | None
    bytes: float = 0.0


def work_through(request: UpsampleRequest, frames: Frames, reporter: Reporter, progress: Progress) -> Iterator[Done]:
    """Upsample pictures in ``--workers`` processes, each with its share of the cores; yield each once it is done.

    Notes are shown in the order of the pictures, or as they come from several workers.
    """
    jobs = [(pair, frames.target(request.results.output, pair)) for pair in frames.found.pairs]
    workers = min(request.frames.workers, len(jobs))
    work = FrameWork(request, frames)  # raises for poses that do not fit
    frames = work.check_together(jobs)
    if workers <= 1:
        for pair, target in progress.track(jobs, "upsample", label=lambda job: job[0].name, lines=False):
            yield attempt(work, pair, target, reporter, progress)
        return
    left, threads = list(jobs), max(1, (os.cpu_count() or 1) // workers)
    with Pool(workers, _begin, (request, frames), threads, progress.say) as pool:
        results = pool.results(_remote, jobs)
        try:
            for job, (done, record) in progress.track(
                results, "upsample", len(jobs), label=lambda each: each[0][0].name
            ):
                left.remove(job)
                record.replay(reporter)
                yield done
        except ChildProcessError as error:
            yield from (Done(*job, "", str(error)) for job in left)


def _begin(request: UpsampleRequest, frames: Frames) -> None:
    """Prepare a worker."""
    global _work  # noqa: PLW0603 - the process's own
    _work = FrameWork(request, frames)


def _remote(job: _Job) -> tuple[Done, Record]:
    """Upsample a picture in a worker."""
    assert _work is not None  # noqa: S101 - workers begin with _begin
    record = Record()
    return attempt(_work, *job, record, Progress()), record


def attempt(work: FrameWork, pair: Pair, target: Path, reporter: Messages, progress: Progress) -> Done:
    """Upsample a picture, and return the outcome: the result, or the error as one line."""
    try:
        with refusing_excess():
            return Done(pair, target, work(pair, target, reporter, progress), None, work.bytes)
    except (ValueError, OSError) as error:  # the others go on
        return Done(pair, target, "", one_line(error))


def preview(request: UpsampleRequest, frames: Frames, reporter: Messages, progress: Progress) -> Iterator[Done]:
    """Report what :func:`work_through` would do, and how long it would take.

    One picture of each kind is read, of the others at most the headers.
    """
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
