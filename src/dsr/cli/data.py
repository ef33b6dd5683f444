"""``dsr data``: list, fetch, check and prepare data sets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

_EXAMPLES = """\
examples:
  dsr data list
  dsr data get middlebury middlebury2003 --yes
  dsr data get sunrgbd --mirror https://server.example/data
  dsr data verify tofmark
  dsr data prepare middlebury dataset.scenes=found
  DSR_DATA=/large/disk dsr data where icl

All data sets are below one directory: $DSR_DATA, or ./data.
"""
_GET_NOTES = """\
Run the same command again to continue an interrupted download.

The SHA-256 of a file is written into checksums.json when it is first downloaded; later downloads have to match it.

A mirror has every file under the same path as below the directory of the data sets, and every archive in the folder
of its data set:
  URL/middlebury2014/Vintage-perfect/im0.png
  URL/sunrgbd/SUNRGBD.zip
  URL/icl_nuim/office_room_traj0_frei_png.tar.gz
An archive that you put there by hand is used instead of being downloaded, and kept.
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
    tasks.add_parser("list", help="all data sets, and which of them are on this machine").set_defaults(
        run=_run, task="list"
    )

    where = tasks.add_parser("where", help="the directory of the data sets, or the folders of some")
    where.add_argument("names", nargs="*", metavar="NAME", help="a data set, as in `dsr data list`")
    where.set_defaults(run=_run, task="where")

    fetch = tasks.add_parser("get", help="fetch what is missing", epilog=_GET_NOTES, formatter_class=style)
    fetch.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    fetch.add_argument("--mirror", metavar="URL", help="a server to try first, see below")
    fetch.add_argument("--yes", "-y", action="store_true", help="do not ask")
    fetch.add_argument("--keep-archives", action="store_true", help="keep archives after unpacking")
    fetch.set_defaults(run=_run, task="get")

    check = tasks.add_parser("verify", help="check every file against its recorded size and checksum")
    check.add_argument("names", nargs="+", metavar="NAME", help="a data set, as in `dsr data list`")
    check.set_defaults(run=_run, task="verify")
    ready = tasks.add_parser("prepare", help="resize and keep the scenes of a data set, and draw a contact sheet")
    ready.add_argument("name", metavar="NAME", help="a data set, as in `eval.py dataset=NAME`")
    ready.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="as for eval.py, such as dataset.size=256")
    ready.add_argument("--config-dir", type=Path, metavar="DIR", help="a directory of your own with dataset/NAME.yaml")
    ready.set_defaults(run=_run, task="prepare")
    for task in (fetch, check):
        task.add_argument(
            "--accept-changed", action="store_true", help="take files whose checksum differs from the recorded one"
        )


def _run(options: argparse.Namespace, *context: Any) -> list[str]:
    """Run a task."""
    from dsr.cli.data_tasks import TASKS  # noqa: PLC0415 - it imports what downloads need

    return TASKS[options.task](options, *context)
