"""Sharing the scenes of a run among several processes, of this command and of others; each scene is done once.

``.claims/`` in that directory exists while one of them is at work. Each command has a file of a member there, which
says with which settings it works; those with others are refused until it has left or is gone.

A claim is a file that only one process can create; it names the machine, the process and when that was started, and its
time of modification is kept fresh. A claim is over when it is deleted, when its process is gone from the same machine,
or when it has not been refreshed for :data:`LOST` seconds. It is then taken over by a claim of the next number, which
again only one process can create, so that no deletion can meet a newer claim. What has been found out under a claim can
be left for the others as a record.

All files are made by ``O_EXCL`` or renaming, and times are compared with those that the same file system gives. The
time of a claim and what a directory contains are asked for anew, as clients of NFS remember both for up to a minute. So
a shared directory will do. (The leases of filelock take over by exchanging two names, which network file systems
refuse, so that there a claim of a machine that has died would be one for ever.)
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from dsr.utils.files import FullDiskError, birth, machine, space_for, write_text
from dsr.utils.guards import opened, parse_json, read_limited
from dsr.utils.memory import free_memory
from dsr.utils.pool import Pool, computing_threads
from dsr.utils.progress import Progress

BEAT, LOST = 10.0, 60.0
"""Seconds between two refreshments of a claim, and until one of another machine is over without."""
Claim = contextlib.ExitStack
"""A context at whose end something that is claimed is given back."""

_R = TypeVar("_R")
_BETWEEN_TRIES, _BETWEEN_LOOKS = 0.3, 0.05
_SECONDS_TO_LEAVE = 2.0
_MEMBERS = "members"
"""What is claimed to become a member, and to leave."""
_NUMBERS = itertools.count()
_LARGEST = 1 << 12
"""Bytes of a claim that are read."""
_MEMORY = 1 << 30
"""Bytes of free memory that the automatic number of workers leaves to each."""


class InUseError(ValueError):
    """A command with other settings is at work in a directory.

    Args:
        folder: the directory.
        owner: the process and its machine.

    """

    def __init__(self, folder: Path, owner: str) -> None:
        super().__init__(f"{folder}: {owner} is at work there with other settings; wait for its end, or take another")
        self.owner = owner


class Claims:
    """The claims in the directory of a run, to use in a ``with`` statement by each command that takes part.

    The last command that leaves deletes the claims and the records, and the directory if it was made for them and is
    empty. Within a command that takes part, further objects may claim without taking part themselves.

    Args:
        folder: the directory.
        settings: text that all commands at work there must have in common; None for one that leaves this to others.

    Raises:
        InUseError: a command with other settings takes part, or one that is stopped has just come or is about to leave.

    """

    def __init__(self, folder: Path, settings: str | None = None) -> None:
        self._run, self._settings = folder, None if settings is None else _digest(settings)
        self._folder = folder / ".claims"
        self._member = self._folder / f"member-{machine()}-{os.getpid()}-{next(_NUMBERS)}"
        self._beating = contextlib.ExitStack()
        self._made: list[Path] = []

    def __enter__(self) -> Self:
        """Take part."""
        self._made = [each for each in (self._run, *self._run.parents) if not each.exists()]
        try:
            with self._alone():
                if self._settings is not None:
                    self._expect_agreement()
                while not _create(self._member, self._settings):
                    self._member.unlink(missing_ok=True)  # of a process that had this number
        except BaseException:
            self._remove_empty()
            raise
        self._beating.enter_context(_fresh(self._member, lambda: _create(self._member, self._settings)))
        return self

    def __exit__(self, *_: object) -> None:
        """Leave; the last one deletes everything."""
        self._beating.close()
        with contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError, FullDiskError, TimeoutError):  # somebody is stopped right at this
                stack.enter_context(self.wait(_MEMBERS, _SECONDS_TO_LEAVE))
            if any(not self._is_over(each) for each in self._files("member-") if each != self._member):
                self._member.unlink(missing_ok=True)
                return
            for path in self._files(""):
                if not path.name.startswith(_digest(_MEMBERS)):
                    with contextlib.suppress(OSError):  # a stranger's folder
                        path.unlink()
        self._remove_empty()

    def _remove_empty(self) -> None:
        """Delete the directories that were made, if they are empty."""
        with contextlib.suppress(OSError):  # there is something in it
            for each in (self._folder, *self._made):
                each.rmdir()

    def wait(self, name: str, seconds: float = math.inf) -> Claim:
        """Claim something once nobody else has it.

        Raises:
            TimeoutError: somebody has it after so many seconds.

        """
        deadline = time.monotonic() + seconds
        while (claim := self.take(name)) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self._folder}: somebody has {name}")
            time.sleep(_BETWEEN_LOOKS)
        return claim

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
        while True:
            try:
                os.utime(self._folder)
                return self._folder.stat().st_mtime
            except FileNotFoundError:  # the last command has just deleted it
                self._folder.mkdir(parents=True, exist_ok=True)

    def _alone(self) -> Claim:
        """Claim that nobody else becomes a member meanwhile; raise InUseError if somebody is stopped right at that."""
        try:
            return self.wait(_MEMBERS, LOST)
        except TimeoutError as error:
            owners = [_owner(path) for path in self._files(f"{_digest(_MEMBERS)}.")]
            raise InUseError(self._run, ", ".join(map(_name_of, filter(None, owners))) or "another process") from error

    def _expect_agreement(self) -> None:
        """Raise InUseError if a command with other settings is at work."""
        for path in self._files("member-"):
            owner = _owner(path)
            if owner.get("settings") not in (None, self._settings) and self._lives(path, owner):
                raise InUseError(self._run, _name_of(owner))

    def _lives(self, path: Path, owner: Mapping[str, Any]) -> bool:
        """Return whether the process of a claim is there; a sign of life is waited for if it is another machine's."""
        with contextlib.suppress(FileNotFoundError):
            first = path.stat().st_mtime
            while not self._is_over(path):
                with path.open("rb") as file:
                    if owner["machine"] == machine() or os.fstat(file.fileno()).st_mtime != first:
                        return True
                time.sleep(_BETWEEN_LOOKS)
        return False

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
            with opened(path) as file:  # a client of NFS asks for a file's time when it is opened
                age = self.now() - os.fstat(file.fileno()).st_mtime
                text = file.read(_LARGEST)
        except OSError:
            try:  # another user's, or no file
                return self.now() - path.lstat().st_mtime > LOST
            except OSError:
                return False  # just deleted: whoever looks again sees that it is free
        try:
            owner = parse_json(text)
            if owner["machine"] == machine():
                return birth(int(owner["process"])) != owner["birth"]
        except (ValueError, KeyError, TypeError):
            pass  # its process is about to write it, or was killed before it did
        return age > LOST


def _create(path: Path, settings: str | None = None) -> bool:
    """Create the file of a claim; return whether it was not there."""
    owner = {
        "host": socket.gethostname(),
        "machine": machine(),
        "process": os.getpid(),
        "birth": birth(os.getpid()),
        "settings": settings,
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
            try:
                with file:
                    file.write(json.dumps(owner))
            except BaseException:  # it would be nobody's
                path.unlink(missing_ok=True)
                raise
            return True


def _owner(path: Path) -> dict[str, Any]:
    """Return what the file of a claim says; nothing if it is gone, or not yet written."""
    try:
        owner = parse_json(read_limited(path), finite=False)
        return {key: owner[key] for key in ("host", "machine", "process", "settings")}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _name_of(owner: Mapping[str, Any]) -> str:
    """Return how a message names the process of a claim."""
    return f"process {owner['process']} of {owner['host']}"


@contextlib.contextmanager
def _fresh(path: Path, lost: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Refresh the time of a file within this context; ``lost`` is called if somebody has deleted it."""
    ended = threading.Event()

    def refresh() -> None:
        while not ended.wait(BEAT):
            with contextlib.suppress(OSError, FullDiskError):
                try:
                    os.utime(path)
                except FileNotFoundError:
                    lost()

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


@dataclass(frozen=True)
class Workers:
    """How many processes work at a time, and how.

    Args:
        count: how many; 1 for this one.
        threads: of each; None for those that torch has. Sums of many numbers depend on it in their last bits, on
            ``count`` they do not.

    """

    count: int = 1
    threads: int | None = None


ALONE = Workers()


def choose_workers(workers: int | None, threads: int | None, scenes: int, cores: int, *, together: bool) -> Workers:
    """Return how a run is worked through.

    Args:
        workers: given number of processes; None to choose it: as many as the cores and the free memory allow.
        threads: given number of threads of each; None to choose it. It must not depend on the number of workers.
        scenes: number of scenes.
        cores: number of threads that this machine runs at a time.
        together: whether scenes are worked on together if nothing is given: each then gets a share of the cores.
            Otherwise they come one after the other with all cores, as a method that is long at work needs.

    """
    if threads is None:
        threads = max(1, cores // max(1, scenes)) if together else cores
    if workers is None:
        workers = min(max(1, cores // threads), max(1, free_memory() // _MEMORY)) if together else 1
    return Workers(max(1, min(workers, scenes)), threads)


def can_fork() -> bool:
    """Return whether this system has the processes that several workers need."""
    return hasattr(os, "fork")


def share(
    scenes: Sequence[str],
    claims: Claims,
    name: str,
    ready: Callable[[str], _R | None],
    work: Callable[[str, Progress], _R],
    lost: Callable[[str], _R],
    workers: Workers,
    progress: Progress,
) -> dict[str, _R]:
    """Work through scenes, but for those that other commands work on; wait for these.

    Args:
        claims: the claims of this command.
        name: what is done to the scenes, such as ``predict``.
        ready: function that returns the result of a scene if it is there already.
        work: function that makes it, and leaves it where ``ready`` finds it.
        lost: function that returns the result of a scene whose workers were killed.
        workers: how many at a time.

    Returns:
        The results by scene, in the order of ``scenes``.

    """
    found: dict[str, _R] = {}
    if workers.count == 1 or len(scenes) < 2:
        with computing_threads(workers.threads):
            attempts = _attempts(scenes, claims, name, ready)
            for scene, attempt in progress.track(attempts, name, len(scenes), label=_scene_of):
                if isinstance(attempt, Claim):
                    with attempt:
                        result = ready(scene)
                        found[scene] = work(scene, progress) if result is None else result
                else:
                    found[scene] = attempt
        return {scene: found[scene] for scene in scenes}

    def attempt_once(scene: str) -> _R | None:
        attempt = _attempt(scene, claims, name, ready)
        if not isinstance(attempt, Claim):
            return attempt
        with attempt:
            result = ready(scene)
            return work(scene, Progress()) if result is None else result

    with Pool(workers.count, attempt_once, lost, progress.say, threads=workers.threads) as pool:
        for scene, result in progress.track(pool.results(scenes), name, len(scenes), label=_scene_of):
            found[scene] = result
    return {scene: found[scene] for scene in scenes}


def _attempts(
    scenes: Sequence[str], claims: Claims, name: str, ready: Callable[[str], _R | None]
) -> Iterator[tuple[str, _R | Claim]]:
    """Yield each scene once, with its result or a claim on it."""
    waiting = list(scenes)
    while waiting:
        before = len(waiting)
        for scene in tuple(waiting):
            attempt = _attempt(scene, claims, name, ready)
            if attempt is not None:
                waiting.remove(scene)
                yield scene, attempt
        if len(waiting) == before:
            time.sleep(_BETWEEN_TRIES)


def _attempt(scene: str, claims: Claims, name: str, ready: Callable[[str], _R | None]) -> _R | Claim | None:
    """Return the result of a scene if it is there, or a claim on it; None if somebody else works on it."""
    result = ready(scene)
    return claims.take(f"{name} {scene}") if result is None else result


def _scene_of(pair: tuple[str, object]) -> str:
    """Return the scene of a scene and something about it."""
    return pair[0]
