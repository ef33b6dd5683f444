"""Cameras, surface normals, shading and meshes."""

from typing import Literal, get_args

# of a depth map: depth along the axis, distance along the ray, or disparity
RangeType = Literal["orthogonal", "perspective", "disparity"]
RANGE_TYPES: tuple[RangeType, ...] = get_args(RangeType)
