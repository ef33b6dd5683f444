"""Unpacking archives: all of it or nothing, and nothing outside the directory that it belongs into."""

from __future__ import annotations

import contextlib
import errno
import posixpath
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from dsr.data.download.transfer import disk_errors, expect_room
from dsr.utils.console import one_line
from dsr.utils.limits import opened
from dsr.utils.paths import leads_outside
from dsr.utils.progress import Task

_CHUNK = 1 << 20
_DAMAGE = (
    zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error, KeyError, RuntimeError, UnicodeError, OSError,
)  # fmt: skip
"""What a damaged or encrypted archive raises; an OSError without a number is gzip's, and an invalid
argument is a place before the file's beginning."""


@dataclass(frozen=True)
class _Member:
    """A file or a link of an archive; ``link`` is where it leads to within the archive, None for a file."""

    name: str
    size: int
    link: str | None
    open: Callable[[], IO[bytes] | None]
    special: bool = False


def unpack(archive: Path, target: Path, moved: Task, contains: Sequence[str] = ()) -> dict[str, int]:
    """Unpack a zip or tar archive into a directory, beside the files that are there already.

    Everything is unpacked beside ``target`` first; an interruption before the end leaves nothing in it. Links become
    copies of the files that they lead to; those to directories are left out.

    Args:
        archive: the file.
        target: the directory.
        moved: is told how many bytes are unpacked, and of how many.
        contains: what the archive must have.

    Returns:
        The sizes of the files, by their path in ``target``.

    Raises:
        ValueError: it is damaged or no archive, lacks something, or has a member that leads outside ``target``.
        NoSpaceError: the disk has too little space.

    """
    work = target.parent / f".{archive.name}.unpacking"
    shutil.rmtree(work, ignore_errors=True)
    try:
        with _damage(archive), _opened(archive) as members:
            for member in members:
                _expect_inside(archive, member)
            work.mkdir(parents=True)
            with disk_errors(work):
                files = _extract(members, work, moved)
        missing = [name for name in contains if not (work / name).exists()]
        if missing:
            raise ValueError(f"{archive}: expected {', '.join(missing)} in it, there is none")
        _merge(work, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return files


def take_member(archive: Path, name: str, path: Path) -> None:
    """Write one member of a zip archive to ``path``.

    Raises:
        ValueError: the archive is damaged or has no such member.

    """
    with (
        _damage(archive),
        disk_errors(path),
        zipfile.ZipFile(archive) as packed,
        packed.open(name) as source,
        path.open("wb") as sink,
    ):
        shutil.copyfileobj(source, sink, _CHUNK)


@contextlib.contextmanager
def _damage(archive: Path) -> Iterator[None]:
    """Make one line of what a damaged archive raises."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise ValueError(f"{archive}: expected an archive, got a damaged one: {one_line(error)}") from error


@contextlib.contextmanager
def _opened(archive: Path) -> Iterator[list[_Member]]:
    """Yield the members of an archive, its directories left out."""
    with opened(archive) as file:
        is_zip = file.read(2) == b"PK"
    if is_zip:
        with zipfile.ZipFile(archive) as packed:
            yield [_zip_member(packed, member) for member in packed.infolist() if not member.is_dir()]
    else:
        with tarfile.open(archive) as tar:
            yield [_tar_member(tar, member) for member in tar.getmembers() if not member.isdir()]


def _zip_member(packed: zipfile.ZipFile, member: zipfile.ZipInfo) -> _Member:
    kind = stat.S_IFMT(member.external_attr >> 16)
    return _Member(
        member.filename, member.file_size, None, lambda: packed.open(member), special=kind not in (0, stat.S_IFREG)
    )


def _tar_member(tar: tarfile.TarFile, member: tarfile.TarInfo) -> _Member:
    link = None
    if member.islnk():
        link = member.linkname
    elif member.issym():
        link = posixpath.join(posixpath.dirname(member.name), member.linkname)
    special = not (member.isfile() or link is not None)
    return _Member(member.name, member.size, link, lambda: tar.extractfile(member), special=special)


def _expect_inside(archive: Path, member: _Member) -> None:
    """Refuse a member that is no file, or whose path leads outside."""
    if member.special:
        raise ValueError(f"{archive}: refused: {member.name!r} in it is neither a file nor a directory")
    if leads_outside(member.name):
        raise ValueError(f"{archive}: refused: {member.name!r} in it leads outside the directory it belongs into")
    if member.link is not None and leads_outside(posixpath.normpath(member.link)):
        raise ValueError(f"{archive}: refused: {member.name!r} in it is a link that leads outside, to {member.link!r}")


def _extract(members: Sequence[_Member], work: Path, moved: Task) -> dict[str, int]:
    """Write the members below ``work``."""
    total, done, files = sum(member.size for member in members), 0, {}
    expect_room(work, total)
    for member in members:
        source = member.open()
        if source is None:  # a link to a directory
            continue
        path = work / PurePosixPath(member.name.replace("\\", "/"))
        path.parent.mkdir(parents=True, exist_ok=True)
        with source, path.open("wb") as sink:
            shutil.copyfileobj(source, sink, _CHUNK)
        files[path.relative_to(work).as_posix()] = path.stat().st_size
        done += member.size
        moved(done, total)
    return files


def _merge(source: Path, target: Path) -> None:
    """Move a file or directory, into the directory of the same name if there is one."""
    if source.is_dir() and target.is_dir():
        for path in sorted(source.iterdir()):
            _merge(path, target / path.name)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        source.replace(target)
