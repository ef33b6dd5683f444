"""``dsr fuse``: one mesh of the results of a sequence."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

_DESCRIPTION = """\
Fuse the depth that `dsr upsample` made of a sequence with poses into one mesh, weighted by the expected errors.
"""
_EXAMPLES = """\
examples:
  dsr upsample recording --poses groundtruth.txt --neighbours 4 --only depth,confidence -o out
  dsr fuse out -o mesh.ply
  dsr fuse out -o mesh.ply --voxel 0.01
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "fuse",
        help="one mesh of the results of a sequence",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="OUT", help="folders of results of dsr upsample")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the mesh, a .ply file")
    parser.add_argument(
        "--voxel", type=float, metavar="METRES", help="size of a voxel (default: the width of a pixel on the surfaces)"
    )
    parser.add_argument(
        "--max-error",
        type=float,
        default=2.0,
        metavar="PERCENT",
        help="leave pixels out whose depth is expected to be off by more (default: 2)",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Fuse, and return the problems."""
    from dsr.app.requests import FuseRequest  # noqa: PLC0415 - it is needed for few commands

    request = FuseRequest(tuple(options.folders), options.output, options.voxel, options.max_error / 100)
    from dsr.app.fuse import fuse  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return fuse(request, console)
