"""One colour per method, the same in every figure, told apart by colour-blind readers."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

KNOWN = {
    "Bicubic": "#8b8f8f", "SRfS": "#efe845", "EG": "#1b570d", "PDN": "#50ddae", "DG": "#9d54a6", "DIP": "#de9257",
    "DIP-V": "#521b2e", "MSG": "#65b3e6", "MSG-V": "#0f165b", "Facets": "#d52554",
}  # fmt: skip
"""The paper's methods and Facets; any two differ by 16 in CIEDE2000, to readers without red or green cones, too."""
_FREE = ("#999933", "#c9a0dc", "#004d40", "#f5a3b5", "#7fb800", "#0072b2", "#5c4033", "#000000")
_GOLDEN = 0.618033988749895


def method_colours(labels: Sequence[str]) -> dict[str, str]:
    """Return a colour per label as ``#rrggbb``.

    A known method's colour does not depend on which others there are; the rest take the free colours in their order.
    """
    others = [label for label in dict.fromkeys(labels) if label not in KNOWN]
    free = {label: _FREE[number] if number < len(_FREE) else _made(number) for number, label in enumerate(others)}
    return {label: KNOWN.get(label) or free[label] for label in labels}


def _made(number: int) -> str:
    """Return one of endlessly many colours: hues a golden section apart, lighter and darker ones in turns."""
    red, green, blue = colorsys.hls_to_rgb(number * _GOLDEN % 1, (0.38, 0.55, 0.72)[number % 3], 0.6)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"
