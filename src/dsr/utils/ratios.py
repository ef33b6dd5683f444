"""Ratios of two resolutions: whole ones such as 4, and others, such as the 2.667 of some sensors' maps."""

from __future__ import annotations

_DECIMALS = 3


def as_ratio(value: float) -> float:
    """Return a ratio, as an ``int`` where it is whole."""
    return int(value) if float(value).is_integer() else float(value)


def round_ratio(value: float) -> float:
    """Return a ratio as tables and names show it: 4, 7.5, 2.667."""
    return as_ratio(round(value, _DECIMALS))
