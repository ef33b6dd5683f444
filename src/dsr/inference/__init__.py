"""Upsample the depth map of a photo: any size, any ratio of the sizes, maps with holes, bounded memory."""

import importlib
from typing import Any, Literal

DEFAULT = "facets"  # the method where none is chosen
Fill = Literal["all", "small", "none"]  # which holes are filled
# Degrees of view of the widest hole that counts as small. On Middlebury 2014 and ICL-NUIM with holes cut into them,
# depth that ``facets`` fills in is off by 1.2 % on average at 0.2 to 0.4 degrees from a measured pixel, by 3 % at 0.7
# to 1 degree, and by 6 % and more beyond; half of these pixels are off by more than 2 %.
WIDEST = 2.0
_MODULES = {
    "Steady": "steady",
    "find_sensor": "working_size",
    "upsample_surface": "any_ratio",
    "upsampler": "any_ratio",
}


def __getattr__(name: str) -> Any:
    """Import a function when it is asked for: the choices above load nothing heavy."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
