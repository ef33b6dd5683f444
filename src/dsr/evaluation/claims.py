"""Who works on what in the directory of a run that several processes, perhaps of several machines, evaluate together.

``.claims/`` in that directory exists while one of them is at work. A claim is a file that only one process can create;
it names the machine, the process and when that was started, and its time of modification is kept fresh. A claim is over
when it is deleted, when its process is gone from the same machine, or when it has not been refreshed for :data:`LOST`
seconds. It is then taken over by a claim of the next number, which again only one process can create, so that no
deletion can meet a newer claim. What has been found out under a claim can be left for the others as a record.

All files are made by ``O_EXCL`` or renaming, and times are compared with those that the same file system gives. The
time of a claim and what a directory contains are asked for anew, as clients of NFS remember both for up to a minute. So
a shared directory will do. (The leases of filelock take over by exchanging two names, which network file systems
refuse, so that there a claim of a machine that has died would be one for ever.)
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import socket
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from dsr.utils.files import birth, machine, space_for, write_text
from dsr.utils.guards import parse_json, read_limited

BEAT, LOST = 10.0, 60.0
"""Seconds between two refreshments of a claim, and until one of another machine is over without."""
Claim = contextlib.ExitStack
"""A context at whose end something that is claimed is given back."""


class Claims:
    """The claims in the directory of a run, to use in a ``with`` statement by each command that takes part.

    The last command that leaves deletes the claims and the records.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / ".claims"
        self._member = self._folder / f"member-{machine()}-{os.getpid()}"
        self._beating = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Take part."""
        while not _create(self._member):
            self._member.unlink(missing_ok=True)  # of a process that had this number
        self._beating.enter_context(_fresh(self._member))
        return self

    def __exit__(self, *_: object) -> None:
        """Leave; the last one deletes everything."""
        self._beating.close()
        if any(not self._is_over(each) for each in self._files("member-") if each != self._member):
            self._member.unlink(missing_ok=True)
        else:
            shutil.rmtree(self._folder, ignore_errors=True)

    def take(self, name: str) -> Claim | None:
        """Claim something; return None if somebody else has it."""
        stem = f"{_digest(name)}."
        before = sorted(self._files(stem), key=_number)
        if before and not self._is_over(before[-1]):
            return None
        path = self._folder / f"{stem}{_number(before[-1]) + 1 if before else 0}"
        if not _create(path):
            return None
        claim = contextlib.ExitStack()
        for each in (path, *reversed(before)):
            claim.callback(each.unlink, missing_ok=True)  # they are called in the opposite order
        claim.enter_context(_fresh(path))
        return claim

    def record(self, name: str) -> Any:
        """Return the values that were recorded for a name; None for none."""
        try:
            return parse_json(read_limited(self._record(name)), finite=False)
        except (OSError, ValueError):
            return None

    def write_record(self, name: str, values: Mapping[str, Any]) -> None:
        """Record plain values for the other processes; they are kept until the last one has finished."""
        write_text(self._record(name), json.dumps(values))

    def now(self) -> float:
        """Return the time of the file system, which is that of its server, in seconds."""
        try:
            os.utime(self._member)
            return self._member.stat().st_mtime
        except FileNotFoundError:  # deleted by a command that took this one for lost
            _create(self._member)
            return self._member.stat().st_mtime

    def _record(self, name: str) -> Path:
        """Return the file of a record."""
        return self._folder / f"{_digest(name)}-record.json"

    def _files(self, beginning: str) -> list[Path]:
        """Return the files whose names begin so."""
        try:
            return [path for path in self._folder.iterdir() if path.name.startswith(beginning)]
        except FileNotFoundError:
            return []

    def _is_over(self, path: Path) -> bool:
        """Return whether a claim has lost its process."""
        try:
            with path.open(encoding="utf-8") as file:  # a client of NFS asks for a file's time when it is opened
                age = self.now() - os.fstat(file.fileno()).st_mtime
                text = file.read()
        except PermissionError:
            return self.now() - path.stat().st_mtime > LOST
        except OSError:
            return False  # just deleted: whoever looks again sees that it is free
        try:
            owner = json.loads(text)
            if owner["machine"] == machine():
                return birth(int(owner["process"])) != owner["birth"]
        except (ValueError, KeyError, TypeError):
            pass  # its process is about to write it, or was killed before it did
        return age > LOST


def _create(path: Path) -> bool:
    """Create the file of a claim; return whether it was not there."""
    owner = {
        "host": socket.gethostname(),
        "machine": machine(),
        "process": os.getpid(),
        "birth": birth(os.getpid()),
    }
    with space_for(path):
        while True:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                file = path.open("x", encoding="utf-8")
            except FileExistsError:
                return False
            except FileNotFoundError:  # the last command has just deleted the directory
                continue
            with file:
                file.write(json.dumps(owner))
            return True


@contextlib.contextmanager
def _fresh(path: Path) -> Iterator[None]:
    """Refresh the time of a file within this context."""
    ended = threading.Event()

    def refresh() -> None:
        while not ended.wait(BEAT):
            with contextlib.suppress(OSError):
                os.utime(path)

    thread = threading.Thread(target=refresh, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _digest(name: str) -> str:
    """Return a name as files have it."""
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:24]


def _number(path: Path) -> int:
    """Return the number of a claim."""
    return int(path.name.rpartition(".")[2])
