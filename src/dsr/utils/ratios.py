"""Ratios of two resolutions: whole ones such as 4, and others, such as the 2.667 of some sensors' maps."""

from __future__ import annotations

from collections.abc import Sequence

_DECIMALS = 3
_ASPECT = 0.02


def as_ratio(value: float) -> float:
    """Return a ratio, as an ``int`` where it is whole."""
    return int(value) if float(value).is_integer() else float(value)


def round_ratio(value: float) -> float:
    """Return a ratio as tables and names show it: 4, 7.5, 2.667."""
    return as_ratio(round(value, _DECIMALS))


def fits_ratio(size: Sequence[int], size_lr: Sequence[int], ratio: float) -> bool:
    """Return whether the sides of a photo are a ratio times those of a map, to within a pixel of the map or 2 %."""
    return all(abs(n / ratio - n_lr) <= max(1, _ASPECT * n_lr) for n, n_lr in zip(size, size_lr, strict=True))
