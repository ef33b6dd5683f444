"""The tasks of ``dsr data``; separate from its options, which are parsed without importing them."""

import contextlib
import sys
import textwrap
from collections.abc import Mapping
from importlib.metadata import metadata

from rich.console import Console
from rich.prompt import Confirm
from rich.table import Table

from dsr.app.requests import (
    DataGetRequest,
    DataListRequest,
    DataVerifyRequest,
    DataWhereRequest,
)
from dsr.data.download import CATALOGUE, Collection, Item, find
from dsr.data.download.fetching import absent, checksums_of, expect_address, get, state, verify
from dsr.methods import weights
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.files import data_root
from dsr.utils.progress import megabytes
from dsr.utils.versions import DISTRIBUTION

_URL = "Weights"  # the label of the release's files in ``project.urls`` of pyproject.toml


def downloads() -> Mapping[str, Collection]:
    """Return the data sets, and the weights that this installation does not come with, by their names."""
    names = weights.left_out()
    if not names:
        return CATALOGUE
    stated = metadata(DISTRIBUTION).get_all("Project-URL") or []
    address = dict(each.split(", ", 1) for each in stated).get(_URL, "").rstrip("/")
    items = (
        Item(
            f"{weights.FOLDER}/{name}.safetensors",
            (f"{address}/{name}.safetensors",) if address else (),
            sha256=weights.known()[name],
        )
        for name in names
    )
    collection = Collection(
        weights.FOLDER,
        "weights of networks for comparison, which a wheel leaves out",
        address or "a checkout has them in src/dsr/methods/weights",
        "Apache-2.0, as dsr.",
        "As of dsr, see docs/methods.md.",
        (weights.FOLDER,),
        None,
        tuple(items),
    )
    return {**CATALOGUE, weights.FOLDER: collection}


def list_data_sets(_: DataListRequest, console: Console) -> list[str]:
    """Show a table of the data sets."""
    table = Table(box=None, pad_edge=False)
    for header in ("name", "what", "about", "here", "checksums"):
        table.add_column(header, overflow="fold", no_wrap=header != "what")
    for collection in downloads().values():
        size = "" if collection.size is None else megabytes(collection.size)
        here, known = state(collection, data_root()), checksums_of(collection, data_root())
        table.add_row(collection.name, collection.title, size, here, known)
    console.print(table, markup=False, highlight=False)
    return []


def show_folders(request: DataWhereRequest, console: Console) -> list[str]:
    """Show the directory of the data sets, and their folders."""
    collections = find(request.names, downloads())
    if not collections:
        show(console, str(data_root().absolute()))
    for collection in collections or downloads().values():
        for folder in collection.folders:
            path = (data_root() / folder).absolute()
            show(console, str(path) if collections else f"  {collection.name:<17} {path}")
    return []


def get_data_sets(request: DataGetRequest, console: Console) -> list[str]:
    """Show what will be downloaded and its licence, ask for confirmation on a terminal, and download it."""
    collections = find(request.names, downloads())
    if request.mirror is not None:
        expect_address(request.mirror)  # before anything is shown
    root, progress = data_root(), ConsoleProgress(console)
    items = {item.path: item for collection in collections for item in collection.items}
    missing = len(absent(items.values(), root))
    for collection in collections:
        _describe(collection, console)
    if items:
        show(console, f"{missing} of {len(items)} files are missing in {root.absolute()}")
    if missing and not request.yes and sys.stdin.isatty() and console.is_terminal:
        agreed = False
        with contextlib.suppress(EOFError):  # Ctrl-D
            agreed = Confirm.ask("fetch them?", console=console, default=True)
        if not agreed:
            return []
    problems = []
    if items:
        problems = get(items.values(), root, progress, mirror=request.mirror, keep_archives=request.keep_archives)
    for collection in collections:
        if not collection.items:
            problems += verify(collection, root, progress)
    if not problems:
        show(console, f"{', '.join(collection.name for collection in collections)}: complete")
    return problems


def _describe(collection: Collection, console: Console) -> None:
    size = "" if collection.size is None else f", about {megabytes(collection.size)}"
    show(console, f"{collection.name}: {collection.title}{size}")
    for key, text in (("page", collection.homepage), ("licence", collection.licence), ("cite", collection.citation)):
        lines = textwrap.wrap(text, max(console.width - 12, 20), break_long_words=False, break_on_hyphens=False)
        for number, line in enumerate(lines):
            show(console, f"  {'' if number else key:<9} {line}")


def verify_data_sets(request: DataVerifyRequest, console: Console) -> list[str]:
    """Check collections, and show which are complete."""
    problems, progress = [], ConsoleProgress(console)
    for collection in find(request.names, downloads()):
        found = verify(collection, data_root(), progress)
        if not found:
            show(console, f"{collection.name}: complete, as recorded")
        elif collection.items:
            show(console, f"{collection.name}: `dsr data get {collection.name}` fetches what is missing or damaged")
        problems += found
    return problems
