"""Files that cannot be written for want of space."""

from __future__ import annotations

import contextlib
import errno
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsr.utils.units import megabytes

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_LITTLE = 1 << 16
"""Free bytes of a device from which a failed writing is not blamed on it."""


class FullDiskError(Exception):
    """A file could not be written for want of space.

    It is no OSError, so that it ends a run rather than being taken for a problem of one scene or picture.
    """

    def __init__(self, path: Path, needed: float | None = None) -> None:
        space = "space" if needed is None else megabytes(needed)
        super().__init__(f"{path}: expected {space} to write the file, got {_free_space(path)}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the message on the way from a worker process."""
        return FullDiskError.__new__, (FullDiskError, str(self))


@contextlib.contextmanager
def space_for(path: Path) -> Iterator[None]:
    """Raise FullDiskError for whatever goes wrong in this context for want of space.

    Args:
        path: the file or directory that is written.

    """
    try:
        yield
    except Exception as error:
        if not isinstance(error, FullDiskError) and _is_full(error, path):
            raise FullDiskError(path) from error
        raise


def expect_space(path: Path, needed: float) -> None:
    """Check that there is space for a number of bytes beside a file.

    Raises:
        FullDiskError: there is not.

    """
    if needed > shutil.disk_usage(path.parent).free:
        raise FullDiskError(path, needed)


def silence_threads() -> None:
    """Let threads that write, such as TensorBoard's, print nothing at a full disk: the main thread meets it, too."""

    def report(problem: Any) -> None:
        if not isinstance(problem.exc_value, OSError) or problem.exc_value.errno not in _FULL:
            threading.__excepthook__(problem)

    threading.excepthook = report


def _is_full(error: BaseException, path: Path) -> bool:
    """Return whether a file could not be written for want of space, as the error or the device says.

    Libraries that write through C report only that they failed.
    """
    each: BaseException | None = error
    while each is not None:
        if isinstance(each, OSError) and each.errno in _FULL:
            return True
        each = each.__cause__ or each.__context__
    if isinstance(error, OSError) and error.errno is not None:
        return False
    try:
        return shutil.disk_usage(path.parent).free < _LITTLE
    except OSError:
        return False


def _free_space(path: Path) -> str:
    """Return how much space is left where a file is."""
    try:
        return f"a device with {megabytes(shutil.disk_usage(path.parent).free)} left"
    except OSError:
        return "a full device"
