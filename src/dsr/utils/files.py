"""Files written atomically, by temporary ones beside them, and the errors of a full disk and of a target.

A target is a plain file, or none yet: a device, a pipe, a socket or a link is never replaced. New files and directories
have the permissions that the umask leaves.
"""

import contextlib
import errno
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dsr.utils.guards import path_within
from dsr.utils.progress import megabytes

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_KINDS = {
    stat.S_IFBLK: "a device", stat.S_IFCHR: "a device", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder", stat.S_IFREG: "a file",
}  # fmt: skip


class TargetError(OSError):
    """An output would replace something of another kind: a device, a pipe, a socket, a link or a folder."""


def data_root() -> Path:
    """Return the directory of the data sets' folders, and of weights that are fetched: $DSR_DATA, or ./data."""
    return Path(os.environ.get("DSR_DATA") or "data").expanduser()


def obstacle(path: Path, *, folder: bool = False) -> str | None:
    """Return the kind of thing in the place of a file or folder to be written, such as ``a device``; None for none."""
    try:
        mode = path.lstat().st_mode
    except (OSError, ValueError):  # reported by what writes
        return None
    if stat.S_ISLNK(mode):
        return None if folder and path.is_dir() else f"a link to {path.readlink()}"
    return None if stat.S_IFMT(mode) == (stat.S_IFDIR if folder else stat.S_IFREG) else _KINDS.get(stat.S_IFMT(mode))


def expect_target(path: Path, *, folder: bool = False) -> None:
    """Raise TargetError if a file, or a folder, cannot be written without replacing something of another kind."""
    found = obstacle(path, folder=folder)
    if found is not None:
        raise TargetError(f"{path}: expected a {'folder' if folder else 'file'} to write, got {found}")


def expect_targets(folder: Path, names: Iterable[str]) -> None:
    """Check files that are to be written into a folder, which may be a link; what is in it may not lead out of it."""
    expect_target(folder, folder=True)
    for name in names:
        path = folder / name
        expect_target(path, folder=path.is_dir() and not path.is_symlink())
        path_within(folder, name, folder)


def expect_own(folder: Path) -> None:
    """Raise TargetError if something in a folder, where files will be replaced, leads out of it or is no file."""
    real = os.path.realpath(folder)
    for place, folders, names in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *names)):
            found = obstacle(path)
            within = path.is_symlink() and Path(os.path.realpath(path)).is_relative_to(real)
            if found not in (None, "a folder") and not within:
                raise TargetError(f"{path}: expected a file or a folder of the directory's own, got {found}")


class FullDiskError(Exception):
    """A file could not be written for want of space; no OSError, as it ends a run and not one scene or picture."""

    def __init__(self, path: Path, needed: float | None = None) -> None:
        space, left = "space" if needed is None else megabytes(needed), "a full device"
        with contextlib.suppress(OSError):
            left = f"a device with {megabytes(shutil.disk_usage(path.parent).free)} left"
        super().__init__(f"{path}: expected {space} to write the file, got {left}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the message on the way from a worker process."""
        return FullDiskError.__new__, (FullDiskError, str(self))


@contextlib.contextmanager
def space_for(path: Path) -> Iterator[None]:
    """Raise FullDiskError for whatever goes wrong in this context for want of space."""
    try:
        yield
    except Exception as error:
        each: BaseException | None = error
        while each is not None and not isinstance(error, FullDiskError):
            if isinstance(each, OSError) and each.errno in _FULL:
                raise FullDiskError(path) from error
            each = each.__cause__ or each.__context__
        raise


def expect_space(path: Path, needed: float) -> None:
    """Check that there is space for a number of bytes beside a file."""
    if needed > shutil.disk_usage(path.parent).free:
        raise FullDiskError(path, needed)


@contextlib.contextmanager
def temporary_folder(folder: Path, name: str) -> Iterator[Path]:
    """Yield a temporary directory in a folder, which is created if it does not exist; in the end it is deleted."""
    temporary = folder / f".{name}-{secrets.token_hex(4)}"
    try:
        with space_for(folder / name):
            temporary.mkdir(parents=True)
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, in a folder that is made, that replaces it if the block ends well."""
    expect_target(path)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        with space_for(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch(exist_ok=False)
            yield temporary
            expect_target(path)  # what has come there meanwhile
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary directory beside ``path`` that replaces it if the block ends well; a link stays one."""
    expect_target(path, folder=True)
    path = path.resolve()
    with temporary_folder(path.parent, path.name) as temporary, temporary_folder(path.parent, path.name) as old:
        yield temporary
        expect_target(path, folder=True)
        if path.exists():
            path.replace(old / path.name)
        temporary.replace(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
