"""The upsampling factors that there are; apart from the models, so that a configuration is checked without torch."""

from __future__ import annotations

from collections.abc import Collection

from dsr.utils.ratios import round_ratio

SCALES = (2, 4, 8, 16)
NATIVE = "native"
"""The scale that stands for the ratio of a scene's measured map, whatever it is."""
_TOLERANCE = 0.01


def check_scale(scale: float | str) -> None:
    """Raise a ValueError for a factor that is none of ``SCALES``."""
    if scale not in SCALES:
        raise ValueError(f"scale: expected one of {', '.join(map(str, SCALES))}, got {scale}")


def match_ratio(scale: float | str, measured: Collection[float]) -> float:
    """Return the ratio of the measured map that a scale names.

    Args:
        scale: the ratio, to within 1 %, or ``native`` for the only one.
        measured: ratios of the maps that there are.

    Raises:
        ValueError: there is no such map, or there are several.

    """
    have = ", ".join(f"x{round_ratio(ratio)}" for ratio in sorted(measured)) or "none"
    if isinstance(scale, str):
        if len(measured) != 1:
            several = f"one, the scene has {have}; give the scale of one of them" if measured else "one, there is none"
            raise ValueError(f"downsampling=measured scale={scale} expects a low-resolution map, exactly {several}")
        return next(iter(measured))
    nearest = min(measured, key=lambda ratio: abs(ratio - scale), default=None)
    if nearest is None or not abs(nearest - scale) <= _TOLERANCE * scale:
        raise ValueError(
            f"downsampling=measured expects a low-resolution map at x{round_ratio(scale)}, the scene has {have}"
        )
    return nearest
