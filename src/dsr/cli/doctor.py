"""``dsr doctor``: check a directory of your own scenes."""

from __future__ import annotations

from dsr.app.requests import DoctorRequest
from dsr.cli.command import Command


def _run(request: DoctorRequest, *_: object) -> int:
    """Examine a directory of scenes."""
    from dsr.doctor import examine_directory  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return examine_directory(request.directory, request.most)


add = Command("doctor", "check a directory of your own scenes", DoctorRequest, _run).add
