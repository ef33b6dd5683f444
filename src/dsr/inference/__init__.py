"""Upsample the depth map of a photo: any size, any ratio of the sizes, maps with holes, bounded memory."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dsr.inference.options import DEFAULT, WIDEST, Fill

if TYPE_CHECKING:
    from dsr.inference.api import upsample, upsample_with_errors
    from dsr.inference.engine import (
        MethodChoice,
        check_settings,
        check_working_size,
        find_sensor,
        upsample_depth,
        upsample_surface,
    )
    from dsr.inference.inspection import enlarged_by
    from dsr.inference.planning import Plan, plan

__all__ = [
    "DEFAULT",
    "WIDEST",
    "Fill",
    "MethodChoice",
    "Plan",
    "check_settings",
    "check_working_size",
    "enlarged_by",
    "find_sensor",
    "plan",
    "upsample",
    "upsample_depth",
    "upsample_surface",
    "upsample_with_errors",
]

_NAMES = {
    "api": ("upsample", "upsample_with_errors"),
    "engine": (
        "MethodChoice",
        "check_settings",
        "check_working_size",
        "find_sensor",
        "upsample_depth",
        "upsample_surface",
    ),
    "inspection": ("enlarged_by",),
    "planning": ("Plan", "plan"),
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: the options alone load nothing heavy."""
    for module, names in _NAMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
