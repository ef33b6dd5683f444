"""``dsr data``: list, fetch, check and prepare data sets."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from dsr.data.download.catalogue import Collection, find
from dsr.data.download.get import Options, get
from dsr.data.download.inventory import absent, state, verify
from dsr.data.download.location import data_root
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.units import megabytes

_EXAMPLES = """\
examples:
  dsr data list
  dsr data get middlebury middlebury2003 --yes
  dsr data get sunrgbd --mirror https://server.example/data
  dsr data verify tofmark
  dsr data prepare middlebury dataset.scenes=found
  DSR_DATA=/large/disk dsr data where icl

Everything lies below one directory: $DSR_DATA, or ./data.
"""
_GET_NOTES = """\
An interrupted download goes on where it stopped when the same command is run again.

The first time a file comes, its SHA-256 is written into checksums.json; ever after it has to have that one.

A mirror has every file under the path that it has below the directory of the data sets, and every archive in the
folder of its data set:
  URL/middlebury2014/Vintage-perfect/im0.png
  URL/sunrgbd/SUNRGBD.zip
  URL/icl_nuim/office_room_traj0_frei_png.tar.gz
An archive that you put there by hand is used instead of being fetched, and kept.
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    style = argparse.RawDescriptionHelpFormatter
    data = commands.add_parser(
        "data",
        help="list, fetch and check data sets",
        description="Data sets.",
        epilog=_EXAMPLES,
        formatter_class=style,
    )
    tasks = data.add_subparsers(title="commands", metavar="COMMAND", required=True)
    tasks.add_parser("list", help="what there is, and what of it is here").set_defaults(run=_list)

    where = tasks.add_parser("where", help="the directory of the data sets, or the folders of some")
    where.add_argument("names", nargs="*", metavar="NAME", help="a data set, as in `dsr data list`")
    where.set_defaults(run=_where)

    fetch = tasks.add_parser("get", help="fetch what is missing", epilog=_GET_NOTES, formatter_class=style)
    fetch.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    fetch.add_argument("--mirror", metavar="URL", help="a server to try first, see below")
    fetch.add_argument("--yes", "-y", action="store_true", help="do not ask")
    fetch.add_argument("--keep-archives", action="store_true", help="keep archives after they were unpacked")
    fetch.set_defaults(run=_get)

    check = tasks.add_parser("verify", help="check every file against its recorded size and checksum")
    check.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    check.set_defaults(run=_verify)
    ready = tasks.add_parser("prepare", help="resize and keep the scenes of a data set, and draw a contact sheet")
    ready.add_argument("name", metavar="NAME", help="a data set, as in `eval.py dataset=NAME`")
    ready.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="as for eval.py, such as dataset.size=256")
    ready.set_defaults(run=_prepare)
    for task in (fetch, check):
        task.add_argument(
            "--accept-changed", action="store_true", help="take files whose checksum differs from the recorded one"
        )


def _list(_: argparse.Namespace, console: Console, catalogue: Mapping[str, Collection]) -> list[str]:
    """Show a table of the data sets."""
    table = Table(box=None, pad_edge=False)
    for header in ("name", "what", "about", "here"):
        table.add_column(header, overflow="fold", no_wrap=header != "what")
    for collection in catalogue.values():
        size = "" if collection.size is None else megabytes(collection.size)
        table.add_row(collection.name, collection.title, size, state(collection, data_root()))
    console.print(table, markup=False, highlight=False)
    return []


def _where(options: argparse.Namespace, console: Console, catalogue: Mapping[str, Collection]) -> list[str]:
    """Show the directory of the data sets, and their folders."""
    collections = find(options.names, catalogue)
    if not collections:
        show(console, str(data_root().absolute()))
    for collection in collections or catalogue.values():
        for folder in collection.folders:
            path = (data_root() / folder).absolute()
            show(console, str(path) if collections else f"  {collection.name:<17} {path}")
    return []


def _get(options: argparse.Namespace, console: Console, catalogue: Mapping[str, Collection]) -> list[str]:
    """Show what will be fetched and on which terms, ask on a terminal, and fetch it."""
    collections = find(options.names, catalogue)
    if options.mirror is not None and not options.mirror.startswith(("http://", "https://")):
        raise ValueError(f"--mirror: expected an address that begins with http:// or https://, got {options.mirror!r}")
    root, progress = data_root(), ConsoleProgress(console)
    items = {item.path: item for collection in collections for item in collection.items}
    missing = len(absent(items.values(), root))
    for collection in collections:
        _describe(collection, console)
    if items:
        show(console, f"{missing} of {len(items)} files are missing in {root.absolute()}")
    if missing and not options.yes and sys.stdin.isatty() and console.is_terminal and not _agreed(console):
        return []
    settings = Options(options.mirror, options.accept_changed, options.keep_archives)
    problems = get(items.values(), root, progress, settings) if items else []
    for collection in collections:
        if not collection.items:
            problems += verify(collection, root, progress, accept_changed=options.accept_changed)
    if not problems:
        show(console, f"{', '.join(collection.name for collection in collections)}: complete")
    return problems


def _describe(collection: Collection, console: Console) -> None:
    """Show what a collection is, and on which terms."""
    size = "" if collection.size is None else f", about {megabytes(collection.size)}"
    show(console, f"{collection.name}: {collection.title}{size}")
    for key, text in (("page", collection.homepage), ("licence", collection.licence), ("cite", collection.citation)):
        lines = textwrap.wrap(text, max(console.width - 12, 20), break_long_words=False, break_on_hyphens=False)
        for number, line in enumerate(lines):
            show(console, f"  {'' if number else key:<9} {line}")


def _agreed(console: Console) -> bool:
    """Return whether the user wants it."""
    console.print("fetch them? [Y/n] ", markup=False, highlight=False, end="")
    try:
        answer = console.input()
    except EOFError:
        return False
    return answer.strip().lower() in ("", "y", "yes")


def _verify(options: argparse.Namespace, console: Console, catalogue: Mapping[str, Collection]) -> list[str]:
    """Check collections, and show which are complete."""
    problems, progress = [], ConsoleProgress(console)
    for collection in find(options.names, catalogue):
        found = verify(collection, data_root(), progress, accept_changed=options.accept_changed)
        if not found:
            show(console, f"{collection.name}: complete, as recorded")
        elif collection.items:
            show(console, f"{collection.name}: `dsr data get {collection.name}` fetches what is missing or damaged")
        problems += found
    return problems


def _prepare(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Resize and keep a data set's scenes, and draw its contact sheet."""
    from dsr.app.prepare import prepare_dataset  # noqa: PLC0415 - it takes seconds to import

    prepare_dataset(options.name, options.settings, console)
    return []
