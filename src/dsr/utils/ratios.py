"""Ratios of two resolutions: the upsampling factors, and others, such as the 2.667 of some sensors' maps."""

from collections.abc import Collection, Sequence

SCALES = (2, 4, 8, 16)
NATIVE = "native"  # the scale that stands for the ratio of a scene's measured map, whatever it is
_DECIMALS, _ASPECT, _TOLERANCE = 3, 0.02, 0.01


def as_ratio(value: float) -> float:
    """Return a ratio, as an ``int`` where it is whole."""
    return int(value) if float(value).is_integer() else float(value)


def round_ratio(value: float) -> float:
    """Return a ratio as tables and names show it: 4, 7.5, 2.667."""
    return as_ratio(round(value, _DECIMALS))


def fits_ratio(size: Sequence[int], size_lr: Sequence[int], ratio: float) -> bool:
    """Return whether the sides of a photo are a ratio times those of a map, to within a pixel of the map or 2 %."""
    return all(abs(n / ratio - n_lr) <= max(1, _ASPECT * n_lr) for n, n_lr in zip(size, size_lr, strict=True))


def check_scale(scale: float | str) -> None:
    """Raise a ValueError for a factor that is none of ``SCALES``."""
    if scale not in SCALES:
        raise ValueError(f"scale: expected one of {', '.join(map(str, SCALES))}, got {scale}")


def match_ratio(scale: float | str, measured: Collection[float]) -> float:
    """Return the ratio of the measured map that a scale names to within 1 %, or ``native`` for the only one."""
    have = ", ".join(f"x{round_ratio(ratio)}" for ratio in sorted(measured)) or "none"
    if isinstance(scale, str):
        if len(measured) != 1:
            several = f"one, the scene has {have}; give the scale of one of them" if measured else "one, there is none"
            raise ValueError(f"downsampling=measured scale={scale} expects a low-resolution map, exactly {several}")
        return next(iter(measured))
    nearest = min(measured, key=lambda ratio: abs(ratio - scale), default=None)
    if nearest is None or not abs(nearest - scale) <= _TOLERANCE * scale:
        raise ValueError(f"downsampling=measured expects a map at x{round_ratio(scale)}, the scene has {have}")
    return nearest
