"""Uploads of ``dsr app``, in a private temporary folder, and its jobs: one process at a time opens them."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from dsr.app.browser.work import SHOWN, What
from dsr.utils.console import one_line
from dsr.utils.guards import free_memory
from dsr.utils.progress import megabytes

_MOST_UPLOADS, _MOST_WAITING = 4, 8
"""Uploads that are held, of which the oldest goes for another; and processes that wait for their turn."""
_KEPT = 3600.0
"""Seconds after which an upload that nobody asked for is deleted."""
_ABANDONED = 120.0
"""Seconds after which a job is ended that nobody asks about; pages ask all the time, hidden ones once a minute."""
_BETWEEN_LOOKS, _TICK = 5.0, 0.2
_MOST_NOTES = 500
_SPAN = 1 << 20
"""Longest line of the process, bytes."""

State = Literal["waiting", "running", "done", "failed", "cancelled"]


class RefusedError(ValueError):
    """Something that cannot be done now; the message says why."""


@dataclass
class Upload:
    """Files that a page sent, by role, in a folder of their own, and the job that is theirs."""

    id: str
    folder: Path
    files: dict[str, Path] = field(default_factory=dict)
    size: int = 0
    asked: float = field(default_factory=time.monotonic)
    job: Job | None = None

    @property
    def work(self) -> Path:
        """The folder of the results."""
        return self.folder / "made"


@dataclass
class Job:
    """One run of the process.

    Attributes:
        facts: what the process has sent, the last of each name.
        notes: notes on the input, each with whether it is a warning.
        names: those of the frames.
        thumbs: small pictures of frames.

    """

    id: str
    upload: Upload
    what: What
    arguments: tuple[str, ...]
    state: State = "waiting"
    problem: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    notes: list[dict[str, Any]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    thumbs: list[dict[str, Any]] = field(default_factory=list)
    started: float = 0.0
    ended: float = 0.0
    steps_since: float = 0.0
    process: subprocess.Popen[bytes] | None = None

    @property
    def is_over(self) -> bool:
        """Whether nothing more will come of it."""
        return self.state not in ("waiting", "running")

    def record(self, waiting_before: int) -> dict[str, Any]:
        """Return its state as values for JSON."""
        now = self.ended or time.monotonic()
        facts = dict(self.facts)
        done, total = facts.pop("done", 0), facts.pop("total", 0) or 0
        remaining = (total - done) * (now - self.steps_since) / done if done and total and not self.is_over else None
        return {
            "id": self.id,
            "what": self.what,
            "state": self.state,
            "before": waiting_before,
            "problem": self.problem,
            "elapsed": now - self.started if self.started else 0.0,
            "remaining": remaining,
            "done": done,
            "total": total,
            "notes": list(self.notes),
            "names": list(self.names),
            "thumbs": list(self.thumbs),
            **facts,
        }

    def take(self, message: Any) -> None:
        """Take a message of the process; TypeError if it is no object."""
        if not isinstance(message, dict):
            raise TypeError("expected an object")
        if "note" in message:
            if len(self.notes) < _MOST_NOTES and message not in self.notes:
                self.notes.append(message)
        elif "names" in message:
            self.names += map(str, message["names"])
        elif "thumb" in message:
            self.thumbs.append(message)
        elif "problem" in message:
            self.problem = str(message["problem"])
        else:
            if message.get("done") == 0 or "done" not in self.facts:
                self.steps_since = time.monotonic()
            self.facts |= message


class Desk:
    """Takes uploads and jobs, and has a thread that does the jobs one after another.

    Args:
        most_bytes: largest size of the files of an upload.
        most_seconds: longest time of a job.
        most_memory: memory of a job in bytes; None for what is free.
        kept: seconds after which an upload that nobody asked for is deleted.

    """

    def __init__(
        self, most_bytes: int, most_seconds: float, most_memory: int | None = None, kept: float = _KEPT
    ) -> None:
        self.most_bytes, self.most_seconds, self.most_memory, self.kept = most_bytes, most_seconds, most_memory, kept
        self.folder = Path(tempfile.mkdtemp(prefix=".dsr-"))
        self.uploads: dict[str, Upload] = {}
        self._queue: deque[Job] = deque()
        self._running: Job | None = None
        self._closed = False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._serve, name="jobs", daemon=True)
        self._thread.start()

    def open(self, replaced: str = "") -> Upload:
        """Return a new upload, perhaps in place of another one."""
        with self._change:
            for old in [replaced, *list(self.uploads)[: max(0, len(self.uploads) - _MOST_UPLOADS + 1)]]:
                self.drop(old)
            upload = Upload(secrets.token_urlsafe(18), self.folder / secrets.token_hex(8))
            upload.folder.mkdir(mode=0o700)
            self.uploads[upload.id] = upload
            return upload

    def find(self, name: str) -> Upload | None:
        """Return an upload, which is then kept for longer; None if there is none of this name."""
        upload = self.uploads.get(name)
        if upload is not None:
            upload.asked = time.monotonic()
        return upload

    def drop(self, name: str) -> None:
        """Delete an upload, end its job, and delete its files."""
        with self._change:
            upload = self.uploads.pop(name, None)
            if upload is not None:
                self._end(upload.job)
                shutil.rmtree(upload.folder, ignore_errors=True)

    def submit(self, upload: Upload, what: What, arguments: Sequence[str]) -> Job:
        """Return a new job of an upload, in place of the one that it has.

        Raises:
            RefusedError: too many wait, or there is no result yet to write files of.

        """
        with self._change:
            if len(self._queue) >= _MOST_WAITING:
                raise RefusedError("too many are waiting; try again later")
            if what == "files" and not (upload.work / SHOWN).is_file():
                raise RefusedError("there is no result to write files of")
            self._end(upload.job)
            if what == "files" and upload.job is not None:
                arguments = upload.job.arguments
            else:
                shutil.rmtree(upload.work, ignore_errors=True)
            upload.work.mkdir(mode=0o700, exist_ok=True)
            upload.job = Job(secrets.token_urlsafe(18), upload, what, tuple(arguments))
            self._queue.append(upload.job)
            self._change.notify_all()
            return upload.job

    def cancel(self, upload: Upload) -> None:
        """End the job of an upload."""
        with self._change:
            self._end(upload.job)

    def record(self, upload: Upload) -> dict[str, Any]:
        """Return the state of an upload's job as values for JSON; empty if there is none."""
        with self._change:
            job = upload.job
            if job is None:
                return {}
            before = self._queue.index(job) + (self._running is not None) if job in self._queue else 0
            record = job.record(before)
        inside = f"{upload.folder}{os.sep}"
        text = json.dumps(record)  # the page does not show this machine's paths
        for place in (json.dumps(inside)[1:-1], json.dumps(f"{os.path.realpath(upload.folder)}{os.sep}")[1:-1]):
            text = text.replace(place, "")
        plain: dict[str, Any] = json.loads(text)
        return plain

    def close(self) -> None:
        """End all jobs, and delete all files."""
        with self._change:
            self._closed = True
            for name in list(self.uploads):
                self.drop(name)
            self._change.notify_all()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _end(self, job: Job | None) -> None:
        """End a job, which becomes a cancelled one unless it is over."""
        if job is None or job.is_over:
            return
        with contextlib.suppress(ValueError):
            self._queue.remove(job)
        job.state, job.ended = "cancelled", time.monotonic()
        if job.process is not None:
            job.process.kill()
            job.process.wait()

    def _serve(self) -> None:
        """Do jobs, and delete uploads that nobody asks for any longer."""
        while True:
            with self._change:
                if not self._queue and not self._closed:
                    self._change.wait(_BETWEEN_LOOKS)
                if self._closed:
                    return
                self._expire()
                if not self._queue:
                    continue
                job = self._running = self._queue.popleft()
                try:
                    process = self._start(job)
                except OSError as error:  # no memory, or no space
                    job.state, job.problem, self._running = "failed", one_line(error), None
                    continue
            self._follow(job, process)
            with self._change:
                self._running = None

    def _expire(self) -> None:
        """Delete uploads that are too old, and end waiting jobs that nobody asks about."""
        now = time.monotonic()
        for upload in list(self.uploads.values()):
            if now - upload.asked > _ABANDONED and upload.job in self._queue:
                self._end(upload.job)
            if now - upload.asked > self.kept and (upload.job is None or upload.job.is_over):
                self.drop(upload.id)

    def _start(self, job: Job) -> subprocess.Popen[bytes]:
        """Start the process of a job."""
        free = free_memory()
        memory = free if self.most_memory is None else min(free, self.most_memory)
        scratch = job.upload.folder / "scratch"
        scratch.mkdir(mode=0o700, exist_ok=True)
        job.state, job.started = "running", time.monotonic()
        job.facts["memory"] = megabytes(memory)
        module = "dsr.app.browser.work"
        job.process = subprocess.Popen(  # noqa: S603 - arguments of options that are checked there
            [sys.executable, "-P", "-m", module, job.what, str(job.upload.work), str(memory), *job.arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "TMPDIR": str(scratch), "TMP": str(scratch), "TEMP": str(scratch)},
            cwd=scratch,
            start_new_session=True,  # Ctrl-C is the server's, which ends it
        )
        return job.process

    def _follow(self, job: Job, process: subprocess.Popen[bytes]) -> None:
        """Read the process's messages until it ends, or its time is over."""
        assert process.stdout is not None  # noqa: S101
        assert process.stdin is not None  # noqa: S101
        over, late, damaged = threading.Event(), threading.Event(), False

        def watch() -> None:
            while not over.wait(_TICK):
                if time.monotonic() - job.started > self.most_seconds:
                    late.set()
                    process.kill()
                    return
                if time.monotonic() - job.upload.asked > _ABANDONED:
                    with self._change:
                        self._end(job)
                    return

        threading.Thread(target=watch, name="time", daemon=True).start()
        with process.stdin, process.stdout:
            while line := process.stdout.readline(_SPAN):
                try:
                    with self._change:
                        job.take(json.loads(line))
                except (ValueError, TypeError):  # it is cut off, too long, or nothing that the process says
                    damaged = True
            code = process.wait()
        over.set()
        shutil.rmtree(job.upload.folder / "scratch", ignore_errors=True)
        with self._change:
            self._conclude(job, code, late=late.is_set(), damaged=damaged)

    def _conclude(self, job: Job, code: int, *, late: bool, damaged: bool) -> None:
        """Say what became of a job."""
        if job.is_over:
            return
        job.ended = time.monotonic()
        if late:
            job.problem = f"it took more than {self.most_seconds:g} s (--max-seconds), and was ended"
        elif code and not job.problem:
            job.problem = f"the process ended ({code}); it may have needed more than {job.facts['memory']} of memory"
        elif not job.problem and (damaged or (job.what == "look" and "count" not in job.facts)):
            job.problem = "the process's list of files could not be read"
        job.state = "failed" if job.problem else "done"
