"""Upsample the depth map of a photo: any size, any ratio of the sizes, maps with holes, bounded memory."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dsr.inference.defaults import DEFAULT, WIDEST, Fill

if TYPE_CHECKING:
    from dsr.inference.any_ratio import AnyRatio, upsample_surface, upsampler
    from dsr.inference.plans import Plan, plan_for
    from dsr.inference.plausibility import find_filled
    from dsr.inference.selection import Selection, select
    from dsr.inference.working_size import enlarged_by, find_sensor

__all__ = [
    "DEFAULT",
    "WIDEST",
    "AnyRatio",
    "Fill",
    "Plan",
    "Selection",
    "enlarged_by",
    "find_filled",
    "find_sensor",
    "plan_for",
    "select",
    "upsample_surface",
    "upsampler",
]

_NAMES = {
    "any_ratio": ("AnyRatio", "upsample_surface", "upsampler"),
    "plans": ("Plan", "plan_for"),
    "plausibility": ("find_filled",),
    "selection": ("Selection", "select"),
    "working_size": ("enlarged_by", "find_sensor"),
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: the options alone load nothing heavy."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
