"""What the values of a depth map measure, and the names of the paper's four lights."""

from typing import Literal, get_args

RangeType = Literal["orthogonal", "perspective", "disparity"]
RANGE_TYPES: tuple[RangeType, ...] = get_args(RangeType)

LIGHT_NAMES: tuple[str, ...] = ("e1", "e2", "e3", "e4")
