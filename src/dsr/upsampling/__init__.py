"""Finer depth for anybody's photo and depth map: any size, any ratio of the sizes, holes, bounded memory."""

from dsr.upsampling.engine import enlarged_by, upsample_depth
from dsr.upsampling.people import upsample
from dsr.upsampling.planning import METHODS, Plan, plan

__all__ = ["METHODS", "Plan", "enlarged_by", "plan", "upsample", "upsample_depth"]
