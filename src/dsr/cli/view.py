"""``dsr view``: look at results of ``dsr upsample``."""

from __future__ import annotations

from rich.console import Console

from dsr.app.requests import ViewRequest
from dsr.cli.command import Command

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


def _run(request: ViewRequest, console: Console, _: object) -> list[str]:
    """Make the page, and open it."""
    from dsr.app.view import view  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return view(request, console)


add = Command(
    "view", "look at results of `dsr upsample` in the browser", ViewRequest, _run, _EXAMPLES, _DESCRIPTION
).add
