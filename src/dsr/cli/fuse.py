"""``dsr fuse``: one mesh of the results of a sequence."""

from __future__ import annotations

from rich.console import Console

from dsr.app.requests import FuseRequest
from dsr.cli.command import Command

_DESCRIPTION = """\
Fuse the depth that `dsr upsample` made of a sequence with poses into one mesh, weighted by the expected errors.
"""
_EXAMPLES = """\
examples:
  dsr upsample recording --poses groundtruth.txt --neighbours 4 --only depth,confidence -o out
  dsr fuse out -o mesh.ply
  dsr fuse out -o mesh.ply --voxel 0.01
"""


def _run(request: FuseRequest, console: Console, _: object) -> list[str]:
    """Fuse, and return the problems."""
    from dsr.app.fuse import fuse  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return fuse(request, console)


add = Command("fuse", "one mesh of the results of a sequence", FuseRequest, _run, _EXAMPLES, _DESCRIPTION).add
