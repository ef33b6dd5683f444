"""Pinhole cameras, the three range types, and pictures without the distortion of a lens.

Frame: x right, y down, z forward. Pixel centres sit at integer coordinates, so pixel (row v, column u) looks along the
ray r(u, v) = ((u - cx) / fx, (v - cy) / fy, 1). Models of lenses are from calib3d.hpp of opencv/opencv,
``rs2_project_point_to_pixel`` in src/rs.cpp of IntelRealSense/librealsense, and src/colmap/sensor/models.h of
colmap/colmap.
"""

from __future__ import annotations

import functools
import importlib
import math
from dataclasses import FrozenInstanceError, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from dsr.geometry import RANGE_TYPES, RangeType
from dsr.utils.guards import derived, expect_one_of, is_number, naming

# baseline in metres of the virtual stereo pair of a camera without a second one (Voynov et al. 2019)
VIRTUAL_BASELINE = 0.2
# horizontal field of view in degrees, about that of a phone's main camera and of a depth camera's colour sensor
ASSUMED_FOV = 60.0


@dataclass(unsafe_hash=True)
class Camera:
    """A pinhole camera, optionally the left one of a rectified stereo pair.

    Args:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels. A negative ``fy`` (ICL-NUIM) means that the calibration's y axis points up;
            its absolute value is stored, because y always points down here.
        cx, cy: principal point in pixels, pixel centres at integers.
        baseline: distance to the second camera in metres, None where there is none.
        doffs: difference of the two principal points' x in pixels.

    Example:
        >>> import dsr
        >>> camera = dsr.Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
        >>> camera.rescale(320, 240).fx  # of the same view in fewer pixels
        262.5
        >>> camera.rays().shape
        torch.Size([3, 480, 640])

    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float | None = None
    doffs: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not is_number(value) or not float(value).is_integer() or value < 1:
                raise ValueError(f"camera {name}: expected a positive whole number, got {value!r:.60}")
        for name in ("fx", "fy", "cx", "cy", "doffs"):
            if not is_number(getattr(self, name)):
                raise ValueError(f"camera {name}: expected a finite number, got {getattr(self, name)!r:.60}")
        if self.fx <= 0:
            raise ValueError(f"camera fx: expected a positive number of pixels, got {self.fx!r}")
        if self.fy == 0:
            raise ValueError("camera fy: expected a number of pixels other than 0")
        if self.baseline is not None and not (is_number(self.baseline) and self.baseline > 0):
            raise ValueError(f"camera baseline: expected a positive number of metres, got {self.baseline!r}")
        object.__setattr__(self, "fy", abs(self.fy))
        for name, value in vars(self).items():
            if value is not None and not isinstance(value, int | float):
                object.__setattr__(self, name, int(value) if name in ("width", "height") else float(value))

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse another value; Lightning and torchmetrics copy a batch by setting each field of a copy again."""
        if name not in self.__dataclass_fields__ or vars(self).setdefault(name, value) is not value:
            raise FrozenInstanceError(f"cannot assign to field {name!r}")

    @classmethod
    def centred(cls, width: int, height: int, focal: float) -> Self:
        """Return the camera with a focal length in pixels and the principal point in the middle of the image."""
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @classmethod
    def from_fov(cls, degrees: float, width: int, height: int) -> Self:
        """Return the camera with a horizontal field of view in degrees and the principal point in the middle."""
        if not is_number(degrees) or not 0 < degrees < 180:
            raise ValueError(f"degrees: expected a horizontal field of view above 0 and below 180, got {degrees!r:.60}")
        return cls.centred(width, height, width / 2 / math.tan(math.radians(degrees) / 2))

    @classmethod
    def from_matrix(cls, matrix: Any, width: int, height: int) -> Self:
        """Return the camera of a matrix of intrinsics.

        The matrix, (fx 0 cx; 0 fy cy; 0 0 1) in pixels, may be nested lists, an array or a tensor, and larger: 3 x 4 as
        ROS's P, or 4 x 4.

        Example:
            >>> import dsr
            >>> dsr.Camera.from_matrix([[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]], width=640, height=480)
            Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5, baseline=None, doffs=0.0)

        """
        with naming("matrix"):
            (fx, _, cx), (_, fy, cy), _ = expect_intrinsics(matrix).tolist()
        return cls(width, height, fx, fy, cx, cy)

    @classmethod
    def from_json(cls, path: str | Path) -> Self:
        """Return the camera of dsr's ``camera.json``, Open3D's JSON, or ``cam_params.json`` as NICE-SLAM has it."""
        read = importlib.import_module("dsr.io.cameras").read_camera  # files are read on a floor above
        return cls(**vars(read(Path(path)).camera))

    def crop(self, top: int, left: int, height: int, width: int) -> Camera:
        """Return the camera of the ``height x width`` window whose first pixel is (``top``, ``left``)."""
        inside = 0 <= top <= top + height <= self.height and 0 <= left <= left + width <= self.width
        if not inside or height < 1 or width < 1:
            got = f"{height} x {width} at row {top}, column {left}"
            raise ValueError(f"crop: expected a window within {self.height} x {self.width}, got {got}")
        return derived(self, width=int(width), height=int(height), cx=float(self.cx - left), cy=float(self.cy - top))

    def rescale(self, width: int, height: int) -> Camera:
        """Return the camera of the same view in ``width x height`` pixels; the image's outer edge stays where it is."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
            doffs=self.doffs * sx,
        )

    def downscale(self, factor: int) -> Camera:
        """Return the camera of a map downsampled by ``factor``, of the part of the image that the factor divides."""
        width, height = self.width // factor, self.height // factor
        return self.crop(0, 0, height * factor, width * factor).rescale(width, height)

    def ratio_to(self, width: int, height: int) -> float:
        """Return how many pixels of this camera lie side by side in one of a smaller map of the same view.

        It is whole, an ``int``, if the map has the size of :meth:`downscale`, else the ratio of the widths, or of the
        heights where that of the widths is whole.
        """
        factor = self.width // width
        if factor and (width, height) == (self.width // factor, self.height // factor):
            return factor
        return self.height / height if self.width % width == 0 else self.width / width

    def reduce(self, width: int, height: int) -> Camera:
        """Return the camera of a smaller map of the same view; see :meth:`ratio_to`."""
        ratio = self.ratio_to(width, height)
        return self.downscale(ratio) if isinstance(ratio, int) else self.rescale(width, height)

    def decimate(self, factor: int, offset: float) -> Camera:
        """Return the camera whose pixel (i, j) is this one's (i * factor + offset, j * factor + offset)."""
        return replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=(self.cx - offset) / factor,
            cy=(self.cy - offset) / factor,
            doffs=self.doffs / factor,
        )

    def rotate90(self, turns: int = 1) -> Camera:
        """Return the camera of the image turned by quarter turns counterclockwise, as by ``torch.rot90``."""
        camera = self
        for _ in range(turns % 4):
            camera = derived(
                camera,
                width=camera.height,
                height=camera.width,
                fx=camera.fy,
                fy=camera.fx,
                cx=camera.cy,
                cy=camera.width - 1 - camera.cx,
            )
        return camera

    def rays(self, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
        """Return the rays r(u, v) with z = 1, shape (3, H, W)."""
        x = (torch.arange(self.width, dtype=dtype, device=device) - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=dtype, device=device) - self.cy) / self.fy
        shape = (self.height, self.width)
        return torch.stack((x.expand(shape), y[:, None].expand(shape), torch.ones(shape, dtype=dtype, device=device)))

    def ray_lengths(self, *, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> Tensor:
        """Return |r(u, v)|, shape (H, W): the perspective depth of a point with orthogonal depth 1."""
        return self.rays(dtype=dtype, device=device).square().sum(dim=0).sqrt()


default_collate_fn_map[Camera] = lambda batch, **_: list(batch)  # of a DataLoader, for metrics
_SKEW = 0.01  # largest skew of a matrix of intrinsics, as a share of fx, that is taken for rounding


def expect_intrinsics(matrix: Any) -> np.ndarray:
    """Return the intrinsics, (3, 3) float64, that a 3 x 3, 3 x 4 or 4 x 4 matrix begins with."""
    expected = "expected a matrix (fx 0 cx; 0 fy cy; 0 0 1)"
    try:
        values = np.asarray(matrix.detach().cpu().double() if isinstance(matrix, Tensor) else matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{expected}, got {type(matrix).__name__}") from error
    if values.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"{expected} of shape (3, 3), got {values.shape}")
    values = values[:3, :3]
    upright = np.isfinite(values).all() and values[0, 0] > 0 and values[1, 1] > 0
    straight = values[1, 0] == 0 and abs(values[0, 1]) <= _SKEW * values[0, 0]
    if not (upright and straight and np.allclose(values[2], (0, 0, 1))):
        raise ValueError(f"{expected}, got {values.tolist()}")
    return values


def to_range(depth: Tensor, camera: Camera, range_type: RangeType) -> Tensor:
    """Convert orthogonal depth, (..., H, W) in metres, to another range type; NaN (a hole) stays NaN.

    ``perspective`` is the distance along the ray in metres, p = z |r|; ``disparity`` is in pixels,
    d = baseline * fx / z - doffs, with a virtual baseline of 0.2 m where the camera has none.
    """
    expect_one_of("range_type", range_type, RANGE_TYPES)
    if range_type == "orthogonal":
        return depth
    if range_type == "perspective":
        return depth * camera.ray_lengths(dtype=depth.dtype, device=depth.device)
    return baseline_times_focal(camera) / depth - camera.doffs


def from_range(values: Tensor, camera: Camera, range_type: RangeType) -> Tensor:
    """Convert a range map to orthogonal depth in metres; disparities at or beyond infinity become NaN, a hole."""
    expect_one_of("range_type", range_type, RANGE_TYPES)
    if range_type == "orthogonal":
        return values
    if range_type == "perspective":
        return values / camera.ray_lengths(dtype=values.dtype, device=values.device)
    shifted = values + camera.doffs
    return baseline_times_focal(camera) / torch.where(shifted > 0, shifted, torch.nan)  # no 0 * inf in gradients


def baseline_times_focal(camera: Camera) -> float:
    """Return baseline * fx in metre pixels, with the virtual baseline where the camera has none."""
    return (VIRTUAL_BASELINE if camera.baseline is None else camera.baseline) * camera.fx


# models of lenses, and how many coefficients they have
_COUNTS = {
    # OpenCV's and ROS's: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], a rational function
    "brown_conrady": (4, 5, 8, 12, 14),
    # RealSense's: k1 k2 p1 p2 k3, the tangential part of the point that the radial part moved; RealSense's "inverse
    # Brown Conrady" as well, which its SDK computes in the same way
    "modified_brown_conrady": (5,),
    "kannala_brandt": (4,),  # of fisheyes: k1 k2 k3 k4 of the angle
    "thin_prism_fisheye": (8,),  # COLMAP's and ETH3D's: k1 k2 p1 p2 k3 k4 sx1 sy1, Brown's of the angle and a prism's
}
_FISHEYES = ("kannala_brandt", "thin_prism_fisheye")
_MOST = (1 << 15) - 2  # largest width and height that OpenCV's remap takes


@dataclass(frozen=True)
class Lens:
    """A lens: where in the picture the points of a pinhole camera lie."""

    model: str  # one of _COUNTS
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

    Without a ``hole``, it is a photo, which is interpolated, else a map: a pixel gets the value of the nearest one.
    """
    import cv2  # noqa: PLC0415 - only pictures of lenses need it

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
    import cv2  # noqa: PLC0415 - only pictures of lenses need it

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
