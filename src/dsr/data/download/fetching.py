"""The files of data sets: fetched, unpacked, recorded in ``checksums.json`` with their SHA-256, and verified.

A file that comes for the first time is checked for what it claims to be; ever after it has to have the checksum that is
recorded then. Files are on disk under their names whole or not at all. Downloads go on where they stopped (HTTP range
requests, RFC 9110, section 14): what there is of a file, ``.part``, has the date of the version that it belongs to.
"""

import contextlib
import email.utils
import errno
import json
import lzma
import os
import re
import shutil
import tarfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

import requests
from filelock import FileLock, Timeout
from requests.adapters import HTTPAdapter
from urllib3 import Retry
from urllib3.exceptions import HTTPError

from dsr.data.download import Collection, Item
from dsr.utils.console import one_line
from dsr.utils.files import (
    FullDiskError,
    expect_space,
    expect_target,
    space_for,
    temporary_folder,
    write_text,
)
from dsr.utils.guards import (
    files_in,
    leads_outside,
    natural_key,
    opened,
    parse_json,
    read_limited,
    read_member,
    refusing,
)
from dsr.utils.progress import Progress, Task, megabytes
from dsr.utils.versions import file_hash

_BUSY = (408, 425, 429, 500, 502, 503, 504)
RETRIES = Retry(  # of a server that does not answer, or is busy
    3, backoff_factor=1.0, status_forcelist=_BUSY, raise_on_status=False, respect_retry_after_header=False
)
_TIMEOUT = (10.0, 60.0)  # seconds for a connection, and between two pieces of an answer
_UNPACKED = 1.25  # size of what an archive of pictures unpacks to, as a multiple of its own, for a check of the disk
_CHUNK = 1 << 16
_BEGINNINGS: Mapping[str, tuple[bytes, ...]] = {
    ".gz": (b"\x1f\x8b",), ".jpg": (b"\xff\xd8\xff",), ".mat": (b"MATLAB", b"\x89HDF"), ".npy": (b"\x93NUMPY",),
    ".pfm": (b"Pf", b"PF"), ".pgm": (b"P2", b"P5"), ".png": (b"\x89PNG\r\n\x1a\n",), ".ppm": (b"P3", b"P6"),
    ".safetensors": (b"{",), ".zip": (b"PK",),
}  # fmt: skip
_COUNTED = {".safetensors": 8}  # bytes before that beginning, which count something
_DAMAGE = (  # an OSError without a number is gzip's, an invalid argument a place before the file's beginning
    zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, KeyError, RuntimeError, UnicodeError,
    OSError,
)  # fmt: skip


class _BrokenOffError(ValueError):
    """A connection that broke off in the middle of a file."""


@dataclass(frozen=True)
class Entry:
    """What is known of a file."""

    sha256: str | None  # None for an archive that the user unpacked
    size: int  # in bytes
    files: Mapping[str, int] | None = None  # of an archive, the sizes of what it unpacked to, by path in its directory


class Checksums(dict[str, Entry]):
    """The entries of ``checksums.json``, by path below the directory of the data sets."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root, self.path = root, root / "checksums.json"
        self.found: dict[str, Entry] = {}  # of what exists without a record, for :meth:`record_found`
        try:
            entries = parse_json(read_limited(self.path)) if self.path.is_file() else {}
            self.update({name: _entry(name, fields) for name, fields in entries.items()})
        except (ValueError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{self.path}: expected the checksums of the data sets, got a damaged file ({error}); delete it to "
                "record them anew"
            ) from error

    def record(self, entries: Mapping[str, Entry]) -> None:
        """Add entries, or change them, and write the file."""
        self.update(entries)
        plain = {name: {k: v for k, v in asdict(each).items() if v is not None} for name, each in sorted(self.items())}
        write_text(self.path, json.dumps(plain, indent=1) + "\n")

    def record_found(self, progress: Progress) -> None:
        """Record what was found, and report it; the directory may be one to read from only."""
        found, self.found = self.found, {}
        names = list(found)
        few = ", ".join(names) if len(names) < 4 else f"{names[0]}, {names[1]} and {len(names) - 2} more"
        try:
            if names:
                self.record(found)
                progress.say(f"{self.path}: recorded as found: {few}")
        except OSError as error:
            progress.say(f"{self.path}: not written: {error}")


def _entry(name: str, fields: Any) -> Entry:
    sha256, size, files = fields.get("sha256"), fields.get("size"), fields.get("files")
    digest = sha256 is None or (isinstance(sha256, str) and re.fullmatch(r"[0-9a-f]{64}", sha256) is not None)
    sizes = (size, *(() if files is None else files.values()))
    if not digest or any(type(each) is not int or not 0 <= each < 2**63 for each in sizes):
        raise ValueError(f"{fields!s:.60} is no entry")
    for each in filter(leads_outside, (name, *(files or ()))):
        raise ValueError(f"{each[:60]!r} leads outside of the directory")
    return Entry(sha256, size, files)


@contextlib.contextmanager
def lock_directory(root: Path) -> Iterator[None]:
    """Lock the directory of the data sets, if it exists and can be written, against other ``dsr data`` commands."""
    with (
        refusing(f"{root}: another `dsr data` command is writing there; wait for it to end", Timeout),
        FileLock(root / ".dsr-data.lock", blocking=False) if os.access(root, os.W_OK) else contextlib.nullcontext(),
    ):
        yield


def expect_address(mirror: str) -> None:
    """Refuse the address of a mirror that is none, or has a password, which messages would show."""
    address = urlsplit(mirror)
    if address.scheme not in ("http", "https") or not address.netloc or "@" in mirror:
        shown = mirror.rpartition("@")[2]
        raise ValueError(
            "--mirror: expected an address that begins with http:// or https://, without a password (~/.netrc may have "
            f"it), got {shown!r}"
        )


def get(
    items: Iterable[Item], root: Path, progress: Progress, *, mirror: str | None = None, keep_archives: bool = False
) -> list[str]:
    """Fetch files that are missing or differ from their record; return what could not be had and why, a line each.

    ``mirror`` is the address of a server to try first, which has each file under its path. Archives that were there
    before are kept anyway.
    """
    problems: list[str] = []
    root.mkdir(parents=True, exist_ok=True)
    with lock_directory(root):
        checksums = Checksums(root)
        for item in items:
            try:
                if item.unpack_to is None:
                    _get_file(item, checksums, progress, mirror)
                else:
                    _get_archive(item, checksums, progress, mirror, keep=keep_archives)
            except FullDiskError as error:
                return [*problems, f"{item.path}: {error}"]
            except (ValueError, OSError) as error:
                problems.append(f"{item.path}: {one_line(error)}")
    return problems


def _get_file(item: Item, checksums: Checksums, progress: Progress, mirror: str | None) -> None:
    """Fetch a file unless it is there as recorded; the user's own is recorded."""
    target = checksums.root / item.path
    if target.is_file():
        problem = _difference(item.path, checksums, progress, item.sha256)
        if problem is None:
            checksums.record_found(progress)
            return
        progress.say(f"{problem}: fetching it again")
    digest = _fetch(item, checksums, progress, mirror)
    checksums.record({item.path: Entry(digest, target.stat().st_size)})
    progress.say(f"{item.path}: {megabytes(target.stat().st_size)}")


def _get_archive(item: Item, checksums: Checksums, progress: Progress, mirror: str | None, *, keep: bool) -> None:
    """Fetch and unpack an archive unless what it unpacks to is there."""
    if _lack(item, checksums) is None:
        return
    target = checksums.root / item.path
    given = target.is_file()
    if given:
        digest = _checked_hash(item.path, target, str(target), checksums, progress, item.sha256)
    else:
        digest = _fetch(item, checksums, progress, mirror)
    with progress.task(f"unpacking {item.path}", unit="bytes") as moved:
        files = unpack(target, checksums.root / str(item.unpack_to), moved, item.contains)
    checksums.record({item.path: Entry(digest, target.stat().st_size, files)})
    progress.say(f"{item.path}: {megabytes(target.stat().st_size)}, unpacked to {len(files)} files")
    if given:
        progress.say(f"{item.path}: was there before and is kept; it is not needed any more")
    elif not keep:
        target.unlink()


def _fetch(item: Item, checksums: Checksums, progress: Progress, mirror: str | None) -> str:
    """Download a file from the first address that has it, and return its checksum."""
    urls = item.urls if mirror is None else (f"{mirror.rstrip('/')}/{item.path}", *item.urls)
    problems = [] if urls else ["no address of it is known; --mirror URL names a server that has it"]
    for url in urls:
        try:
            return _fetch_from(url, item, checksums, progress)
        except ValueError as error:
            problems.append(str(error))
    raise ValueError("; ".join(dict.fromkeys(problems)))


def _fetch_from(url: str, item: Item, checksums: Checksums, progress: Progress) -> str:
    """Download a file, check it, put it in place, and return its checksum."""
    target = checksums.root / item.path
    address, _, member = url.partition("#")
    part = target.with_name(f"{target.name}{'.zip' * bool(member)}.part")
    new = part.with_suffix(".member") if member else part
    for path in (target, part):
        expect_target(path)
    with progress.task(item.path, unit="bytes") as moved:
        _download(address, part, moved, 0.0 if item.unpack_to is None else _UNPACKED)
    try:
        if member:
            with _damage(part), space_for(new), zipfile.ZipFile(part) as packed:
                new.write_bytes(read_member(packed, member))
        digest = _checked_hash(item.path, new, url, checksums, progress, item.sha256)
        new.replace(target)
    except ValueError:
        new.unlink(missing_ok=True)
        part.unlink(missing_ok=True)
        raise
    part.unlink(missing_ok=True)
    return digest


def _download(url: str, part: Path, moved: Task, room: float) -> None:
    """Download a file, after what ``part`` has if possible; ``room`` times its size must stay free on the disk."""
    part.parent.mkdir(parents=True, exist_ok=True)
    with requests.Session() as session:
        for scheme in ("http://", "https://"):
            session.mount(scheme, HTTPAdapter(max_retries=RETRIES))
        while True:
            before = part.stat().st_size if part.is_file() else 0
            try:
                return _transfer(session, url, part, before, moved, room)
            except _BrokenOffError:
                if part.stat().st_size <= before:
                    raise


def _transfer(session: requests.Session, url: str, part: Path, have: int, moved: Task, room: float) -> None:
    """Ask once for what is missing behind the first ``have`` bytes, and write what comes."""
    headers = {"Accept-Encoding": "identity"}
    if have:
        date = email.utils.formatdate(part.stat().st_mtime, usegmt=True)
        headers |= {"Range": f"bytes={have}-", "If-Range": date}
    try:
        with session.get(url, headers=headers, stream=True, timeout=_TIMEOUT) as response:
            status, extent = response.status_code, response.headers.get("Content-Range", "")
            if have and status == requests.codes.requested_range_not_satisfiable and extent == f"bytes */{have}":
                return  # nothing is missing
            start = have if status == requests.codes.partial and extent.startswith(f"bytes {have}-") else 0
            if status != requests.codes.ok and not start:
                part.unlink(missing_ok=True)
                raise ValueError(f"{url}: HTTP {status} {response.reason or ''}".rstrip())
            length = extent.rpartition("/")[2] if start else response.headers.get("Content-Length", "")
            total = int(length) if length.isdigit() else None
            expect_space(part, (total or 0) * (1 + room) - start)
            with space_for(part):
                _write(response, part, start, total, moved)
    except requests.exceptions.SSLError as error:
        raise ValueError(f"{url}: expected a certificate that can be trusted, got: {error}") from error
    except (requests.ConnectionError, requests.Timeout) as error:
        raise ValueError(f"{url}: no connection to {urlsplit(url).netloc}") from error
    except requests.RequestException as error:
        raise ValueError(f"{url}: {one_line(error)}") from error
    except HTTPError as error:
        raise _BrokenOffError(f"{url}: the connection broke off") from error


def _write(response: requests.Response, part: Path, start: int, total: int | None, moved: Task) -> None:
    """Write an answer to the end of ``part``, or over it if it starts at 0; the file gets the date of its version."""
    done = start
    moved(done, total)
    try:
        with part.open("ab" if start else "wb") as file:
            for chunk in response.raw.stream(_CHUNK, decode_content=False):
                file.write(chunk)
                done += len(chunk)
                moved(done, total)
    finally:
        date = email.utils.parsedate_tz(response.headers.get("Last-Modified"))
        seconds = 0 if date is None else email.utils.mktime_tz(date)
        os.utime(part, (seconds, seconds))
    if total is not None and done != total:
        raise HTTPError(f"{done} of {total} bytes")


def unpack(archive: Path, target: Path, moved: Task, contains: Sequence[str] = ()) -> dict[str, int]:
    """Unpack a zip or tar archive into a directory, and return the sizes of the files by their path in it.

    Everything is unpacked beside ``target`` first; an interruption before the end leaves nothing in it. Links become
    copies of the files that they lead to; those to directories are left out. An archive that is damaged, lacks one of
    ``contains``, or has a member that leads outside ``target`` is refused.
    """
    files: dict[str, int] = {}
    with temporary_folder(target.parent, target.name) as work:
        with _damage(archive), _members(archive) as members:
            done, total = 0, sum(size for _, size, _ in members)
            expect_space(work, total)
            for name, size, open_member in members:
                source = open_member()
                if source is None:  # a link to a directory
                    continue
                path = work / name.replace("\\", "/")
                path.parent.mkdir(parents=True, exist_ok=True)
                with source, path.open("wb") as sink:
                    shutil.copyfileobj(source, sink, _CHUNK)
                files[path.relative_to(work).as_posix()] = path.stat().st_size
                moved(done := done + size, total)
        missing = [name for name in contains if not (work / name).exists()]
        if missing:
            raise ValueError(f"{archive}: expected {', '.join(missing)} in it, there is none")
        shutil.copytree(work, target, copy_function=os.replace, dirs_exist_ok=True)
    return files


@contextlib.contextmanager
def _members(archive: Path) -> Iterator[list[tuple[str, int, Callable[[], IO[bytes] | None]]]]:
    """Yield name, size and opener of the files in an archive; one with a device, or a path outside, is refused."""
    with opened(archive) as file:
        zipped = file.read(2) == b"PK"
    if zipped:
        with zipfile.ZipFile(archive) as packed:
            entries = files_in(packed, archive)
            yield [(each.filename, each.file_size, partial(packed.open, each)) for each in entries]
        return
    with tarfile.open(archive) as tar:
        files = [each for each in tar.getmembers() if not each.isdir()]
        for info in files:
            with refusing(f"{archive}: refused: {info.name!r} in it is no file, or leads outside", tarfile.FilterError):
                tarfile.data_filter(info, str(archive.parent))
            if leads_outside(info.name):
                raise ValueError(f"{archive}: refused: {info.name!r} in it leads outside the directory it belongs into")
        yield [(each.name, each.size, partial(tar.extractfile, each)) for each in files]


@contextlib.contextmanager
def _damage(archive: Path) -> Iterator[None]:
    """Make one line of what a damaged archive raises."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise ValueError(f"{archive}: expected an archive, got a damaged one: {one_line(error)}") from error


def state(collection: Collection, root: Path) -> str:
    """Return ``complete``, ``partial N of M``, ``absent`` or ``manual``, judged by names and sizes."""
    if not collection.items:
        found = all(any(_matches(collection, root, pattern)) for pattern in collection.patterns)
        return "complete" if found else "manual"
    there = len(collection.items) - len(absent(collection.items, root))
    if there in (0, len(collection.items)):
        return "complete" if there else "absent"
    return f"partial {there} of {len(collection.items)}"


def checksums_of(collection: Collection, root: Path) -> str:
    """Return ``pinned``, ``noted`` or ``unknown`` for the checksums that a collection's files have to have.

    dsr knows the pinned ones; the others are noted when the files first come. Several kinds are counted.
    """
    recorded = {name for name, entry in Checksums(root).items() if entry.sha256 is not None}
    if not collection.items:
        return "noted" if any(name.startswith(f"{collection.folders[0]}/") for name in recorded) else "unknown"
    kinds = Counter(
        "pinned" if item.sha256 is not None else "noted" if item.path in recorded else "unknown"
        for item in collection.items
    )
    return next(iter(kinds)) if len(kinds) == 1 else ", ".join(f"{count} {kind}" for kind, count in kinds.items())


def absent(items: Iterable[Item], root: Path) -> list[Item]:
    """Return the items that are not there, or not in their recorded sizes."""
    checksums = Checksums(root)
    return [item for item in items if _lack(item, checksums) is not None]


def verify(collection: Collection, root: Path, progress: Progress) -> list[str]:
    """Check the files of a collection against their records, and return what is wrong, a line each.

    Files without a record get one. Of unpacked archives the names and sizes of the files are checked.
    """
    with lock_directory(root):
        checksums = Checksums(root)
        problems: list[str | None] = []
        for item in collection.items:
            if item.unpack_to is not None and item.path not in checksums and (entry := _adopted(item, root)):
                checksums.found[item.path] = entry
                continue
            problem = _lack(item, checksums)
            if problem is None and item.unpack_to is None:
                problem = _difference(item.path, checksums, progress, item.sha256)
            problems.append(problem)
        if not collection.items:
            paths = {path for pattern in collection.patterns for path in _matches(collection, root, pattern)}
            names = sorted((path.relative_to(root).as_posix() for path in paths), key=natural_key)
            problems += _misses(collection, checksums)
            problems += [_difference(name, checksums, progress) for name in names]
        checksums.record_found(progress)
    return [problem for problem in problems if problem is not None]


def _difference(name: str, checksums: Checksums, progress: Progress, pinned: str | None = None) -> str | None:
    """Return how a file differs from its record or pinned checksum; one without an entry is found."""
    path = checksums.root / name
    try:
        digest = _checked_hash(name, path, str(path), checksums, progress, pinned)
    except (ValueError, OSError) as error:
        return str(error)
    if name not in checksums:
        checksums.found[name] = Entry(digest, path.stat().st_size)
    return None


def _checked_hash(
    name: str, path: Path, source: str, checksums: Checksums, progress: Progress, pinned: str | None
) -> str:
    """Return a file's checksum; one of another kind, or of another checksum, is refused, as ``source``."""
    with opened(path) as file:
        beginning = file.read(512)
    suffix = Path(name).suffix
    expected, skipped = _BEGINNINGS.get(suffix.lower()), _COUNTED.get(suffix.lower(), 0)
    plain = bool(beginning) and b"\0" not in beginning and not beginning.lstrip().startswith(b"<")  # no web page
    if not (beginning.startswith(expected, skipped) if expected else plain):
        raise ValueError(f"{source}: expected a {suffix} file, got one that begins with {beginning[:8]!r}")
    with progress.task(name, unit="bytes") as moved:
        digest = file_hash(path, moved)
    known = pinned or (checksums[name].sha256 if name in checksums else None)
    if known not in (None, digest):
        origin, cure = "which dsr knows", ""
        if pinned is None:
            origin, cure = f"as recorded in {checksums.path}", "; if the new one is right, delete the entry there"
        raise ValueError(f"{source}: expected sha256 {known}, {origin}, got {digest}{cure}")
    return digest


def _adopted(item: Item, root: Path) -> Entry | None:
    """Return an entry of an archive that the user unpacked, None where something is missing."""
    folder = root / (item.unpack_to or "")
    if not item.contains or not all((folder / name).is_dir() for name in item.contains):
        return None
    found = sorted(path for name in item.contains for path in (folder / name).rglob("*") if path.is_file())
    files = {path.relative_to(folder).as_posix(): path.stat().st_size for path in found}
    return Entry(None, sum(files.values()), files) if files else None


def _misses(collection: Collection, checksums: Checksums) -> Iterator[str]:
    """Yield what the user has not put in place, or has taken away."""
    root = checksums.root
    folder = root / collection.folders[0]
    by_hand = (collection.manual or "").format(folder=folder)
    advice = f"{by_hand}, then `dsr data verify {collection.name}`"
    for pattern in collection.patterns:
        if not any(_matches(collection, root, pattern)):
            yield f"{folder}: expected {pattern}, there is none: {advice}"
    for name in checksums:
        if name.startswith(f"{collection.folders[0]}/") and not (root / name).is_file():
            yield f"{root / name}: expected a file as recorded, there is none"


def _matches(collection: Collection, root: Path, pattern: str) -> Iterator[Path]:
    return (path for path in (root / collection.folders[0]).glob(pattern) if path.is_file())


def _lack(item: Item, checksums: Checksums) -> str | None:
    """Return what is missing of an item or has another size than recorded, None if nothing is."""
    root, entry = checksums.root, checksums.get(item.path)
    if item.unpack_to is None:
        files: Mapping[str, int | None] = {item.path: None if entry is None else entry.size}
    elif entry is None or entry.files is None:
        return f"{root / item.unpack_to}: expected what {Path(item.path).name} unpacks to, there is no record of it"
    else:
        files = entry.files
    for name, size in files.items():
        path = root / (item.unpack_to or "") / name
        if not path.is_file():
            return f"{path}: expected a file, there is none"
        if size not in (None, path.stat().st_size):
            return f"{path}: expected {size} bytes as recorded, got {path.stat().st_size}"
    return None
