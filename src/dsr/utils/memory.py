"""Free memory, and errors of one line where something does not fit in it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from dsr.utils.progress import megabytes

_NO_LIMIT = 1 << 40
"""Bytes of memory assumed where the system does not report them."""
_MOST = 1e300
"""Bytes that a message can still name."""
_ADVICE = "not enough memory; a smaller size, scale or batch, or fewer workers need less"
_OF_ALLOCATORS = ("allocate memory", "not enough memory", "Insufficient memory", "out of memory")
"""What torch's and OpenCV's errors say when there is no memory."""


class OutOfMemoryError(ValueError):
    """There is not enough memory for the request."""


def free_memory() -> int:
    """Return the bytes of memory that are free; those of a large machine where the system does not report them."""
    return _meminfo("MemAvailable:")


def expect_memory(name: str, value: object, needed: float) -> None:
    """Raise OutOfMemoryError for a value for which this machine, whatever else runs on it, has too little memory.

    Args:
        name: of the value.
        value: what came.
        needed: bytes that it needs at least.

    """
    there, needed = _meminfo("MemTotal:"), min(needed, _MOST)
    if needed > there:
        size = f"at least {megabytes(needed)} of memory, of which there are {megabytes(there)}"
        raise OutOfMemoryError(f"{name}: expected less, {value} needs {size}")


@contextlib.contextmanager
def refusing_excess() -> Iterator[None]:
    """Raise OutOfMemoryError for whatever fails in this context for want of memory."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, MemoryError) and not _is_of_allocator(error):
            raise
        raise OutOfMemoryError(_ADVICE) from error


def _is_of_allocator(error: Exception) -> bool:
    """Return whether an error is that of a library that could not allocate memory, as torch and OpenCV say it."""
    foreign = isinstance(error, RuntimeError) or type(error).__module__.startswith("cv2")
    return foreign and any(text in str(error) for text in _OF_ALLOCATORS)


def _meminfo(name: str) -> int:
    """Return an entry of Linux's ``/proc/meminfo``, in bytes."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))
    except (OSError, ValueError, StopIteration):
        return _NO_LIMIT
