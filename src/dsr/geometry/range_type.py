"""Range types of depth maps: depth along the axis, distance along the ray, or disparity."""

from typing import Literal, get_args

RangeType = Literal["orthogonal", "perspective", "disparity"]
RANGE_TYPES: tuple[RangeType, ...] = get_args(RangeType)
