"""``dsr data get``: fetching the data sets of the catalogue.

A file that comes for the first time is checked for what it claims to be, and its SHA-256 is written into
``checksums.json``; ever after it has to have that one. Files are on disk under their names whole or not at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

from dsr.data.download.checksums import Checksums, Entry, lock_directory, sha256_of
from dsr.data.download.collection import Item
from dsr.data.download.inventory import compare, expect_kind, lack, record
from dsr.data.download.transfer import FetchError, NoSpaceError, UnreachableError, download
from dsr.data.download.unpack import take_member, unpack
from dsr.utils.console import one_line
from dsr.utils.progress import Progress
from dsr.utils.units import megabytes

_UNPACKED = 1.25
"""Size of what an archive of pictures unpacks to, as a multiple of its own: for a first check of the disk."""


@dataclass(frozen=True)
class Options:
    """How to fetch.

    Args:
        mirror: address of a server to try first; it has each file under its path below the directory of the data sets.
        accept_changed: whether a file may have another checksum than recorded.
        keep_archives: whether archives stay after they were unpacked; those that were there before do anyway.

    """

    mirror: str | None = None
    accept_changed: bool = False
    keep_archives: bool = False


def get(items: Iterable[Item], root: Path, progress: Progress, options: Options | None = None) -> list[str]:
    """Fetch what is not there, or not as recorded.

    An interruption keeps what has come of a file beside it, ``.part``, and the next call goes on from there.

    Args:
        items: what to fetch; a path that occurs twice is fetched once.
        root: the directory of the data sets.
        progress: shows what is done.
        options: see :class:`Options`.

    Returns:
        What could not be had and why, a line each; the others are there. A full disk ends it.

    Raises:
        ValueError: ``checksums.json`` is damaged, or another command is writing into ``root``.

    """
    problems: list[str] = []
    root.mkdir(parents=True, exist_ok=True)
    with lock_directory(root):
        job = _Job(root, Checksums(root), progress, options or Options())
        for item in {item.path: item for item in items}.values():
            try:
                job.get(item)
            except NoSpaceError as error:
                return [*problems, f"{item.path}: {error}"]
            except (ValueError, OSError) as error:
                problems.append(f"{item.path}: {one_line(error)}")
    return problems


@dataclass(frozen=True)
class _Job:
    """Fetching; ``gone`` has the servers that could not be reached."""

    root: Path
    checksums: Checksums
    progress: Progress
    options: Options
    gone: set[str] = field(default_factory=set)

    def get(self, item: Item) -> None:
        """Fetch an item unless it is there and good."""
        target, entry = self.root / item.path, self.checksums.get(item.path)
        if item.unpack_to is None:
            if not self._is_good(item):
                digest = self._fetch(item)
                self.checksums.update({item.path: Entry(digest, target.stat().st_size)})
                self.progress.say(f"{item.path}: {megabytes(target.stat().st_size)}")
            return
        if lack(item, self.root, entry) is None:
            return
        given = target.is_file()
        digest = self._digest(item, target, str(target)) if given else self._fetch(item)
        with self.progress.task(f"unpacking {item.path}", unit="bytes") as moved:
            files = unpack(target, self.root / item.unpack_to, moved, item.contains)
        self.checksums.update({item.path: Entry(digest, target.stat().st_size, files)})
        self.progress.say(f"{item.path}: {megabytes(target.stat().st_size)}, unpacked to {len(files)} files")
        if given:
            self.progress.say(f"{item.path}: was there before and is kept; it is not needed any more")
        elif not self.options.keep_archives:
            target.unlink()

    def _is_good(self, item: Item) -> bool:
        """Return whether a file is there and as recorded; the user's own is recorded."""
        if not (self.root / item.path).is_file():
            return False
        new: dict[str, Entry] = {}
        problem = compare(item.path, self.root, self.checksums, new, self.progress, item.sha256)
        if problem is not None:
            self.progress.say(f"{problem}: fetching it again")
            return False
        record(self.checksums, new, self.progress)
        return True

    def _fetch(self, item: Item) -> str:
        """Download a file from the first address that has it, and return its checksum."""
        mirror = () if self.options.mirror is None else (f"{self.options.mirror.rstrip('/')}/{item.path}",)
        problems = []
        for url in (*mirror, *item.urls):
            host = urlsplit(url).netloc
            try:
                return self._fetch_from(url, item, () if host in self.gone else None)
            except NoSpaceError:
                raise
            except UnreachableError as error:
                self.gone.add(host)
                problems.append(str(error))
            except ValueError as error:
                problems.append(str(error))
        raise FetchError("; ".join(dict.fromkeys(problems)))

    def _fetch_from(self, url: str, item: Item, pauses: Sequence[float] | None) -> str:
        """Download a file, check it, put it in place, and return its checksum."""
        target = self.root / item.path
        address, _, member = url.partition("#")
        name = f"{target.name}.zip" if member else target.name
        part = target.with_name(f"{name}.part")
        room = 0.0 if item.unpack_to is None else _UNPACKED
        new = target.with_name(f"{name}.new")
        if not new.is_file():
            with self.progress.task(item.path, unit="bytes") as moved:
                download(address, part, moved, room=room, pauses=pauses)
            part.replace(new)
        try:
            if member:
                new = _member_of(new, member)
            expect_kind(new, target.suffix, url)
            digest = self._digest(item, new, url)
        except ValueError:
            new.unlink(missing_ok=True)
            raise
        new.replace(target)
        return digest

    def _digest(self, item: Item, path: Path, source: str) -> str:
        """Return a file's checksum, which must be the recorded one if there is one."""
        entry = None if self.options.accept_changed else self.checksums.get(item.path)
        expected, digest = item.sha256 or (None if entry is None else entry.sha256), sha256_of(path)
        if expected not in (None, digest):
            raise FetchError(
                f"{source}: expected sha256 {expected} as recorded in {self.checksums.path}, got {digest}; "
                "if the new one is right, --accept-changed takes it"
            )
        return digest


def _member_of(archive: Path, member: str) -> Path:
    """Return a member of a zip archive as a file, in place of the archive."""
    path = archive.with_name(f"{archive.name}.member")
    try:
        take_member(archive, member, path)
    except ValueError:
        path.unlink(missing_ok=True)
        raise
    archive.unlink()
    return path
