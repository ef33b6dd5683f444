"""``dsr data list`` and ``verify``: what of the catalogue is there, and whether it is as recorded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from dsr.data.download.checksums import Checksums, Entry, lock_directory, sha256_of
from dsr.data.download.collection import Collection, Item
from dsr.data.download.transfer import is_page
from dsr.utils.limits import opened
from dsr.utils.paths import natural_key
from dsr.utils.progress import Progress

_BEGINNINGS: Mapping[str, tuple[bytes, ...]] = {
    ".gz": (b"\x1f\x8b",),
    ".jpg": (b"\xff\xd8\xff",),
    ".mat": (b"MATLAB", b"\x89HDF"),
    ".npy": (b"\x93NUMPY",),
    ".pfm": (b"Pf", b"PF"),
    ".pgm": (b"P2", b"P5"),
    ".png": (b"\x89PNG\r\n\x1a\n",),
    ".ppm": (b"P3", b"P6"),
    ".zip": (b"PK",),
}


def state(collection: Collection, root: Path) -> str:
    """Return ``complete``, ``partial N of M``, ``absent`` or ``manual``, judged by names and sizes.

    Raises:
        ValueError: ``checksums.json`` is damaged.

    """
    if not collection.items:
        found = all(any(_matches(collection, root, pattern)) for pattern in collection.patterns)
        return "complete" if found else "manual"
    there = len(collection.items) - len(absent(collection.items, root))
    if there in (0, len(collection.items)):
        return "complete" if there else "absent"
    return f"partial {there} of {len(collection.items)}"


def absent(items: Iterable[Item], root: Path) -> list[Item]:
    """Return the items that are not there, or not in their recorded sizes; each path once."""
    checksums = Checksums(root)
    by_path = {item.path: item for item in items}
    return [item for item in by_path.values() if lack(item, root, checksums.get(item.path)) is not None]


def verify(collection: Collection, root: Path, progress: Progress, *, accept_changed: bool = False) -> list[str]:
    """Check the files of a collection against their recorded sizes and checksums; those without get them recorded.

    Of unpacked archives the names and sizes of the files are checked.

    Args:
        collection: what to check.
        root: the directory of the data sets.
        progress: shows what is done.
        accept_changed: whether to record anew what differs.

    Returns:
        What is wrong, a line each.

    Raises:
        ValueError: ``checksums.json`` is damaged, or another command is writing into ``root``.

    """
    new: dict[str, Entry] = {}
    with lock_directory(root):
        checksums = Checksums(root)
        old: Mapping[str, Entry] = {} if accept_changed else checksums
        found: list[str | None]
        if collection.items:
            found = [_verify_item(item, root, old, new, progress) for item in collection.items]
        else:
            paths = {path for pattern in collection.patterns for path in _matches(collection, root, pattern)}
            names = sorted((path.relative_to(root).as_posix() for path in paths), key=natural_key)
            found = [*_misses(collection, root, checksums)]
            found += [compare(name, root, old, new, progress) for name in names]
        record(checksums, new, progress)
    return [problem for problem in found if problem is not None]


def compare(
    name: str,
    root: Path,
    old: Mapping[str, Entry],
    new: dict[str, Entry],
    progress: Progress,
    sha256: str | None = None,
) -> str | None:
    """Return how a file differs from what it should be, None where it does not.

    Args:
        name: its path below ``root``.
        root: the directory of the data sets.
        old: what is recorded.
        new: takes its entry where none is recorded.
        progress: shows what is done.
        sha256: its checksum where that is known beforehand.

    """
    path, entry = root / name, old.get(name)
    expected = sha256 or (None if entry is None else entry.sha256)
    try:
        expect_kind(path, path.suffix, str(path))
        with progress.task(name, unit="bytes") as moved:
            digest = sha256_of(path, moved)
    except (ValueError, OSError) as error:
        return str(error)
    if expected not in (None, digest):
        return f"{path}: expected sha256 {expected} as recorded, got {digest}"
    if entry is None:
        new[name] = Entry(digest, path.stat().st_size)
    return None


def record(checksums: Checksums, new: Mapping[str, Entry], progress: Progress) -> None:
    """Record what was there without a record."""
    if not new:
        return
    names = list(new)
    few = ", ".join(names) if len(names) < 4 else f"{names[0]}, {names[1]} and {len(names) - 2} more"
    try:
        checksums.update(new)
    except OSError as error:
        progress.say(f"{checksums.path}: not written: {error}")
    else:
        progress.say(f"{checksums.path}: recorded as found: {few}")


def lack(item: Item, root: Path, entry: Entry | None) -> str | None:
    """Return what is missing of an item or has another size than recorded, None where nothing is."""
    if item.unpack_to is None:
        return _size_problem(root / item.path, None if entry is None else entry.size)
    if entry is None or entry.files is None:
        return f"{root / item.unpack_to}: expected what {Path(item.path).name} unpacks to, there is no record of it"
    problems = (_size_problem(root / item.unpack_to / name, size) for name, size in entry.files.items())
    return next((problem for problem in problems if problem is not None), None)


def expect_kind(path: Path, suffix: str, source: str) -> None:
    """Check that a file begins as one with this suffix does; ``source`` is what the message calls it.

    Raises:
        ValueError: it begins otherwise.

    """
    with opened(path) as file:
        beginning = file.read(512)
    expected = _BEGINNINGS.get(suffix.lower())
    if is_page(beginning):
        raise ValueError(f"{source}: expected a {suffix} file, got a web page")
    right = beginning.startswith(expected) if expected else bool(beginning) and b"\0" not in beginning
    if not right:
        raise ValueError(f"{source}: expected a {suffix} file, got one that begins with {beginning[:8]!r}")


def _verify_item(
    item: Item, root: Path, old: Mapping[str, Entry], new: dict[str, Entry], progress: Progress
) -> str | None:
    """Return what is wrong with an item."""
    entry = old.get(item.path)
    if item.unpack_to is not None and entry is None:
        entry = _adopted(item, root)
        new.update({} if entry is None else {item.path: entry})
    problem = lack(item, root, entry)
    if problem is None and item.unpack_to is None:
        problem = compare(item.path, root, old, new, progress, item.sha256)
    return problem


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
    for pattern in collection.patterns:
        if not any(_matches(collection, root, pattern)):
            yield (
                f"{folder}: expected {pattern}, there is none: {collection.instruction(root)}, then "
                f"`dsr data verify {collection.name}`"
            )
    for name in checksums:
        if name.startswith(f"{collection.folders[0]}/") and not (root / name).is_file():
            yield f"{root / name}: expected a file as recorded, there is none"


def _matches(collection: Collection, root: Path, pattern: str) -> Iterator[Path]:
    """Yield the files that the user put in place."""
    return (path for path in (root / collection.folders[0]).glob(pattern) if path.is_file())


def _size_problem(path: Path, size: int | None) -> str | None:
    if not path.is_file():
        return f"{path}: expected a file, there is none"
    if size not in (None, path.stat().st_size):
        return f"{path}: expected {size} bytes as recorded, got {path.stat().st_size}"
    return None
