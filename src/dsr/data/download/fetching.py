"""The files of data sets: fetched, unpacked, recorded in ``checksums.json`` with their SHA-256, and verified.

A file that comes for the first time is checked for what it claims to be; ever after it has to have the checksum that is
recorded then. Files are on disk under their names whole or not at all. Downloads go on where they stopped (HTTP range
requests, RFC 9110, sections 13.1.5 and 14).
"""

from __future__ import annotations

import contextlib
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
from typing import IO, Any, NamedTuple
from urllib.parse import unquote, urlsplit

import requests
from filelock import FileLock, Timeout
from requests.adapters import HTTPAdapter
from requests.auth import HTTPBasicAuth
from urllib3 import Retry
from urllib3.exceptions import HTTPError

from dsr.data.download.collections import Collection, Item
from dsr.utils.console import one_line
from dsr.utils.files import FullDiskError, expect_space, expect_target, space_for, temporary_folder, write_text
from dsr.utils.guards import files_in, leads_outside, natural_key, opened, parse_json, read_limited, refusing
from dsr.utils.progress import Progress, Task, megabytes
from dsr.utils.versions import file_hash

_BUSY = (408, 425, 429, 500, 502, 503, 504)
RETRIES = Retry(  # of a server that does not answer, or is busy
    3, backoff_factor=1.0, status_forcelist=_BUSY, raise_on_status=False, respect_retry_after_header=False
)
_TIMEOUT = (10.0, 60.0)  # seconds for a connection, and between two pieces of an answer
_UNPACKED = 1.25  # size of what an archive of pictures unpacks to, as a multiple of its own, for a check of the disk
_CHUNK = 1 << 16
_PAGE = (b"<!doctype", b"<html", b"<head")
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
        self.path = root / "checksums.json"
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

    def record_found(self, entries: Mapping[str, Entry], progress: Progress) -> None:
        """Record files that exist without a record, and report them."""
        names = list(entries)
        few = ", ".join(names) if len(names) < 4 else f"{names[0]}, {names[1]} and {len(names) - 2} more"
        try:
            if names:
                self.record(entries)
                progress.say(f"{self.path}: recorded as found: {few}")
        except OSError as error:
            progress.say(f"{self.path}: not written: {error}")


def _entry(name: str, fields: Any) -> Entry:
    """Return an entry from its JSON."""
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


def get(
    items: Iterable[Item],
    root: Path,
    progress: Progress,
    *,
    mirror: str | None = None,
    accept_changed: bool = False,
    keep_archives: bool = False,
) -> list[str]:
    """Fetch files that are missing or differ from their record; return what could not be had and why, a line each.

    An interruption keeps what has come of a file beside it, ``.part``, and the next call goes on from there. A full
    disk ends the call. ``mirror`` is the address of a server to try first, which has each file under its path; name
    and password in it, ``https://name:password@host``, are sent, and neither shown nor stored. ``accept_changed``
    takes files with another checksum than recorded. Archives that were there before are kept anyway.
    """
    problems: list[str] = []
    server = None if mirror is None else Server.of(mirror)
    root.mkdir(parents=True, exist_ok=True)
    with lock_directory(root):
        job = _Job(root, Checksums(root), progress, server, accept_changed, keep_archives)
        for item in {item.path: item for item in items}.values():
            try:
                job.get(item)
            except FullDiskError as error:
                return [*problems, f"{item.path}: {error}"]
            except (ValueError, OSError) as error:
                problems.append(f"{item.path}: {one_line(error)}")
    return problems


_Credentials = tuple[bytes, bytes] | None  # A name and a password, as they are sent


class Server(NamedTuple):
    """A server, and apart from its address the credentials, so that none is in a message or a file."""

    address: str
    credentials: _Credentials

    @classmethod
    def of(cls, given: str) -> Server:
        """Return the server of an address, which may have a name and a password."""
        scheme, _, rest = given.partition("://")
        before, at, place = rest.rpartition("@")
        address = f"{scheme}://{place}".rstrip("/")
        if scheme.lower() not in ("http", "https") or not urlsplit(address).netloc:
            shown = address if place else given.rpartition("@")[2]
            raise ValueError(f"--mirror: expected an address that begins with http:// or https://, got {shown!r}")
        if "/" in before:
            raise ValueError(f"--mirror: expected @ and / as %40 and %2F in an address with a password, got {place!r}")
        name, _, password = before.partition(":")
        return cls(address, (unquote(name).encode(), unquote(password).encode()) if at else None)


@dataclass(frozen=True)
class _Job:
    """Fetching, with the arguments of :func:`get`."""

    root: Path
    checksums: Checksums
    progress: Progress
    mirror: Server | None
    accept_changed: bool
    keep_archives: bool

    def get(self, item: Item) -> None:
        """Fetch an item unless it is there and good."""
        target, files = self.root / item.path, None
        given = target.is_file()
        if item.unpack_to is None and given and self._is_good(item):
            return
        if item.unpack_to is not None and _lack(item, self.root, self.checksums.get(item.path)) is None:
            return
        digest = self._digest(item, target, str(target)) if given and item.unpack_to is not None else self._fetch(item)
        text = f"{item.path}: {megabytes(target.stat().st_size)}"
        if item.unpack_to is not None:
            with self.progress.task(f"unpacking {item.path}", unit="bytes") as moved:
                files = unpack(target, self.root / item.unpack_to, moved, item.contains)
            text += f", unpacked to {len(files)} files"
        self.checksums.record({item.path: Entry(digest, target.stat().st_size, files)})
        self.progress.say(text)
        if item.unpack_to is not None and given:
            self.progress.say(f"{item.path}: was there before and is kept; it is not needed any more")
        elif item.unpack_to is not None and not self.keep_archives:
            target.unlink()

    def _is_good(self, item: Item) -> bool:
        """Return whether a file is as recorded; the user's own is recorded."""
        new: dict[str, Entry] = {}
        problem = _difference(item.path, self.root, self.checksums, new, self.progress, item.sha256)
        if problem is not None:
            self.progress.say(f"{problem}: fetching it again")
        self.checksums.record_found(new, self.progress)
        return problem is None

    def _fetch(self, item: Item) -> str:
        """Download a file from the first address that has it, and return its checksum."""
        sources: list[tuple[str, _Credentials]] = [(url, None) for url in item.urls]
        if self.mirror is not None:
            sources.insert(0, (f"{self.mirror.address}/{item.path}", self.mirror.credentials))
        problems = [] if sources else ["no address of it is known; --mirror URL names a server that has it"]
        for url, credentials in sources:
            try:
                return self._fetch_from(url, item, credentials)
            except ValueError as error:
                problems.append(str(error))
        raise ValueError("; ".join(dict.fromkeys(problems)))

    def _fetch_from(self, url: str, item: Item, credentials: _Credentials) -> str:
        """Download a file, check it, put it in place, and return its checksum."""
        target = self.root / item.path
        address, _, member = url.partition("#")
        part = target.with_name(f"{target.name}{'.zip' * bool(member)}.part")
        for path in (target, part):
            expect_target(path)
        with self.progress.task(item.path, unit="bytes") as moved:
            _download(address, part, moved, 0.0 if item.unpack_to is None else _UNPACKED, credentials)
        new = part.with_suffix(".member") if member else part
        try:
            if member:
                _take_member(part, member, new)
            _expect_kind(new, target.suffix, url)
            digest = self._digest(item, new, url)
            new.replace(target)
        except ValueError:
            _discard(new, part)
            raise
        _discard(part)
        return digest

    def _digest(self, item: Item, path: Path, source: str) -> str:
        """Return a file's checksum, which must be the recorded one if there is one."""
        entry = None if self.accept_changed else self.checksums.get(item.path)
        expected, digest = item.sha256 or (entry and entry.sha256), file_hash(path)
        if expected not in (None, digest):
            raise ValueError(
                f"{source}: expected sha256 {expected}, which dsr knows, got {digest}"
                if item.sha256 is not None
                else f"{source}: expected sha256 {expected} as recorded in {self.checksums.path}, got {digest}; "
                "if the new one is right, --accept-changed takes it"
            )
        return digest


def _download(url: str, part: Path, moved: Task, room: float, credentials: _Credentials = None) -> None:
    """Download a file, from where ``part`` ends on if the server can; a note beside it says of which version it is.

    ``room`` is how much more must be free on the disk afterwards, as a multiple of the file's size.
    """
    part.parent.mkdir(parents=True, exist_ok=True)
    with requests.Session() as session:
        session.auth = None if credentials is None else HTTPBasicAuth(*credentials)
        for scheme in ("http://", "https://"):
            session.mount(scheme, HTTPAdapter(max_retries=RETRIES))
        while True:
            most = _size(part)
            try:
                return _transfer(session, url, part, moved, room)
            except _BrokenOffError:
                emptied = most > _size(part) == 0  # it did not fit
                if _size(part) <= most and not emptied:
                    raise


def _transfer(session: requests.Session, url: str, part: Path, moved: Task, room: float) -> None:
    """Ask once for what is missing, and write what comes."""
    note = _read_note(part, url)
    have = _size(part) if note else 0
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if note["mark"]:
            headers["If-Range"] = note["mark"]
    try:
        with session.get(url, headers=headers, stream=True, timeout=_TIMEOUT) as response:
            start, total = _extent(url, response, part, have, note)
            if start != total:
                expect_space(part, (total or 0) * (1 + room) - start)
                etag = response.headers.get("ETag", "")  # a weak one does not vouch for single bytes
                mark = etag if etag.startswith('"') else response.headers.get("Last-Modified")
                write_text(_note(part), json.dumps({"url": url, "mark": mark, "total": total}))
                with space_for(part):
                    _write(url, response, part, start, total, moved)
    except requests.exceptions.SSLError as error:
        raise ValueError(f"{url}: expected a certificate that can be trusted, got: {error}") from error
    except (requests.ConnectionError, requests.Timeout) as error:
        raise ValueError(f"{url}: no connection to {urlsplit(url).netloc}") from error
    except requests.RequestException as error:
        raise ValueError(f"{url}: {one_line(error)}") from error
    except HTTPError as error:
        raise _BrokenOffError(f"{url}: the connection broke off") from error


def _extent(
    url: str, response: requests.Response, part: Path, have: int, note: Mapping[str, Any]
) -> tuple[int, int | None]:
    """Return where the answer's bytes start in the file, and how many the file has; equal for nothing to come."""
    match = re.fullmatch(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", response.headers.get("Content-Range", "").strip())
    first, total = (int(each) if each and each != "*" else None for each in (match.groups() if match else (None, None)))
    if response.status_code == requests.codes.ok:
        encoding = response.headers.get("Content-Encoding", "identity").lower()
        if encoding != "identity" and not url.lower().endswith(("gz", ".tgz")):
            raise ValueError(f"{url}: expected the file as it is, got it compressed ({encoding})")
        length = response.headers.get("Content-Length", "")
        if length == "0":
            raise ValueError(f"{url}: expected a file, got an empty one")
        return 0, int(length) if length.isdigit() else None
    whole = response.status_code == requests.codes.requested_range_not_satisfiable
    if have and (whole or response.status_code == requests.codes.partial):
        if (whole and total == have) or (first == have and note["total"] in (None, total)):
            return have, total
        _discard(part)
        raise _BrokenOffError(f"{url}: what is there of it ({have} bytes) does not fit")
    raise ValueError(f"{url}: HTTP {response.status_code} {response.reason or ''}".rstrip())


def _write(url: str, response: requests.Response, part: Path, start: int, total: int | None, moved: Task) -> None:
    """Write an answer to the end of ``part``, or over it where it starts at 0."""
    done = start
    moved(done, total)
    with part.open("ab" if start else "wb") as file:
        for chunk in response.raw.stream(_CHUNK, decode_content=False):
            if done == 0 and _is_page(chunk):
                _discard(part)
                raise ValueError(f"{url}: expected a file, got a web page")
            file.write(chunk)
            file.flush()
            done += len(chunk)
            moved(done, total)
    if total is not None and done != total:
        raise _BrokenOffError(f"{url}: the connection broke off after {done} of {total} bytes")


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _note(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _discard(*parts: Path) -> None:
    """Delete files, and the notes beside them."""
    for part in parts:
        part.unlink(missing_ok=True)
        _note(part).unlink(missing_ok=True)


def _read_note(part: Path, url: str) -> dict[str, Any]:
    """Return what is known of the version that ``part`` is the beginning of; empty where it may be of another."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        note = parse_json(read_limited(_note(part)))
        mark, total = note["mark"], note["total"]
        if isinstance(mark, str | None) and type(total) in (int, type(None)) and (mark or note["url"] == url):
            return {"mark": mark, "total": total}
    return {}


def unpack(archive: Path, target: Path, moved: Task, contains: Sequence[str] = ()) -> dict[str, int]:
    """Unpack a zip or tar archive into a directory, and return the sizes of the files by their path in it.

    Everything is unpacked beside ``target`` first; an interruption before the end leaves nothing in it. Links become
    copies of the files that they lead to; those to directories are left out. An archive that is damaged, lacks one of
    ``contains``, or has a member that leads outside ``target`` is refused.
    """
    files: dict[str, int] = {}
    with temporary_folder(target.parent, target.name) as work:
        with _damage(archive), _members(archive) as members:
            done, total = 0, sum(member.size for member in members)
            expect_space(work, total)
            for member in members:
                source = member.open()
                if source is None:  # a link to a directory
                    continue
                path = work / member.name.replace("\\", "/")
                path.parent.mkdir(parents=True, exist_ok=True)
                with source, path.open("wb") as sink:
                    shutil.copyfileobj(source, sink, _CHUNK)
                files[path.relative_to(work).as_posix()] = path.stat().st_size
                moved(done := done + member.size, total)
        missing = [name for name in contains if not (work / name).exists()]
        if missing:
            raise ValueError(f"{archive}: expected {', '.join(missing)} in it, there is none")
        shutil.copytree(work, target, copy_function=os.replace, dirs_exist_ok=True)
    return files


class _Member(NamedTuple):
    """A file or a link in an archive."""

    name: str
    size: int
    open: Callable[[], IO[bytes] | None]


@contextlib.contextmanager
def _members(archive: Path) -> Iterator[list[_Member]]:
    """Yield the files of an archive; one with what is no file, or leads outside, is refused."""
    with opened(archive) as file, contextlib.ExitStack() as stack:
        if file.read(2) == b"PK":
            packed = stack.enter_context(zipfile.ZipFile(archive))
            entries = files_in(packed, archive)
            members = [_Member(each.filename, each.file_size, partial(packed.open, each)) for each in entries]
        else:
            tar = stack.enter_context(tarfile.open(archive))
            files = [each for each in tar.getmembers() if not each.isdir()]
            try:
                for info in files:
                    tarfile.data_filter(info, str(archive.parent))
            except tarfile.FilterError as error:
                raise ValueError(f"{archive}: refused: {error}") from error
            members = [_Member(each.name, each.size, partial(tar.extractfile, each)) for each in files]
        for name in filter(leads_outside, (member.name for member in members)):
            raise ValueError(f"{archive}: refused: {name!r} in it leads outside the directory it belongs into")
        yield members


@contextlib.contextmanager
def _damage(archive: Path) -> Iterator[None]:
    """Make one line of what a damaged archive raises."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise ValueError(f"{archive}: expected an archive, got a damaged one: {one_line(error)}") from error


def _take_member(archive: Path, name: str, path: Path) -> None:
    """Write one member of a zip archive to ``path``."""
    with (
        _damage(archive), space_for(path), zipfile.ZipFile(archive) as packed, packed.open(name) as source,
        path.open("wb") as sink,
    ):  # fmt: skip
        shutil.copyfileobj(source, sink, _CHUNK)


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
        for item in {item.path: item for item in collection.items}.values()
    )
    return next(iter(kinds)) if len(kinds) == 1 else ", ".join(f"{count} {kind}" for kind, count in kinds.items())


def absent(items: Iterable[Item], root: Path) -> list[Item]:
    """Return the items that are not there, or not in their recorded sizes; each path once."""
    checksums = Checksums(root)
    by_path = {item.path: item for item in items}
    return [item for item in by_path.values() if _lack(item, root, checksums.get(item.path)) is not None]


def verify(collection: Collection, root: Path, progress: Progress, *, accept_changed: bool = False) -> list[str]:
    """Check the files of a collection against their records, and return what is wrong, a line each.

    Files without a record get one; ``accept_changed`` records anew what differs. Of unpacked archives the names and
    sizes of the files are checked.
    """
    new: dict[str, Entry] = {}
    with lock_directory(root):
        checksums = Checksums(root)
        old: Mapping[str, Entry] = {} if accept_changed else checksums
        found = [_problem(item, root, old, new, progress) for item in collection.items]
        if not collection.items:
            paths = {path for pattern in collection.patterns for path in _matches(collection, root, pattern)}
            names = sorted((path.relative_to(root).as_posix() for path in paths), key=natural_key)
            found += _misses(collection, root, checksums)
            found += [_difference(name, root, old, new, progress) for name in names]
        checksums.record_found(new, progress)
    return [problem for problem in found if problem is not None]


def _problem(item: Item, root: Path, old: Mapping[str, Entry], new: dict[str, Entry], progress: Progress) -> str | None:
    """Return what is wrong with an item; ``new`` takes the entry of one that has none."""
    entry = old.get(item.path)
    if item.unpack_to is not None and entry is None and (entry := _adopted(item, root)) is not None:
        new[item.path] = entry
    problem = _lack(item, root, entry)
    if problem is None and item.unpack_to is None:
        problem = _difference(item.path, root, old, new, progress, item.sha256)
    return problem


def _difference(
    name: str, root: Path, old: Mapping[str, Entry], new: dict[str, Entry], progress: Progress, known: str | None = None
) -> str | None:
    """Return how a file differs from its record or known checksum; ``new`` takes the entry of one without record."""
    path, entry = root / name, old.get(name)
    expected = known or (entry and entry.sha256)
    try:
        _expect_kind(path, path.suffix, str(path))
        with progress.task(name, unit="bytes") as moved:
            digest = file_hash(path, moved)
    except (ValueError, OSError) as error:
        return str(error)
    if expected not in (None, digest):
        return f"{path}: expected sha256 {expected} as recorded, got {digest}"
    if entry is None:
        new[name] = Entry(digest, path.stat().st_size)
    return None


def _is_page(beginning: bytes) -> bool:
    """Return whether a file that begins like this is a web page."""
    return beginning.removeprefix(b"\xef\xbb\xbf").lstrip()[:9].lower().startswith(_PAGE)


def _expect_kind(path: Path, suffix: str, source: str) -> None:
    """Check that a file begins as one with this suffix does; ``source`` is what the message calls it."""
    with opened(path) as file:
        beginning = file.read(512)
    expected, skipped = _BEGINNINGS.get(suffix.lower()), _COUNTED.get(suffix.lower(), 0)
    if _is_page(beginning):
        raise ValueError(f"{source}: expected a {suffix} file, got a web page")
    right = beginning.startswith(expected, skipped) if expected else bool(beginning) and b"\0" not in beginning
    if not right:
        raise ValueError(f"{source}: expected a {suffix} file, got one that begins with {beginning[:8]!r}")


def _adopted(item: Item, root: Path) -> Entry | None:
    """Return an entry of an archive that the user unpacked, None where something is missing."""
    folder = root / (item.unpack_to or "")
    if not item.contains or not all((folder / name).is_dir() for name in item.contains):
        return None
    found = sorted(path for name in item.contains for path in (folder / name).rglob("*") if path.is_file())
    files = {path.relative_to(folder).as_posix(): path.stat().st_size for path in found}
    return Entry(None, sum(files.values()), files) if files else None


def _misses(collection: Collection, root: Path, checksums: Checksums) -> Iterator[str]:
    """Yield what the user has not put in place, or has taken away."""
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
    """Yield the files that the user put in place."""
    return (path for path in (root / collection.folders[0]).glob(pattern) if path.is_file())


def _lack(item: Item, root: Path, entry: Entry | None) -> str | None:
    """Return what is missing of an item or has another size than recorded, None where nothing is."""
    if item.unpack_to is not None and (entry is None or entry.files is None):
        return f"{root / item.unpack_to}: expected what {Path(item.path).name} unpacks to, there is no record of it"
    files = {item.path: entry and entry.size} if item.unpack_to is None or entry is None else entry.files or {}
    for name, size in files.items():
        path = root / (item.unpack_to or "") / name
        if not path.is_file():
            return f"{path}: expected a file, there is none"
        if size not in (None, path.stat().st_size):
            return f"{path}: expected {size} bytes as recorded, got {path.stat().st_size}"
    return None
