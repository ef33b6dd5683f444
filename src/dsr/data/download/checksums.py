"""What was fetched, and its SHA-256: ``checksums.json`` in the directory of the data sets."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from dsr.utils.files import write_text
from dsr.utils.limits import opened, read_limited
from dsr.utils.parsing import parse_json
from dsr.utils.paths import leads_outside
from dsr.utils.progress import Task

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Entry:
    """What is known of a file.

    Args:
        sha256: its checksum; None for an archive that the user unpacked.
        size: in bytes.
        files: of an archive, the sizes of the files that it unpacked to, by their path in its directory.

    """

    sha256: str | None
    size: int
    files: Mapping[str, int] | None = None


class Checksums(Mapping[str, Entry]):
    """The entries of ``checksums.json``, by path below the directory of the data sets.

    Args:
        root: that directory.

    Raises:
        ValueError: the file is damaged.

    """

    def __init__(self, root: Path) -> None:
        self.path = root / "checksums.json"
        self._entries: dict[str, Entry] = {}
        if self.path.is_file():
            try:
                entries = parse_json(read_limited(self.path))
                self._entries = {str(name): _entry(str(name), fields) for name, fields in entries.items()}
            except (ValueError, TypeError, AttributeError) as error:
                raise ValueError(
                    f"{self.path}: expected the checksums of the data sets, got a damaged file ({error}); delete it to "
                    "record them anew"
                ) from error

    def __getitem__(self, name: str) -> Entry:
        return self._entries[name]

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def update(self, entries: Mapping[str, Entry]) -> None:
        """Add entries, or change them, and write the file."""
        self._entries.update(entries)
        fields = {
            name: {key: value for key, value in asdict(entry).items() if value is not None}
            for name, entry in sorted(self._entries.items())
        }
        write_text(self.path, json.dumps(fields, indent=1) + "\n")


def _entry(name: str, fields: Any) -> Entry:
    """Return an entry from its JSON."""
    sha256, size, files = fields.get("sha256"), fields.get("size"), fields.get("files")
    digest = sha256 is None or (isinstance(sha256, str) and re.fullmatch(r"[0-9a-f]{64}", sha256) is not None)
    sizes = files is None or all(map(_is_size, files.values()))
    if not (_is_size(size) and digest and sizes):
        raise ValueError(f"{fields!s:.60} is no entry")
    for each in filter(leads_outside, (name, *(files or ()))):
        raise ValueError(f"{each[:60]!r} leads outside of the directory")
    return Entry(sha256, size, files)


def _is_size(value: Any) -> bool:
    """Return whether a value is a number of bytes."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def sha256_of(path: Path, moved: Task | None = None) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    digest, done, total = hashlib.sha256(), 0, path.stat().st_size
    with opened(path) as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            done += len(chunk)
            if moved is not None:
                moved(done, total)
    return digest.hexdigest()


@contextlib.contextmanager
def lock_directory(root: Path) -> Iterator[None]:
    """Lock the directory of the data sets, if it exists and can be written, against other ``dsr data`` commands.

    Raises:
        ValueError: another command has locked it.

    """
    if not os.access(root, os.W_OK):
        yield
        return
    try:
        with FileLock(root / ".dsr-data.lock", blocking=False):
            yield
    except Timeout as error:
        raise ValueError(f"{root}: another `dsr data` command is writing there; wait for it to end") from error
