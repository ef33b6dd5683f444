"""Getting data sets: those that ``dsr data`` knows, which ``collections.yaml`` describes, and how they are fetched."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dsr.utils.guards import did_you_mean


@dataclass(frozen=True)
class Item:
    """A file to fetch."""

    path: str  # below the directory of the data sets, with slashes; a mirror has the file under the same path
    urls: tuple[str, ...]  # tried in order; ADDRESS#NAME is the member NAME of a zip archive
    unpack_to: str | None = None  # directory that an archive is unpacked into, below that of the data sets
    contains: tuple[str, ...] = ()  # what there must be in it afterwards, such as "training/final"
    sha256: str | None = None  # where it is known beforehand


@dataclass(frozen=True)
class Collection:
    """Files that go together."""

    name: str  # as it is typed
    title: str
    homepage: str
    licence: str  # its terms, as far as its owners state them
    citation: str
    folders: tuple[str, ...]  # below the directory of the data sets
    size: float | None  # of the downloads in bytes, about
    items: tuple[Item, ...] = field(default=(), repr=False)  # empty where nobody but the user can fetch it
    manual: str | None = None  # how to get it by hand, with {folder} for its directory
    patterns: tuple[str, ...] = ()  # of the files that the user puts into the first of the folders


def _items(
    path: str,
    urls: Sequence[str],
    pinned: Mapping[str, str],
    unpack_to: str | None = None,
    contains: Sequence[str] = (),
    **lists: Sequence[object],
) -> Iterator[Item]:
    """Yield the files of an entry: one for each choice of a value from each of its ``lists``."""
    for values in itertools.product(*lists.values()):
        chosen = dict(zip(lists, values, strict=True))
        place = path.format(**chosen)
        folder = None if unpack_to is None else unpack_to.format(**chosen)
        addresses = tuple(url.format(**chosen) for url in urls)
        yield Item(place, addresses, folder, tuple(contains), pinned.get(place))


def _catalogue() -> dict[str, Collection]:
    """Return the collections by name, in the order of the file that describes them."""
    here = Path(__file__).parent
    # SHA-256 of files that never change: those of a commit of git, whose number vouches for their content
    lines = (line.split("  ") for line in (here / "pinned.sha256").read_text("utf-8").splitlines())
    pinned = {path: digest for digest, path in lines}
    text = (here / "collections.yaml").read_text("utf-8")
    catalogue = {}
    for name, entry in yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)).items():  # noqa: S506
        items = tuple(item for each in entry.pop("files", ()) for item in _items(pinned=pinned, **each))
        lists: dict[str, Any] = {key: tuple(entry.pop(key)) for key in ("folders", "patterns") if key in entry}
        catalogue[name] = Collection(name, items=items, **entry, **lists)
    return catalogue


CATALOGUE = _catalogue()


def find(names: Iterable[str], catalogue: Mapping[str, Collection]) -> list[Collection]:
    """Return the collections of these names, each once."""
    unknown = [name for name in names if name not in catalogue]
    if unknown:
        expected = f"expected some of {', '.join(catalogue)}{did_you_mean(unknown[0], catalogue)}"
        raise ValueError(f"{', '.join(unknown)}: unknown data set; {expected}")
    return [catalogue[name] for name in dict.fromkeys(names)]
