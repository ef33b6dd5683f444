"""Times and sizes as text."""

from __future__ import annotations


def duration(seconds: float) -> str:
    """Return an estimated time: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def clock(seconds: float) -> str:
    """Return a measured time in hours, minutes and seconds: 0:04:29."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


def megabytes(size: float) -> str:
    """Return a number of bytes: 3.2 MB, 45 MB, 1.3 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.{0 if size >= 1e7 else 1}f} MB"
