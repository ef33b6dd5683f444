"""Guards: the memory of a command, files that strangers wrote, and checks of numbers, JSON and names of files.

A few kilobytes of compressed zeros unpack to gigabytes: :func:`limit_memory` ends that in one place. Sizes that a
picture's header states are checked before it is decoded: a depth map may have 4 times the pixels of its photo.
"""

import contextlib
import errno
import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping
from difflib import get_close_matches
from io import BufferedReader
from numbers import Real
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, NoReturn, TypeGuard, TypeVar

from dsr.utils.progress import megabytes

MOST_PIXELS = 1 << 27  # of a photo or map, 134 megapixels
MOST_FILE = 1 << 30  # bytes of a picture or map that is read at once
MOST_TEXT = 1 << 24  # bytes of JSON and text about a run, a result or a camera
MOST_TABLE = 1 << 26  # bytes of a table
MOST_FACES, MOST_POINTS = 25_000_000, 20_000_000  # triangles and points that are written unless others are asked for
_PIXELS, _PIXELS_PER_BYTE = 1 << 25, 64  # that any file may have, and that each byte of a larger one explains (JPEG 20)
_UNPACKED, _RATIO = 1 << 28, 16  # bytes that any archive of arrays may unpack to, and that each byte of it explains
_PER_PHOTO, _FLOOR = 4, 1 << 22  # pixels of a map for each of its photo's, and pixels that any photo explains
_TOO_LITTLE = "not enough memory; a smaller size, scale or batch, or fewer workers need less"
_NO_LIMIT = 1 << 40  # bytes of memory assumed where the system does not report them
_MOST_NEEDED = 1e300  # bytes that a message can still name
_OF_ALLOCATORS = ("allocate memory", "not enough memory", "Insufficient memory", "out of memory")  # in their errors
_MOST_DIGITS = 300  # of a whole number that a float can still hold
_LONGEST = 100  # characters of a name that a message shows
_TURNS = re.compile("([0-9]+|/)")
_WITH_COMMA = re.compile(r"[-+]?(\d+(,\d+)?(e[-+]?\d+)?|nan|inf)", re.ASCII | re.IGNORECASE)
# Limits of a container's memory (cgroup version 2 and 1), of which there are none on a machine as such.
_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_Record = TypeVar("_Record")


class TooLargeError(ValueError):
    """A file or what its header declares is larger than :mod:`dsr.utils.guards` allows."""


def expect_pixels(place: str | Path, height: int, width: int, most: int = MOST_PIXELS) -> None:
    """Raise TooLargeError if a picture or map declares more than ``most`` pixels."""
    if height * width > most:
        raise TooLargeError(f"{place}: expected at most {most} pixels, got {width} x {height} (width x height)")


def expect_size(expected: str, pixels: Any, size: tuple[int, int]) -> None:
    """Raise a ValueError if pixels, (H, W) or (H, W, C), are not of a size; the message begins with ``expected``."""
    got = pixels.shape
    if got[:2] != size:
        raise ValueError(f"{expected} {size[1]} x {size[0]} pixels (width x height), got {got[1]} x {got[0]}")


def expect_bytes(place: str | Path, size: int, most: int) -> None:
    """Raise TooLargeError if something declares that it takes more than ``most`` bytes in memory."""
    if size > most:
        raise TooLargeError(f"{place}: expected at most {most} bytes, got {size}")


def pixels_of_file(size: int) -> int:
    """Return how many pixels a picture file of ``size`` bytes may have."""
    return min(MOST_PIXELS, max(_PIXELS, _PIXELS_PER_BYTE * size))


def pixels_beside(height: int, width: int) -> int:
    """Return the largest number of pixels of a map that is read beside a photo: more than fits, to state both sizes."""
    return min(MOST_PIXELS, max(_FLOOR, _PER_PHOTO * height * width))


def bytes_of_archive(size: int) -> int:
    """Return to how many bytes an archive of arrays of ``size`` bytes may unpack."""
    return max(_UNPACKED, _RATIO * size)


def read_limited(path: Path, most: int = MOST_TEXT) -> bytes:
    """Return the content of a file of at most ``most`` bytes."""
    with opened(path) as file:
        expect_bytes(path, path.stat().st_size, most)
        return file.read()


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
    """Open a plain file for reading; a pipe or device is an OSError, and errors of the system have the file's name."""
    if not path.is_file():
        code = errno.EISDIR if path.is_dir() else errno.EINVAL if path.exists() else errno.ENOENT
        raise OSError(code, os.strerror(code), str(path))
    try:
        with path.open("rb") as file:
            yield file
    except MemoryError as error:
        raise OutOfMemoryError(f"{path}: expected a file that fits into the memory, got a larger one") from error
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


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
    """Return a member of an archive, in no more memory than it declares, which callers check; more is damage."""
    declared = packed.getinfo(name).file_size
    with packed.open(name) as member:
        content = member.read(declared)
    if len(content) != declared:
        raise zipfile.BadZipFile(f"{name}: {len(content)} bytes instead of {declared}")
    return content


class OutOfMemoryError(ValueError):
    """There is not enough memory for the request."""


def limit_memory() -> None:
    """Limit this process, and each that it starts, to the memory that is free, or half of all if that is more.

    Whatever takes more ends in a MemoryError, where the system knows such a limit (Linux).
    """
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415 - Windows has none

        before = [each for each in resource.getrlimit(resource.RLIMIT_DATA) if each != resource.RLIM_INFINITY]
        most = min(max(free_memory(), _meminfo("MemTotal:") // 2), *before, _NO_LIMIT)
        resource.setrlimit(resource.RLIMIT_DATA, (most, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def free_memory() -> int:
    """Return the bytes of memory that are free; those of a large machine where the system does not report them."""
    return _meminfo("MemAvailable:")


def expect_memory(name: str, value: object, needed: float) -> None:
    """Raise OutOfMemoryError for a value that needs more bytes than this machine, whatever else runs on it, has."""
    there, needed = _meminfo("MemTotal:"), min(needed, _MOST_NEEDED)
    if needed > there:
        size = f"at least {megabytes(needed)} of memory, of which there are {megabytes(there)}"
        raise OutOfMemoryError(f"{name}: expected less, {value} needs {size}")


def _meminfo(name: str) -> int:
    """Return an entry of Linux's ``/proc/meminfo`` in bytes, or the limit of this container's memory if it is less."""
    sizes = [_NO_LIMIT]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        sizes.append(1024 * next(int(line.split()[1]) for line in lines if line.startswith(name)))
    for path in _CONTAINER:
        with contextlib.suppress(OSError, ValueError):  # without a limit the text is "max"
            sizes.append(int(Path(path).read_text(encoding="ascii")))
    return min(sizes)


@contextlib.contextmanager
def refusing_excess() -> Iterator[None]:
    """Raise OutOfMemoryError for whatever fails in this context for want of memory."""
    try:
        yield
    except Exception as error:
        foreign = isinstance(error, RuntimeError) or type(error).__module__.startswith("cv2")
        of_allocator = foreign and any(text in str(error) for text in _OF_ALLOCATORS)
        if not isinstance(error, MemoryError) and not of_allocator:
            raise
        raise OutOfMemoryError(_TOO_LITTLE) from error


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


def named_numbers(place: str, entries: Mapping[str, str], names: Iterable[str]) -> list[float]:
    """Return the numbers of some names in a table; a message begins with ``place``."""
    came = {name: entries.get(name, "nothing") for name in names}
    if not (values := numbers_in(came.values())):
        raise ValueError(f"{place}: expected numbers for {', '.join(came)}, got {', '.join(came.values()):.120}")
    return values


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


def expect_one_of(key: str, value: object, known: Collection[object], hint: str = "") -> None:
    """Raise a ValueError, which ends with a hint, if a key's value is not one of those that are known."""
    if value not in known:
        names = ", ".join("null" if each is None else str(each) for each in known)
        raise ValueError(f"{key}: expected one of {names}, got {value!r:.60}{hint}")


def expect_positive(*, or_zero: bool = False, **options: float) -> None:
    """Raise a ValueError for the first option that is not a positive finite number, nor 0 if that is allowed."""
    for name, value in options.items():
        if not (0 < value < float("inf") or (or_zero and value == 0)):
            raise ValueError(f"{name}: expected {'0 or ' if or_zero else ''}a positive number, got {value}")


@contextlib.contextmanager
def refusing(message: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise a ValueError with a message in place of the errors from within that stand for something unexpected."""
    try:
        yield
    except kinds as error:
        little = ", or there is too little memory for it" if isinstance(error, MemoryError) else ""
        raise ValueError(f"{message}{little}") from error


def readable(name: str) -> str:
    """Return a file's name as text: bytes that are no UTF-8, which Python reads as surrogates, are escaped."""
    return name.encode(errors="backslashreplace").decode()


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """Parse JSON strictly: without numbers that no float can hold, and if ``finite`` without NaN and infinity."""

    def refuse(text: str) -> NoReturn:
        raise ValueError(f"expected finite numbers, got {text[:20]}")

    def parse_int(text: str) -> int:
        return int(text) if len(text) <= _MOST_DIGITS else refuse(text)

    def parse_float(text: str) -> float:
        value = float(text)
        return value if math.isfinite(value) else refuse(text)

    only: Any = {"parse_constant": refuse, "parse_float": parse_float} if finite else {}
    with refusing("nested too deeply", RecursionError):
        return json.loads(text, parse_int=parse_int, **only)


def did_you_mean(given: object, known: Iterable[str]) -> str:
    """Return ``; did you mean NAME?`` for the only name with all words of the given one, else a similar one."""
    names = {name.lower(): name for name in known}
    words = {name: {word.rstrip("s") for word in re.findall(r"[^\W_]+", name)} for name in (*names, str(given).lower())}
    asked = words[str(given).lower()]
    near = [name for name in names if asked and asked <= words[name]]
    if len(near) != 1:
        near = get_close_matches(str(given).lower(), names, 1)
    return f"; did you mean {names[near[0]]}?" if near else ""


class OutsideError(ValueError):
    """A name in a file leads out of the folder that it belongs to."""


def leads_outside(name: str) -> bool:
    """Return whether a name leads out of its folder on any system: absolute, with ``..``, of a drive, or with NUL."""
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or "\0" in name or re.match("[A-Za-z]:", name) is not None


def path_within(folder: Path, name: str, source: object, form: str = "{}") -> Path:
    """Return the path of a file that another file names; OutsideError if it is not in a folder or below it.

    The folder may be a link; links that the name leads through may not lead out of it. ``source`` gives the name, such
    as ``FILE: line 3``. ``form`` is the path that the name is a part of, from the folder on, with ``{}`` for the name.
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


def natural_key(name: str | PurePath) -> tuple[tuple[str | tuple[int, str], ...], str]:
    """Return a key that sorts names, or paths folder by folder, with the numbers in them by value: 2 before 10."""
    text = str(name).replace(os.sep, "/")
    parts: list[str | tuple[int, str]] = list(_TURNS.split(text))
    for place in range(1, len(parts), 2):
        digits = str(parts[place]).lstrip("0")
        parts[place] = (-1, "") if digits == "/" else (len(digits), digits)
    return tuple(parts), text


def unchecked(kind: type[_Record], **values: Any) -> _Record:
    """Return a record of all its fields' values, of which the maker is sure, without its checks."""
    record = object.__new__(kind)
    vars(record).update(values)
    return record


def derived(record: _Record, **changes: Any) -> _Record:
    """Return a copy of a record with other values of some fields, which are not checked."""
    return unchecked(type(record), **{**vars(record), **changes})
