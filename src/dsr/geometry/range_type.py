"""What the values of a depth map measure: depth along the axis, along the ray, or disparity."""

from typing import Literal, get_args

RangeType = Literal["orthogonal", "perspective", "disparity"]
RANGE_TYPES: tuple[RangeType, ...] = get_args(RangeType)
