"""``dsr doctor``: check a directory of your own scenes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser("doctor", help="check a directory of your own scenes")
    parser.add_argument("directory", type=Path, metavar="DIR", help="a scene, or a directory of scenes")
    parser.add_argument(
        "--most", type=int, metavar="N", help="examine at most N scenes, taken at equal distances from all"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, *_: object) -> int:
    """Examine a directory of scenes."""
    from dsr.doctor import examine_directory  # noqa: PLC0415 - it takes seconds to import

    return examine_directory(options.directory, options.most)
