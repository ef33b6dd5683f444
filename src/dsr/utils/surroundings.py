"""Keep code in the working directory from being loaded, since it may hold a stranger's files."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def close() -> None:
    """Take the working directory from where this process, and those that it starts, look for modules and libraries."""
    os.environ["PYTHONSAFEPATH"] = "1"  # of worker processes, which are started with -c
    os.environ["LD_LIBRARY_PATH"] = os.environ.get("LD_LIBRARY_PATH") or str(Path(__file__).parent)
    # OpenCV puts a colon before it, and the working directory would stand for an empty entry
    if getattr(sys.modules["__main__"], "__spec__", None) is not None and sys.path[:1] == [os.getcwd()]:  # noqa: PTH109
        del sys.path[0]  # where ``python -m`` puts it
