"""Lengths as people read them."""

from __future__ import annotations

import pytest

from dsr.utils.lengths import show_length


@pytest.mark.parametrize(
    ("metres", "digits", "text"),
    [
        (150, 2, "150 m"),
        (0.0996, 2, "0.1 m"),
        (0.0994, 2, "99 mm"),
        (999.9, 3, "1 km"),
        (998.6, 3, "999 m"),
        (123_456, 2, "120 km"),
        (0.00123, 2, "1.2 mm"),
        (0, 3, "0 mm"),
    ],
)
def test_length_is_rounded_before_its_unit_is_chosen(metres: float, digits: int, text: str) -> None:
    assert show_length(metres, digits) == text
