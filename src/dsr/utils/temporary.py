"""Temporary files that name the process that owns them, so that those of killed processes can be told and removed."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from dsr.utils.space import space_for

_TEMPORARY = re.compile(r"^\..*-(?P<machine>[0-9a-f]{6})-(?P<process>\d+)-[^-]{8}(\.[^.]*)?$")


@contextlib.contextmanager
def temporary_folder(folder: Path, name: str) -> Iterator[Path]:
    """Yield a temporary directory in a folder, which is created if it does not exist; in the end it is deleted.

    Args:
        folder: where it is.
        name: the beginning of its name, after a dot.

    Raises:
        FullDiskError: there is no space for its files.

    """
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

    Args:
        process: its number.

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
