"""Locks in the directory of a run, in ``.locks``; the system releases them when their process ends, however it ends."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

LOCKS = ".locks"
_BETWEEN_LOOKS = 0.3


class InUseError(ValueError):
    """A command with other settings is at work in a directory."""

    def __init__(self, folder: Path, owner: str) -> None:
        super().__init__(f"{folder}: {owner} is at work there with other settings; wait for its end, or take another")
        self.owner = owner


@contextlib.contextmanager
def at_work(folder: Path, settings: str) -> Iterator[None]:
    """Within this context a directory, which is made if need be, belongs to commands with the same settings.

    The last command that leaves removes the locks, and the directory if it was made for them and is empty. If a command
    with other settings is at work there, this is an InUseError.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    place = folder / LOCKS
    beginning = f"command-{_digest(settings)}-"
    own = place / f"{beginning}{socket.gethostname()}-{os.getpid()}.lock"
    lock = FileLock(own)
    while not lock.is_locked:
        place.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # the last command has just removed the directory
            lock.acquire()
    try:
        for other in place.glob("command-*"):
            if not other.name.startswith(beginning) and _is_held(other):
                host, _, process = other.stem.split("-", 2)[2].rpartition("-")
                raise InUseError(folder, f"process {process} of {host}")
        yield
    finally:
        lock.release()
        own.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # the directory is not empty, or another command removes the locks
            if not any(map(_is_held, place.glob("command-*"))):
                for each in place.iterdir():
                    each.unlink()
            for each in (place, *made):
                each.rmdir()


def scene_lock(folder: Path, name: str) -> FileLock:
    """Return the lock of a scene, or of another part of a run, for one process at a time."""
    (folder / LOCKS).mkdir(parents=True, exist_ok=True)
    return FileLock(folder / LOCKS / f"{_digest(name)}.lock")


def free_first(folder: Path, scenes: Sequence[str], *, wait: bool = True) -> Iterator[str]:
    """Yield each scene while its lock is held; those that other processes work on come last, or not if not ``wait``."""
    waiting = list(scenes)
    while waiting:
        for scene in tuple(waiting):
            try:
                held = scene_lock(folder, scene).acquire(blocking=False)
            except Timeout:
                continue
            with held:
                waiting.remove(scene)
                yield scene
        if not wait:
            return
        if waiting:
            time.sleep(_BETWEEN_LOOKS)


def _is_held(path: Path) -> bool:
    try:
        with FileLock(path).acquire(blocking=False):
            return False
    except Timeout:
        return True


def _digest(name: str) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:24]
