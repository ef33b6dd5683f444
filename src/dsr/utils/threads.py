"""OpenMP threads are ended before a fork and restarted on demand; a forked process would wait for those it lacks.

GNU's OpenMP, that of torch on Linux, needs this; others notice a fork. ``import dsr`` imports this module, so that it
holds for dsr's own workers, those of data loaders and the user's.
"""

from __future__ import annotations

import contextlib
import ctypes
import os

_PAUSE_HARD = 2
"""OpenMP's ``omp_pause_hard``."""


def _end_threads() -> None:
    """End the threads of OpenMP that this thread computes with."""
    with contextlib.suppress(AttributeError, OSError):  # no OpenMP, or one of before 2018
        ctypes.CDLL(None).omp_pause_resource_all(_PAUSE_HARD)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_end_threads)
