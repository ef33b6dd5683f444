"""Downloads that go on where they stopped (HTTP range requests, RFC 9110, sections 13.1.5 and 14)."""

from __future__ import annotations

import contextlib
import errno
import json
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import requests
import urllib3

from dsr.utils.console import one_line
from dsr.utils.files import write_text
from dsr.utils.parsing import parse_json
from dsr.utils.progress import Task
from dsr.utils.units import megabytes

PAUSES = (1.0, 3.0, 9.0)
"""Seconds before each further try where a connection fails."""
_TIMEOUT = (10.0, 60.0)
"""Seconds for a connection, and between two pieces of an answer."""
_CHUNK = 1 << 16
_BUSY = (408, 425, 429, 500, 502, 503, 504)
"""HTTP states that may pass."""
_PAGE = (b"<!doctype", b"<html", b"<head")


class FetchError(ValueError):
    """What could not be fetched, and why, in one line."""


class UnreachableError(FetchError):
    """A server that cannot be reached."""


class NoSpaceError(FetchError):
    """A disk that is too small."""


class _TryAgainError(Exception):
    """A failure that may pass; ``reached`` says whether the server answered."""

    def __init__(self, reason: str, *, reached: bool = True) -> None:
        super().__init__(reason)
        self.reached = reached


def download(url: str, part: Path, moved: Task, *, room: float = 0.0, pauses: Sequence[float] | None = None) -> None:
    """Download a file, from where ``part`` ends on if the server can.

    Args:
        url: its address.
        part: the file to write. After an error it is kept for the next time, except where its content is of no use.
            A note beside it, ``.json``, holds the server's mark of the version.
        moved: is told how many bytes there are, and of how many.
        room: how much more must be free on the disk afterwards, as a multiple of the file's size.
        pauses: seconds before each further try; :data:`PAUSES` where None.

    Raises:
        UnreachableError: there is no connection.
        NoSpaceError: the disk is full, or has too little space for the file.
        FetchError: the server has no such file, or sends something else.

    """
    part.parent.mkdir(parents=True, exist_ok=True)
    waits, most = iter(PAUSES if pauses is None else pauses), _size(part)
    while True:
        try:
            _transfer(url, part, moved, room)
        except _TryAgainError as error:
            if _size(part) > most:
                waits, most = iter(PAUSES if pauses is None else pauses), _size(part)
            wait = next(waits, None)
            if wait is None:
                raise (FetchError if error.reached else UnreachableError)(f"{url}: {error}") from error
            time.sleep(wait)
        else:
            _note(part).unlink(missing_ok=True)
            return


def expect_room(folder: Path, needed: float) -> None:
    """Check that the disk has space.

    Raises:
        NoSpaceError: it has less than ``needed`` bytes.

    """
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise NoSpaceError(f"{folder}: expected {megabytes(needed)} of free disk space, there are {megabytes(free)}")


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Make one line of a disk that is full.

    Raises:
        NoSpaceError: the block ran out of space.

    """
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise NoSpaceError(f"{path}: the disk is full; make space, the same command goes on from there") from error


def _transfer(url: str, part: Path, moved: Task, room: float) -> None:
    """Ask once for what is missing, and write what comes."""
    note = _read_note(part, url)
    have = _size(part) if note else 0
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if note["mark"]:
            headers["If-Range"] = note["mark"]
    try:
        with requests.get(url, headers=headers, stream=True, timeout=_TIMEOUT) as response:
            start, total = _extent(url, response, part, have, note)
            if start != total:
                with disk_errors(part):
                    expect_room(part.parent, (total or 0) * (1 + room) - start)
                    _write_note(part, url, response, total)
                    _write(url, response, part, start, total, moved)
    except requests.exceptions.SSLError as error:
        raise FetchError(f"{url}: expected a certificate that can be trusted, got: {error}") from error
    except (requests.ConnectionError, requests.Timeout) as error:
        raise _TryAgainError(f"no connection to {urlsplit(url).netloc}", reached=False) from error
    except requests.RequestException as error:
        raise FetchError(f"{url}: {one_line(error)}") from error
    except urllib3.exceptions.HTTPError as error:
        raise _TryAgainError("the connection broke off") from error


def _extent(
    url: str, response: requests.Response, part: Path, have: int, note: dict[str, Any]
) -> tuple[int, int | None]:
    """Return where the answer's bytes start in the file, and how many the file has; equal for nothing to come."""
    came = response.headers.get("Content-Range", "")
    match = re.fullmatch(r"bytes (?:(\d+)-\d+|\*)/(\d+|\*)", came.strip())
    first = int(match[1]) if match and match[1] else None
    total = int(match[2]) if match and match[2] != "*" else None
    if response.status_code == requests.codes.ok:
        encoding = response.headers.get("Content-Encoding", "identity").lower()
        if encoding != "identity" and not url.lower().endswith(("gz", ".tgz")):
            raise FetchError(f"{url}: expected the file as it is, got it compressed ({encoding})")
        length = response.headers.get("Content-Length", "")
        if length == "0":
            raise FetchError(f"{url}: expected a file, got an empty one")
        return 0, int(length) if length.isdigit() else None
    if have and response.status_code in (requests.codes.partial, requests.codes.requested_range_not_satisfiable):
        whole = response.status_code == requests.codes.requested_range_not_satisfiable and total == have
        fits = whole or (first == have and note["total"] in (None, total))
        if fits:
            return have, total
        part.unlink(missing_ok=True)
        raise _TryAgainError(f"what is there of it ({have} bytes) does not fit")
    reason = f"HTTP {response.status_code} {response.reason or ''}".strip()
    if response.status_code in _BUSY:
        raise _TryAgainError(reason)
    raise FetchError(f"{url}: {reason}")


def _write(url: str, response: requests.Response, part: Path, start: int, total: int | None, moved: Task) -> None:
    """Write an answer to the end of ``part``, or over it where it starts at 0."""
    done = start
    moved(done, total)
    with part.open("ab" if start else "wb") as file:
        for chunk in response.raw.stream(_CHUNK, decode_content=False):
            if done == 0 and is_page(chunk):
                part.unlink()
                _note(part).unlink(missing_ok=True)
                raise FetchError(f"{url}: expected a file, got a web page")
            file.write(chunk)
            file.flush()
            done += len(chunk)
            moved(done, total)
    if total is not None and done != total:
        raise _TryAgainError(f"the connection broke off after {done} of {total} bytes")


def is_page(beginning: bytes) -> bool:
    """Return whether a file that begins like this is a web page."""
    return beginning.removeprefix(b"\xef\xbb\xbf").lstrip()[:9].lower().startswith(_PAGE)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _note(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _read_note(part: Path, url: str) -> dict[str, Any]:
    """Return what is known of the version that ``part`` is the beginning of; empty where it may be of another."""
    try:
        note = parse_json(_note(part).read_text(encoding="utf-8"))
        known = {"mark": note["mark"], "total": note["total"]}
        if not isinstance(known["mark"], str | None) or isinstance(known["total"], bool):
            return {}
        return known if note["url"] == url or known["mark"] else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _write_note(part: Path, url: str, response: requests.Response, total: int | None) -> None:
    """Keep the server's mark of the version; a weak ETag does not vouch for single bytes."""
    etag = response.headers.get("ETag", "")
    mark = etag if etag.startswith('"') else response.headers.get("Last-Modified")
    write_text(_note(part), json.dumps({"url": url, "mark": mark, "total": total}))
