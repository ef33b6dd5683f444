"""The catalogue of data sets: every entry can be fetched or says how to get it, and lies where its reader looks."""

import hashlib
from collections import Counter
from pathlib import PurePosixPath
from urllib.parse import urlsplit

from dsr.data.download import CATALOGUE

ITEMS = [item for collection in CATALOGUE.values() for item in collection.items]


def test_collections_have_descriptions_and_terms():
    for name, collection in CATALOGUE.items():
        assert collection.name == name
        assert urlsplit(collection.homepage).scheme in ("http", "https")
        assert collection.title
        assert collection.licence.endswith(".")
        assert collection.citation.endswith(".")
        assert any(str(year) in collection.citation for year in range(2001, 2027))
        assert collection.size is None or collection.size > 0
        assert bool(collection.items) != bool(collection.manual and collection.patterns)


def test_files_of_a_collection_lie_in_its_folders():
    for collection in CATALOGUE.values():
        paths = [item.path for item in collection.items]
        assert {path.split("/")[0] for path in paths} == (set(collection.folders) if paths else set())
        assert len(set(paths)) == len(paths)


def test_items_have_addresses_of_their_names_and_paths_below_the_root():
    assert len(ITEMS) > 200
    for item in ITEMS:
        assert not PurePosixPath(item.path).is_absolute()
        assert ".." not in item.path
        assert item.urls
        for url in item.urls:
            address = urlsplit(url)
            assert address.scheme in ("http", "https")
            assert " " not in url
            name = (address.fragment or address.path).rpartition("/")[2]
            assert name == PurePosixPath(item.path).name or item.unpack_to is not None
        assert (item.unpack_to is None) == (not item.path.endswith((".zip", ".tar.gz")))
        assert bool(item.contains) == (item.unpack_to is not None)


def test_files_of_a_commit_are_pinned_and_the_shared_ones_are_these(shared):
    pinned = {item.path: item.sha256 for item in ITEMS if item.sha256 is not None}
    counts = Counter(path.split("/")[0] for path in pinned)
    assert counts == {
        "lu": 2 * 6, "middlebury8": 2 * 30, "ddrnet": 3 * 22, "stereo_board": 2 * 5, "cleargrasp": 4 * 4 + 1,
        "cleargrasp_synthetic": 3 * 3,
    }  # fmt: skip
    for item in ITEMS:
        assert (item.sha256 is not None) == ("raw.githubusercontent.com" in item.urls[0])
    folders = (("lu", "modern/Lu"), ("middlebury8", "modern/Middlebury"), ("stereo_board", "real/stereo_board"))
    for ours, theirs in folders:
        for path, digest in pinned.items():
            folder, _, name = path.partition("/")
            if folder == ours:
                assert hashlib.sha256((shared / theirs / name).read_bytes()).hexdigest() == digest
