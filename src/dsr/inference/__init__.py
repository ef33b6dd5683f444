"""Finer depth for anybody's photo and depth map: any size, any ratio of the sizes, holes, bounded memory."""

from dsr.inference.api import upsample
from dsr.inference.engine import upsample_depth
from dsr.inference.inspection import NOISY, enlarged_by, suited_method
from dsr.inference.planning import AUTO, METHODS, Plan, plan

__all__ = ["AUTO", "METHODS", "NOISY", "Plan", "enlarged_by", "plan", "suited_method", "upsample", "upsample_depth"]
