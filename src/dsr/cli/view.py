"""``dsr view``: look at results of ``dsr upsample``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

_DESCRIPTION = """\
Make one page of the results of `dsr upsample` and open it: the surface to turn, a light to drag, before and after, the
photo and the expected errors as its colours. The page is a single file that needs no network and can be sent as it is.
"""
_EXAMPLES = """\
examples:
  dsr view out                             a result, or a folder of results; writes out/view.html
  dsr view out --no-open -o page.html
  dsr view recordings --most 40 --vertices 100000
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "view",
        help="look at results of `dsr upsample` in the browser",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("output", type=Path, metavar="OUT", help="a result of `dsr upsample`, or a folder of several")
    parser.add_argument("-o", "--page", type=Path, metavar="FILE", help="the page (default: OUT/view.html)")
    parser.add_argument("--no-open", action="store_true", help="only write the page")
    parser.add_argument(
        "--most", type=int, default=24, metavar="N", help="show at most N results, taken at equal distances (24)"
    )
    parser.add_argument(
        "--vertices",
        type=int,
        default=500_000,
        metavar="N",
        help="at most N vertices in a surface, and 6 N in the page; larger maps are reduced (500000)",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Make the page, and open it."""
    from dsr.app.requests import ViewRequest  # noqa: PLC0415 - it is needed for few commands

    page = options.page or options.output / "view.html"
    request = ViewRequest(options.output, page, options.most, options.vertices, not options.no_open)
    from dsr.app.view import view  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return view(request, console)
