"""``dsr report``: tables, figures, the metric study and a page from runs of eval.py."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from dsr.utils.ratios import as_ratio

_DESCRIPTION = """\
Make tables, figures, the metric study and a page from runs of eval.py. All runs in and below the directories are read;
no other files are needed.
"""
_EXAMPLES = """\
examples:
  dsr report outputs/eval -o report
  dsr report outputs/eval -o report --methods Bicubic MSG-V --scale 4
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
    parser.add_argument("--methods", nargs="+", default=[], metavar="NAME", help="these alone, as the tables name them")
    parser.add_argument("--datasets", nargs="+", default=[], metavar="NAME", help="these alone")
    parser.add_argument("--scale", type=float, nargs="+", default=[], metavar="N", help="these alone")
    parser.add_argument("--light", default="e1", metavar="NAME", help="of the figures: e1 (default), e2, e3 or e4")
    parser.add_argument("--title", default="Depth super-resolution", help="of the page")
    parser.add_argument("--page-mb", type=float, default=60.0, metavar="MB", help="maximum size of the page; 60")
    parser.add_argument("--only", metavar="A,B", help="these parts alone, of tables, metrics, figures, page")
    parser.add_argument(
        "--workers", type=int, metavar="N", help="processes that draw and encode (default: one per core, at most 8)"
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Make the report."""
    from dsr.app.requests import REPORT_PARTS, ReportRequest  # noqa: PLC0415 - it is needed for few commands

    request = ReportRequest(
        tuple(options.methods),
        tuple(options.datasets),
        tuple(map(as_ratio, options.scale)),
        tuple(part.strip() for part in options.only.split(",")) if options.only is not None else REPORT_PARTS,
        options.light,
        options.title,
        options.page_mb,
        options.workers,
    )
    from dsr.app.report import make_report  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    make_report(options.runs, options.output, options.study, request, console)
    return []
