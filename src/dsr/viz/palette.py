"""One colour per method, the same in every figure; colour-blind readers can distinguish them."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

FIXED = {
    "Bicubic": "#8b8f8f", "SRfS": "#efe845", "EG": "#1b570d", "PDN": "#50ddae", "DG": "#9d54a6", "DIP": "#de9257",
    "DIP-V": "#521b2e", "MSG": "#65b3e6", "MSG-V": "#0f165b", "Facets": "#d52554",
}  # fmt: skip
"""Colours of the paper's methods and Facets. Any two differ by 16 in CIEDE2000, also to protanopes and deuteranopes."""
_FREE = ("#999933", "#c9a0dc", "#004d40", "#f5a3b5", "#7fb800", "#0072b2", "#5c4033", "#000000")
_GOLDEN = 0.618033988749895


def method_colours(labels: Sequence[str]) -> dict[str, str]:
    """Return a colour per label as ``#rrggbb``.

    The colour of a method in ``FIXED`` does not depend on the other labels; other methods take the free
    colours in order.
    """
    others = [label for label in dict.fromkeys(labels) if label not in FIXED]
    free = {
        label: _FREE[number] if number < len(_FREE) else _generate_colour(number) for number, label in enumerate(others)
    }
    return {label: FIXED.get(label) or free[label] for label in labels}


def _generate_colour(number: int) -> str:
    """Generate a colour: successive hues are a golden section apart, in three alternating lightnesses."""
    red, green, blue = colorsys.hls_to_rgb(number * _GOLDEN % 1, (0.38, 0.55, 0.72)[number % 3], 0.6)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"
