"""The upsampling factors that there are; apart from the models, so that a configuration is checked without torch."""

from __future__ import annotations

SCALES = (2, 4, 8, 16)


def check_scale(scale: int) -> None:
    """Raise a ValueError for a factor that is none of ``SCALES``."""
    if scale not in SCALES:
        raise ValueError(f"scale: expected one of {', '.join(map(str, SCALES))}, got {scale}")
