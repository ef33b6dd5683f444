"""The pictures of ``dsr upsample``, one after another, or several at a time in processes of their own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dsr.app.upsample.frame import FrameWork
from dsr.app.upsample.frames import Frames
from dsr.app.upsample.reporting import Messages, Record, Reporter
from dsr.app.upsample.request import UpsampleRequest
from dsr.io.pairs import Pair
from dsr.utils.console import one_line
from dsr.utils.guards import refusing_excess
from dsr.utils.processes import LOST, Pool
from dsr.utils.progress import Progress

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
    """Upsample pictures, ``frames.workers`` at a time, each with its share of the cores; yield each once it is done.

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
        except ChildProcessError:
            yield from (Done(*job, "", LOST) for job in left)


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
