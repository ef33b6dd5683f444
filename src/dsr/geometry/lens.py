"""Lens distortion, and pictures without it: as the pinhole camera of the same intrinsics sees them.

    brown_conrady             OpenCV's and ROS's: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], a rational function
    modified_brown_conrady    RealSense's: k1 k2 p1 p2 k3, the tangential part of the point that the radial part moved;
                              RealSense's "inverse Brown Conrady" as well, which its SDK computes in the same way
    kannala_brandt            of fisheyes: k1 k2 k3 k4 of the angle
    thin_prism_fisheye        COLMAP's and ETH3D's: k1 k2 p1 p2 k3 k4 sx1 sy1, Brown's of the angle and a prism's

calib3d.hpp of https://github.com/opencv/opencv, ``rs2_project_point_to_pixel`` in src/rs.cpp of
https://github.com/IntelRealSense/librealsense, and src/colmap/sensor/models.h of https://github.com/colmap/colmap.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from dsr.geometry.camera import Camera

_COUNTS = {
    "brown_conrady": (4, 5, 8, 12, 14),
    "modified_brown_conrady": (5,),
    "kannala_brandt": (4,),
    "thin_prism_fisheye": (8,),
}
_FISHEYES = ("kannala_brandt", "thin_prism_fisheye")
_MOST = (1 << 15) - 2  # largest width and height that OpenCV's remap takes


@dataclass(frozen=True)
class Lens:
    """A lens: where in the picture the points of a pinhole camera lie."""

    model: str  # one of those of the module's text
    coefficients: tuple[float, ...]  # as many as the model has

    def __post_init__(self) -> None:
        if self.model not in _COUNTS:
            raise ValueError(f"lens: expected a model of {', '.join(_COUNTS)}, got {self.model!r:.60}")
        count, counts = len(self.coefficients), _COUNTS[self.model]
        if count not in counts or not np.isfinite(self.coefficients).all():
            wanted = " or ".join(map(str, counts))
            raise ValueError(f"lens: expected {wanted} finite numbers of {self.model}, got {self.coefficients!s:.120}")

    def __str__(self) -> str:
        return f"{self.model} {' '.join(f'{each:g}' for each in self.coefficients)}"

    @property
    def bends(self) -> bool:
        """Whether it distorts at all: a fisheye lens does even if all coefficients are 0."""
        return any(self.coefficients) or self.model in _FISHEYES


def undistort(picture: np.ndarray, camera: Camera, lens: Lens, hole: float | None = None) -> np.ndarray:
    """Return a picture, (h, w) or (h, w, 3), as the pinhole camera of the same intrinsics sees it.

    Without a ``hole``, the picture is a photo: it is interpolated, and continued at its border. With one, it is a map:
    a pixel gets the value of the nearest one, and ``hole`` outside of the map.
    """
    if picture.shape[:2] != (camera.height, camera.width) or max(picture.shape[:2]) > _MOST:
        got = f"{picture.shape[1]} x {picture.shape[0]}"
        raise ValueError(f"lens: expected {camera.width} x {camera.height} pixels, each at most {_MOST}, got {got}")
    x, y = _places(camera, lens)
    if hole is None:
        return cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    column, row = np.rint(x).astype(np.int32), np.rint(y).astype(np.int32)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    found = np.full_like(picture, hole)
    found[inside] = picture[row[inside], column[inside]]
    return found


@functools.lru_cache(maxsize=2)  # the photo's and the depth map's
def _places(camera: Camera, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and rows of a picture where the pixels of the pinhole camera lie, (h, w) float32 each."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float64)
    numbers, size, kind = np.array(lens.coefficients, np.float64), (camera.width, camera.height), cv2.CV_32FC1
    if lens.model == "brown_conrady":
        places = cv2.initUndistortRectifyMap(matrix, numbers, None, matrix, size, kind)
    elif lens.model == "kannala_brandt":
        places = cv2.fisheye.initUndistortRectifyMap(matrix, numbers, np.eye(3), matrix, size, kind)
    else:
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height)[:, None] - camera.cy) / camera.fy
        k1, k2, p1, p2, k3, *others = lens.coefficients
        if lens.model == "modified_brown_conrady":
            square = x * x + y * y
            radial = 1 + square * (k1 + square * (k2 + square * k3))
            x, y = x * radial, y * radial
            dx, dy = p2 * (square + 2 * x * x), p1 * (square + 2 * y * y)
            x, y = x + 2 * p1 * x * y + dx, y + 2 * p2 * x * y + dy
        else:
            k4, sx1, sy1 = others
            angle = np.hypot(x, y)
            shrinks = np.divide(np.arctan(angle), angle, out=np.ones_like(angle), where=angle > 0)
            x, y = x * shrinks, y * shrinks
            square = x * x + y * y
            radial = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
            dx = 2 * p1 * x * y + p2 * (square + 2 * x * x) + sx1 * square
            dy = 2 * p2 * x * y + p1 * (square + 2 * y * y) + sy1 * square
            x, y = x * radial + dx, y * radial + dy
        places = (x * camera.fx + camera.cx, y * camera.fy + camera.cy)
    outside = -2.0 * _MOST
    x, y = (np.clip(np.nan_to_num(each, nan=outside), outside, 2 * _MOST).astype(np.float32) for each in places)
    return x, y
