"""``dsr report``: tables, figures, the metric study and a page from runs of eval.py."""

from __future__ import annotations

from rich.console import Console

from dsr.app.requests import ReportRequest
from dsr.cli.command import Command

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


def _run(request: ReportRequest, console: Console, _: object) -> list[str]:
    """Make the report."""
    from dsr.app.report import make_report  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return make_report(request, console)


add = Command(
    "report", "tables, figures and a page from runs of eval.py", ReportRequest, _run, _EXAMPLES, _DESCRIPTION
).add
