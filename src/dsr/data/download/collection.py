"""What a data set of the catalogue consists of, and words that several of them share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

MIDDLEBURY = "Its owners permit using and publishing the images and disparity maps, and ask for the citation."
RESEARCH = "Its owners state no licence: for research, see the homepage."
CITE_2006 = "H. Hirschmüller, D. Scharstein: Evaluation of cost functions for stereo matching. CVPR 2007."
CITE_2001 = (
    "D. Scharstein, R. Szeliski: A taxonomy and evaluation of dense two-frame stereo correspondence algorithms. "
    "IJCV 47, 2002."
)


@dataclass(frozen=True)
class Item:
    """A file to fetch.

    Args:
        path: below the directory of the data sets, with slashes; a mirror has the file under the same path.
        urls: where it is, tried in order; ``ADDRESS#NAME`` is the member NAME of a zip archive.
        unpack_to: the directory, below that of the data sets, that the archive is unpacked into; None for a file that
            stays as it is.
        contains: what there must be in ``unpack_to`` afterwards, such as ``training/final``.
        sha256: of the file, where it is known beforehand.

    """

    path: str
    urls: tuple[str, ...]
    unpack_to: str | None = None
    contains: tuple[str, ...] = ()
    sha256: str | None = None


@dataclass(frozen=True)
class Collection:
    """Files that go together.

    Args:
        name: as it is typed.
        title: what it is, a few words.
        homepage: address of its page.
        licence: its terms, as far as its owners state them.
        citation: authors, title, venue, year.
        folders: its directories below that of the data sets.
        size: of the downloads in bytes, about; None where that is not known.
        items: what is fetched; empty where nobody but the user can.
        manual: how to get it by hand, with ``{folder}`` for its directory; None where ``items`` are all there is.
        patterns: of the files that the user puts into the first of ``folders``, as for :meth:`pathlib.Path.glob`.

    """

    name: str
    title: str
    homepage: str
    licence: str
    citation: str
    folders: tuple[str, ...]
    size: float | None
    items: tuple[Item, ...] = field(default=(), repr=False)
    manual: str | None = None
    patterns: tuple[str, ...] = ()

    def instruction(self, root: Path) -> str:
        """Return how to get it by hand."""
        return (self.manual or "").format(folder=root / self.folders[0])
