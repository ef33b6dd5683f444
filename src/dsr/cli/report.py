"""``dsr report``: tables, figures, the metric study and a page from runs of eval.py."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

_DESCRIPTION = """\
Tables, figures, the metric study and a page from runs of eval.py: whatever lies in and below the directories is read,
and nothing else is needed.
"""
_EXAMPLES = """\
examples:
  dsr report outputs/eval -o report
  dsr report outputs/eval -o report --methods Bicubic,MSG-V --scales 4
  dsr report outputs/eval -o report --study study.csv     with the columns of a user study, see `dsr study`
  dsr report outputs/eval -o report --only tables

Open report/index.html in a browser. It needs no network and can be sent as it is.
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "report",
        help="tables, figures and a page from runs of eval.py",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="DIR", help="directories of runs, or with runs below them"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="where the report goes")
    parser.add_argument("--study", type=Path, metavar="CSV", help="what `dsr study collect` wrote")
    parser.add_argument("--methods", metavar="A,B", help="these alone, by the names in the tables")
    parser.add_argument("--datasets", metavar="A,B", help="these alone")
    parser.add_argument("--scales", metavar="A,B", help="these alone")
    parser.add_argument("--light", default="e1", metavar="NAME", help="of the figures: e1 (default), e2, e3 or e4")
    parser.add_argument("--title", default="Depth super-resolution", help="of the page")
    parser.add_argument("--page-mb", type=float, default=60.0, metavar="MB", help="most that the page may weigh; 60")
    parser.add_argument("--only", metavar="A,B", help="these parts alone, of tables, metrics, figures, page")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Make the report."""
    from dsr.app.report import PARTS, Wanted, make_report  # noqa: PLC0415 - it takes seconds to import

    scales = [_whole(text) for text in _listed(options.scales)]
    wanted = Wanted(
        tuple(_listed(options.methods)),
        tuple(_listed(options.datasets)),
        tuple(scales),
        tuple(_listed(options.only)) or PARTS,
        options.light,
        options.title,
        options.page_mb,
    )
    make_report(options.runs, options.output, options.study, wanted, console)
    return []


def _listed(text: str | None) -> list[str]:
    """Return the parts of a comma-separated list."""
    return [part.strip() for part in (text or "").split(",") if part.strip()]


def _whole(text: str) -> int:
    """Return a scale."""
    if not text.isdecimal():
        raise ValueError(f"--scales: expected whole numbers such as 4,8, got {text!r}")
    return int(text)
