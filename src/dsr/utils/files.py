"""Files written atomically, by temporary ones that name their process, and the errors of a full disk and of a target.

A target is a plain file, or none yet: a device, a pipe, a socket or a link is never replaced. New files and directories
have the permissions that the umask leaves.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import secrets
import shutil
import socket
import stat
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from dsr.utils.guards import path_within
from dsr.utils.progress import megabytes

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_LITTLE = 1 << 16
"""Free bytes of a device from which a failed writing is not blamed on it."""

_TEMPORARY = re.compile(r"^\..*-(?P<machine>[0-9a-f]{6})-(?P<process>\d+)-[^-]{8}(\.[^.]*)?$")


_KINDS = {
    stat.S_IFBLK: "a device", stat.S_IFCHR: "a device", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder", stat.S_IFREG: "a file",
}  # fmt: skip
"""What may be in the place of what is to be written."""


class TargetError(OSError):
    """An output would replace something of another kind: a device, a pipe, a socket, a link or a folder."""


def data_root() -> Path:
    """Return the directory of the data sets' folders, and of weights that are fetched: $DSR_DATA, or ./data."""
    return Path(os.environ.get("DSR_DATA") or "data").expanduser()


def obstacle(path: Path, *, folder: bool = False) -> str | None:
    """Return the kind of thing in the place of a file or folder to be written, such as ``a device``.

    Args:
        path: where it is to be.
        folder: whether it is a folder, which may be a link to one.

    Returns:
        None where there is nothing, or a plain file, or a folder.

    """
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError):  # reported by what writes
        return None
    if stat.S_ISLNK(mode):
        return None if folder and path.is_dir() else f"a link to {path.readlink()}"
    return None if stat.S_IFMT(mode) == (stat.S_IFDIR if folder else stat.S_IFREG) else _KINDS.get(stat.S_IFMT(mode))


def expect_target(path: Path, *, folder: bool = False) -> None:
    """Check that a file, or a folder, can be written without replacing something of another kind.

    Raises:
        TargetError: there is something else, see :func:`obstacle`.

    """
    found = obstacle(path, folder=folder)
    if found is not None:
        raise TargetError(f"{path}: expected a {'folder' if folder else 'file'} to write, got {found}")


def expect_targets(folder: Path, names: Iterable[str]) -> None:
    """Check files that are to be written into a folder, or below it, before the work that they are made of.

    The folder may be a link to one; what is in it may not lead out of it.

    Raises:
        TargetError: something else is in the place of one.
        OutsideError: one would be outside of the folder.

    """
    expect_target(folder, folder=True)
    for name in names:
        path = folder / name
        expect_target(path, folder=path.is_dir() and not path.is_symlink())
        path_within(folder, name, folder)


def expect_own(folder: Path) -> None:
    """Check that nothing in a folder leads out of it, or is no file, as files in it will be replaced and removed.

    Raises:
        TargetError: there is a link out of it, a device, a pipe or a socket.

    """
    real = os.path.realpath(folder)
    for place, folders, names in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *names)):
            found = obstacle(path)
            within = path.is_symlink() and Path(os.path.realpath(path)).is_relative_to(real)
            if found not in (None, "a folder") and not within:
                raise TargetError(f"{path}: expected a file or a folder of the directory's own, got {found}")


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
        temporary = _new(folder / f".{name}-{owner()}-", "", Path.mkdir)
    try:
        with space_for(folder / name):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _new(beginning: Path, suffix: str, make: Callable[[Path], object]) -> Path:
    """Make a file or directory of a new name, with the permissions that the umask leaves, unlike :mod:`tempfile`."""
    while True:
        path = beginning.with_name(f"{beginning.name}{secrets.token_hex(4)}{suffix}")
        with contextlib.suppress(FileExistsError):
            make(path)
            return path


def _create(path: Path) -> None:
    """Make an empty file where there is nothing."""
    path.touch(exist_ok=False)


@functools.cache
def remove_abandoned(folder: Path) -> None:
    """Delete temporary files and directories in a folder whose process is gone; once per folder and process."""
    paths: list[Path] = []
    with contextlib.suppress(OSError):  # it may be written to, but not listed
        paths = list(folder.iterdir())
    for path in paths:
        found = _TEMPORARY.search(path.name)
        if found and found["machine"] == machine() and not _is_running(int(found["process"])):
            with contextlib.suppress(OSError):
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def owner() -> str:
    """Return this process as names of temporary files have it: the machine, and the process's number on it."""
    return f"{machine()}-{os.getpid()}"


@functools.cache
def machine() -> str:
    """Return a short name of the machine, or of the container on it, within which process numbers are unique."""
    try:
        numbering = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        numbering = ""
    return hashlib.sha256(f"{socket.gethostname()} {numbering}".encode()).hexdigest()[:6]


def birth(process: int) -> str | None:
    """Return when a process of this machine was started, which distinguishes it from a later one with the same number.

    Returns:
        A text that stays the same for the process, empty where the system does not report it; None if it has ended.

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
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another user's
        return True
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it when the block ends without error.

    The directory is created if it does not exist. After an error or an interruption the temporary file is deleted; one
    that a killed process has left is deleted the next time that a file is written in its directory.

    Raises:
        TargetError: ``path`` is a device, a pipe, a socket, a link or a folder.

    """
    expect_target(path)
    with space_for(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent)
        temporary = _new(path.with_name(f".{path.stem}-{owner()}-"), path.suffix, _create)
    try:
        with space_for(path):
            yield temporary
            expect_target(path)  # what has come there meanwhile
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that replaces it when the block ends without error.

    Where ``path`` is a link to a directory, that one is replaced, and the link stays.

    Raises:
        TargetError: ``path`` is a file, a device, a pipe, a socket or a link to nothing.

    """
    expect_target(path, folder=True)
    path = path.resolve()
    with temporary_folder(path.parent, path.name) as temporary:
        yield temporary
        expect_target(path, folder=True)
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
