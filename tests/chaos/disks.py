"""Commands on a full disk: a file system of memory with a part of the space that they need, and ``/dev/full``."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from chaos.campaign import Campaign
from chaos.processes import Ended
from chaos.scenarios import STRUCK, Scenario
from chaos.trees import damaged

_ROOM = 1 << 30
"""Bytes of a file system with enough space."""
_LIMIT = 300.0
_FRACTIONS = (0.05, 0.7)
_MOUNT = shutil.which("mount") or "/bin/mount"
_ENTERED = "DSR_CHAOS_ENTERED"


@dataclass(frozen=True)
class DiskCase:
    """A scenario that runs out of space.

    Args:
        name: of the case.
        scenario: the scenario.
        fraction: of the space that its results need; None for enough, but its output goes to ``/dev/full``.

    """

    name: str
    scenario: Scenario
    fraction: float | None


def disk_cases() -> list[DiskCase]:
    """Return all cases."""
    kinds = [(scenario, fraction) for scenario in STRUCK.values() for fraction in (*_FRACTIONS, None)]
    return [DiskCase(f"disk-{number}", *kind) for number, kind in enumerate(kinds)]


def enter_namespace() -> bool:
    """Start this process again where it may mount file systems that nobody else sees; return whether it may.

    The file systems disappear with the process.
    """
    if _ENTERED in os.environ:
        return True
    unshare = shutil.which("unshare")
    if unshare is None:
        return False
    options = ["-m"] if os.geteuid() == 0 else ["-rm"]
    probe = [unshare, *options, _MOUNT, "-t", "tmpfs", "none", "/mnt"]
    if not subprocess.run(probe, capture_output=True, check=False).returncode:
        os.environ[_ENTERED] = "1"
        os.execv(unshare, [unshare, *options, *sys.orig_argv])
    return False


def run_case(campaign: Campaign, case: DiskCase) -> list[str]:
    """Run a case; return what is wrong."""
    known = campaign.undisturbed(case.scenario)
    with contextlib.ExitStack() as stack:
        if case.fraction is not None:
            inputs, total = known.size
            stack.enter_context(_file_system(campaign.work))
            campaign.begin(case.scenario)
            _resize(campaign.work, inputs + int(case.fraction * (total - inputs)))
        else:
            campaign.begin(case.scenario)
        end = campaign.start(case.scenario, out=None if case.fraction is not None else "/dev/full").end(_LIMIT)
        problems = end_problems(case, end) + damaged(campaign.work)
        if case.fraction is not None:
            _resize(campaign.work, _ROOM)
        problems += campaign.finish(case.scenario)[0]
        problems += campaign.compare(case.scenario)
        if problems:
            campaign.keep(case.name, problems)
    return problems


def end_problems(case: DiskCase, end: Ended) -> list[str]:
    """Return what is wrong with the end of a command on a full disk."""
    lines = end.err.splitlines()
    if end.code == 0 and case.fraction is not None and case.fraction > 0.8 and not lines:
        return []  # what it needs differs by a few pages
    problems = [] if end.code == 2 else [f"exit code {end.code}, expected 2"]
    if len(lines) != 1:
        problems.append(f"{len(lines)} lines on stderr, expected one: {' | '.join(lines[-4:])}")
    if not re.match(r"error: .*\S", end.err) or "space" not in end.err:
        problems.append(f"expected a line that says that there is no space, got: {end.err.strip()[-300:]!r}")
    if case.fraction is not None and not re.search(r"[\w-]+(/[\w.-]+|\.\w+)", end.err):
        problems.append(f"expected a line that names the file, got: {end.err.strip()[-300:]!r}")
    if "Traceback" in end.err or "Traceback" in end.out:
        problems.append("a traceback")
    if end.left:
        problems.append(f"{len(end.left)} processes alive at the end")
    return problems


@contextlib.contextmanager
def _file_system(folder: Path) -> Iterator[None]:
    """Mount a file system of memory at a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount("-t", "tmpfs", "-o", f"size={_ROOM}", "none", str(folder))
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def _resize(folder: Path, size: int) -> None:
    """Change the size of a mounted file system, in bytes of which incomplete pages do not count."""
    page = os.sysconf("SC_PAGE_SIZE")
    _mount("-o", f"remount,size={size // page * page}", str(folder))


def _mount(*arguments: str) -> None:
    subprocess.run([_MOUNT, *arguments], check=True, capture_output=True)
