"""Files written atomically, by temporary ones that name their process, and the error of a full disk."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import shutil
import socket
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsr.utils import interruption
from dsr.utils.progress import megabytes

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_LITTLE = 1 << 16
"""Free bytes of a device from which a failed writing is not blamed on it."""

_TEMPORARY = re.compile(r"^\..*-(?P<machine>[0-9a-f]{6})-(?P<process>\d+)-[^-]{8}(\.[^.]*)?$")


class FullDiskError(Exception):
    """A file could not be written for want of space.

    It is no OSError, so that it ends a run rather than being taken for a problem of one scene or picture.
    """

    def __init__(self, path: Path, needed: float | None = None) -> None:
        space = "space" if needed is None else megabytes(needed)
        super().__init__(f"{path}: expected {space} to write the file, got {_free_space(path)}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the message on the way from a worker process."""
        return FullDiskError.__new__, (FullDiskError, str(self))


@contextlib.contextmanager
def space_for(path: Path) -> Iterator[None]:
    """Raise FullDiskError for whatever goes wrong in this context for want of space."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, FullDiskError) and _is_full(error, path):
            raise FullDiskError(path) from error
        raise


def expect_space(path: Path, needed: float) -> None:
    """Check that there is space for a number of bytes beside a file."""
    if needed > shutil.disk_usage(path.parent).free:
        raise FullDiskError(path, needed)


def silence_threads() -> None:
    """Let threads that write, such as TensorBoard's, print nothing at a full disk: the main thread meets it, too."""

    def report(problem: Any) -> None:
        if not isinstance(problem.exc_value, OSError) or problem.exc_value.errno not in _FULL:
            threading.__excepthook__(problem)

    threading.excepthook = report


def _is_full(error: BaseException, path: Path) -> bool:
    """Return whether a file could not be written for want of space, as the error or the device says.

    Libraries that write through C report only that they failed.
    """
    each: BaseException | None = error
    while each is not None:
        if isinstance(each, OSError) and each.errno in _FULL:
            return True
        each = each.__cause__ or each.__context__
    if isinstance(error, OSError) and error.errno is not None:
        return False
    try:
        return shutil.disk_usage(path.parent).free < _LITTLE
    except OSError:
        return False


def _free_space(path: Path) -> str:
    """Return how much space is left where a file is."""
    try:
        return f"a device with {megabytes(shutil.disk_usage(path.parent).free)} left"
    except OSError:
        return "a full device"


@contextlib.contextmanager
def temporary_folder(folder: Path, name: str) -> Iterator[Path]:
    """Yield a temporary directory in a folder, which is created if it does not exist; in the end it is deleted."""
    with space_for(folder / name):
        folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned(folder)
        temporary = Path(tempfile.mkdtemp(prefix=f".{name}-{owner()}-", dir=folder))
    try:
        with space_for(folder / name):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@functools.cache
def remove_abandoned(folder: Path) -> None:
    """Delete temporary files and directories in a folder whose process is gone; once per folder and process."""
    for path in folder.iterdir():
        found = _TEMPORARY.search(path.name)
        if found and found["machine"] == machine() and not _is_running(int(found["process"])):
            with contextlib.suppress(OSError):
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def owner() -> str:
    """Return this process as names of temporary files have it: the machine, and the process's number on it."""
    return f"{machine()}-{os.getpid()}"


@functools.cache
def machine() -> str:
    """Return a short name of what numbers processes: the machine, or the container on it."""
    try:
        numbering = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        numbering = ""
    return hashlib.sha256(f"{socket.gethostname()} {numbering}".encode()).hexdigest()[:6]


def birth(process: int) -> str | None:
    """Return when a process of this machine was started, which tells it from a later one of its number.

    Returns:
        A text that the process keeps, empty where the system does not tell it; None if the process has ended.

    """
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return None if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        return "" if _is_running(process) else None


def _is_running(process: int) -> bool:
    """Return whether a process of this machine is there."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without error.

    The directory is created if it does not exist. After an error or an interruption the temporary file is deleted; one
    that a killed process has left is deleted the next time that a file is written in its directory.
    """
    with interruption.leaving():
        with space_for(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            remove_abandoned(path.parent)
            handle, name = tempfile.mkstemp(prefix=f".{path.stem}-{owner()}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            with space_for(path):
                yield temporary
                temporary.chmod(0o644)
                temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that replaces it when the block ends without error."""
    with temporary_folder(path.parent, path.name) as temporary:
        yield temporary
        temporary.chmod(0o755)
        with temporary_folder(path.parent, path.name) as old:
            if path.exists():
                path.replace(old / path.name)
            temporary.replace(path)


def look_anew(folder: Path) -> None:
    """Have a client of NFS ask its server what a directory contains; it remembers for a while which files it lacks."""
    with contextlib.suppress(OSError):  # there is no such directory, or the system opens none
        os.close(os.open(folder, os.O_RDONLY))


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
