"""Where data sets lie: $DSR_DATA, else ``data`` in the working directory; a folder each."""

from __future__ import annotations

import os
from pathlib import Path


def data_root() -> Path:
    """Return the directory of the data sets' folders."""
    return Path(os.environ.get("DSR_DATA") or "data").expanduser()
