"""Lengths as people read them."""

from __future__ import annotations


def show_length(metres: float, digits: int = 3) -> str:
    """Return a length in the unit that suits its size.

    Args:
        metres: 0 or more.
        digits: significant ones.

    Example:
        >>> [show_length(each) for each in (12000.0, 2.5, 0.0083, 4e-5)]
        ['12 km', '2.5 m', '8.3 mm', '0.04 mm']

    """
    metres = float(f"{metres:.{digits}g}")  # so that the unit is that of what is shown
    value, unit = (metres / 1e3, "km") if metres >= 1e3 else (metres, "m") if metres >= 0.1 else (metres * 1e3, "mm")
    return f"{value:.9g} {unit}"
