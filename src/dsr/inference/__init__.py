"""Upsample the depth map of a photo: any size, any ratio of the sizes, maps with holes, bounded memory."""

from dsr.inference.api import upsample, upsample_with_errors
from dsr.inference.engine import WIDEST, Fill, MethodChoice, check_settings, upsample_depth, upsample_surface
from dsr.inference.inspection import enlarged_by
from dsr.inference.planning import DEFAULT, Plan, plan

__all__ = [
    "DEFAULT",
    "WIDEST",
    "Fill",
    "MethodChoice",
    "Plan",
    "check_settings",
    "enlarged_by",
    "plan",
    "upsample",
    "upsample_depth",
    "upsample_surface",
    "upsample_with_errors",
]
