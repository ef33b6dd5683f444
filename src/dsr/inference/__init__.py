"""Upsample the depth map of a photo: any size, any ratio of the sizes, maps with holes, bounded memory."""

from dsr.inference.api import upsample
from dsr.inference.engine import MethodChoice, check_settings, upsample_depth
from dsr.inference.inspection import NOISY, enlarged_by, suited_method
from dsr.inference.planning import AUTO, Plan, plan

__all__ = [
    "AUTO",
    "NOISY",
    "MethodChoice",
    "Plan",
    "check_settings",
    "enlarged_by",
    "plan",
    "suited_method",
    "upsample",
    "upsample_depth",
]
