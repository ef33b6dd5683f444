"""Guards against hostile files: limits of the memory that one takes, and checks of its numbers, JSON and names.

A few kilobytes of compressed zeros declare gigabytes. What is allowed grows with what can explain it: a map's size with
its photo's, otherwise the unpacked size with the size of the file. Real photos and maps stay far below.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Collection, Iterable, Iterator
from io import BufferedReader
from numbers import Real
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, NoReturn, TypeGuard

MOST_PIXELS = 1 << 27
"""Largest number of pixels of a photo or map, 134 megapixels."""
MOST_FILE = 1 << 30
"""Largest size in bytes of a picture or map that is read at once."""
MOST_TEXT = 1 << 24
"""Largest size in bytes of JSON and text about a run, a result or a camera."""
MOST_TABLE = 1 << 26
"""Largest size in bytes of a table."""
MOST_FACES, MOST_POINTS = 25_000_000, 20_000_000
"""Largest numbers of triangles and points that are written unless others are asked for."""
_PIXELS, _PIXELS_PER_BYTE = 1 << 25, 64
"""Pixels that any file may have, and that each byte of a larger one explains; photos as JPEG have at most 20."""
_UNPACKED, _RATIO = 1 << 28, 16
"""Bytes that any archive of arrays may unpack to, and that each byte of a larger one explains."""
_PER_PHOTO, _FLOOR = 4, 1 << 22
"""Pixels of a map for each of its photo's, and pixels that any photo explains."""
_CHUNK = 1 << 20

_MOST_DIGITS = 300
"""Digits of a whole number that a float can still hold."""

_LONGEST = 100
"""Characters of a name that a message shows."""
_TURNS = re.compile("([0-9]+|/)")
_WITH_COMMA = re.compile(r"[-+]?(\d+(,\d+)?(e[-+]?\d+)?|nan|inf)", re.ASCII | re.IGNORECASE)
NaturalKey = tuple[tuple[str | tuple[int, str], ...], str]
"""Texts and numbers of a name in turns, numbers as their number of digits and the digits, ``/`` as -1; and the name."""


class TooLargeError(ValueError):
    """A file or what its header declares is larger than :mod:`dsr.utils.guards` allows."""


def expect_pixels(place: str | Path, height: int, width: int, most: int = MOST_PIXELS) -> None:
    """Raise TooLargeError if a picture or map declares more than ``most`` pixels."""
    if height * width > most:
        raise TooLargeError(f"{place}: expected at most {most} pixels, got {width} x {height} (width x height)")


def expect_bytes(place: str | Path, size: int, most: int) -> None:
    """Raise TooLargeError if something declares that it takes more than ``most`` bytes in memory."""
    if size > most:
        raise TooLargeError(f"{place}: expected at most {most} bytes, got {size}")


def pixels_of_file(size: int) -> int:
    """Return how many pixels a picture file of ``size`` bytes may have."""
    return min(MOST_PIXELS, max(_PIXELS, _PIXELS_PER_BYTE * size))


def pixels_beside(height: int, width: int) -> int:
    """Return the largest number of pixels of a map that is read beside a photo or map of this size.

    It allows more than fits, so that the message of a map that is too large can state both sizes.
    """
    return min(MOST_PIXELS, max(_FLOOR, _PER_PHOTO * height * width))


def bytes_of_archive(size: int) -> int:
    """Return to how many bytes an archive of arrays of ``size`` bytes may unpack."""
    return max(_UNPACKED, _RATIO * size)


def array_bytes(shape: tuple[int, ...], itemsize: int) -> int:
    """Return the size of an array, in Python's numbers, which do not overflow."""
    return math.prod(map(int, shape)) * itemsize


def read_limited(path: Path, most: int = MOST_TEXT) -> bytes:
    """Return the content of a file of at most ``most`` bytes."""
    with opened(path) as file:
        expect_bytes(path, path.stat().st_size, most)
        return file.read(most)


def read_text(path: Path, most: int = MOST_TABLE) -> str:
    """Return the text of a user's file, see :func:`decode_text`; ValueError if there is none."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, there is none")
    return decode_text(read_limited(path, most))


def decode_text(content: bytes) -> str:
    """Return text in UTF-8 or UTF-16, as the byte order mark or the zeros in it show; the mark is left out."""
    return content.decode(json.detect_encoding(content), "replace")


@contextlib.contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """Open a plain file for reading; a pipe or device is an OSError, and each OSError has the file's name."""
    if not path.is_file():
        code = errno.EISDIR if path.is_dir() else errno.EINVAL if path.exists() else errno.ENOENT
        raise OSError(code, os.strerror(code), str(path))
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def expect_stored(path: Path) -> None:
    """Check that no member of a torch file, if it is there, is compressed or shared; torch writes none so."""
    if not path.exists():
        return
    with opened(path) as file:
        if not zipfile.is_zipfile(file):  # as of torch before version 1.6
            return
    with zipfile.ZipFile(path) as packed:
        members = packed.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError(f"{path}: expected members that are not compressed")
    expect_bytes(path, sum(member.file_size for member in members), path.stat().st_size)


def files_in(packed: zipfile.ZipFile, archive: object) -> list[zipfile.ZipInfo]:
    """Return the files of an archive; a ValueError if one is no file, has no name or leads outside."""
    entries = [each for each in packed.infolist() if not each.filename.endswith("/")]
    for each in entries:
        if not each.filename:
            raise ValueError(f"{archive}: refused: a file in it has no name")
        if stat.S_IFMT(each.external_attr >> 16) not in (0, stat.S_IFREG):
            raise ValueError(f"{archive}: refused: {each.filename!r} in it is neither a file nor a directory")
        if leads_outside(each.filename):
            raise ValueError(f"{archive}: refused: {each.filename!r} in it leads outside the directory it belongs into")
    return entries


def read_member(packed: zipfile.ZipFile, name: str) -> bytes:
    """Return a member of an archive, in no more memory than the size that the archive declares for it.

    The caller checks that size. A member that unpacks to more, which :meth:`zipfile.ZipFile.read` unpacks whole before
    it cuts it off, is damaged.
    """
    declared = packed.getinfo(name).file_size
    parts, length = [], 0
    with packed.open(name) as member:
        while part := member.read(_CHUNK):
            parts.append(part)
            length += len(part)
    if length != declared:
        raise zipfile.BadZipFile(f"{name}: {length} bytes instead of {declared}")
    return b"".join(parts)


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value is a finite number; true and false are none, and neither is 10**400."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def numbers_in(words: Iterable[str]) -> list[float]:
    """Return words as numbers, infinite ones and NaN among them; nothing if one is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def split_numbers(text: str) -> list[str]:
    """Return the words between blanks, commas and semicolons; if no word has a point, a comma inside a word is one."""
    words = text.replace(";", " ").split()
    if all(_WITH_COMMA.fullmatch(word) for word in words):
        return [word.replace(",", ".") for word in words]
    return text.replace(";", " ").replace(",", " ").split()


@contextlib.contextmanager
def naming(place: object) -> Iterator[None]:
    """Begin the message of a ValueError that comes from within with the place that it is about, such as a file."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def expect_one_of(key: str, value: object, known: Collection[str | None]) -> None:
    """Raise a ValueError if a key's value is not one of those that are known."""
    if value not in known:
        names = ", ".join("null" if each is None else each for each in known)
        raise ValueError(f"{key}: expected one of {names}, got {value!r}")


@contextlib.contextmanager
def refusing(message: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise a ValueError with a message in place of the errors from within that stand for something unexpected."""
    try:
        yield
    except kinds as error:
        raise ValueError(message) from error


def readable(name: str) -> str:
    """Return a file's name as text: bytes that are no UTF-8, which Python reads as surrogates, are escaped."""
    return name.encode(errors="backslashreplace").decode()


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """Parse JSON strictly: without NaN and infinity, and without numbers that no float can hold.

    Args:
        finite: whether NaN and infinity, which Python writes and JSON does not have, are refused.

    """
    only: Any = {"parse_constant": _refuse, "parse_float": _parse_float} if finite else {}
    with refusing("nested too deeply", RecursionError):
        return json.loads(text, parse_int=_parse_int, **only)


def _refuse(text: str) -> NoReturn:
    raise ValueError(f"expected finite numbers, got {text[:20]}")


def _parse_int(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        _refuse(text)
    return int(text)


def _parse_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        _refuse(text)
    return value


class OutsideError(ValueError):
    """A name in a file leads out of the folder that it belongs to."""


def leads_outside(name: str) -> bool:
    """Return whether a name leads out of its folder on any system: absolute, with ``..``, of a drive, or with NUL."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or "\0" in name or re.match("[A-Za-z]:", name) is not None


def path_within(folder: Path, name: str, source: object, form: str = "{}") -> Path:
    """Return the path of a file that another file names; OutsideError if it is not in a folder or below it.

    The folder may be a link; links that the name leads through may not lead out of it.

    Args:
        source: what gives the name, such as ``FILE: line 3``, for the message.
        form: the path that the name is a part of, from the folder on, with ``{}`` for the name.

    """
    expected = f"{source}: expected a name within {folder}, got {name[:_LONGEST]!r}"
    if leads_outside(name):
        raise OutsideError(expected)
    path = folder / form.format(name)
    if "\\" in name and not path.exists():  # of a list that Windows wrote
        path = folder / form.format(name.replace("\\", "/"))
    real = Path(os.path.realpath(path))  # unlike resolve, it takes loops
    if not real.is_relative_to(os.path.realpath(folder)):
        raise OutsideError(f"{expected}, a link to {real}; name the folder that has the files themselves, or copy them")
    return path


def natural_key(name: str | PurePath) -> NaturalKey:
    """Return a key that sorts names, or paths folder by folder, with the numbers in them by value: 2 before 10."""
    text = str(name).replace(os.sep, "/")
    parts: list[str | tuple[int, str]] = list(_TURNS.split(text))
    for place in range(1, len(parts), 2):
        digits = str(parts[place]).lstrip("0")
        parts[place] = (-1, "") if digits == "/" else (len(digits), digits)
    return tuple(parts), text
