"""The metrics of the protocol in plain NumPy and scikit-image, independent of the package."""

from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from skimage.filters import scharr_h, scharr_v
from skimage.metrics import structural_similarity

Array = np.ndarray[Any, Any]

LIGHTS = -np.array(
    [
        [0, np.sqrt(2 / 3), 1 / np.sqrt(3)],
        [1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [-1 / np.sqrt(2), -1 / np.sqrt(6), 1 / np.sqrt(3)],
        [0, 0, 1],
    ]
)


class Intrinsics(NamedTuple):
    """Focal lengths and principal point of a pinhole camera, in pixels with centres at integers."""

    fx: float
    fy: float
    cx: float
    cy: float

    def rays(self, height: int, width: int) -> Array:
        """Return the rays with z = 1, (H, W, 3)."""
        v, u = np.mgrid[:height, :width]
        return np.stack(((u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)), axis=-1)


class Reference:
    """The protocol, step by step; what is missing is NaN.

    Args:
        prediction: (H, W) orthogonal depth in metres.
        target: likewise.
        intrinsics: of the camera.
        mask: (H, W), false where pixels are not counted.

    """

    def __init__(self, prediction: Array, target: Array, intrinsics: Intrinsics, mask: Array | None = None) -> None:
        known = np.isfinite(prediction) & np.isfinite(target) & (True if mask is None else mask)
        self.depths = [np.where(known, z, np.nan) for z in (prediction, target)]
        self.points = [z[..., None] * intrinsics.rays(*z.shape) for z in self.depths]
        self.perspective = [np.linalg.norm(points, axis=-1) for points in self.points]
        self.normals = [self._normals(points) for points in self.points]
        self.shadings = [np.einsum("lc,hwc->lhw", LIGHTS, normals) for normals in self.normals]
        self.renderings = [np.clip(shading, 0, 1) for shading in self.shadings]

    @staticmethod
    def _normals(points: Array) -> Array:
        along_u = np.diff(points, axis=1)
        along_u = np.concatenate((along_u, along_u[:, -1:]), axis=1)
        along_v = np.diff(points, axis=0)
        along_v = np.concatenate((along_v, along_v[-1:]), axis=0)
        normals = np.cross(along_v, along_u)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def rmse_d(self) -> float:
        """Return the root mean square of differences of perspective depth."""
        first, second = self.perspective
        return float(np.sqrt(np.nanmean((first - second) ** 2)))

    def bad_pix_d(self, threshold: float, *, relative: bool) -> float:
        """Return the fraction of pixels whose perspective depth is off by more than a threshold."""
        first, second = self.perspective
        error = np.abs(first - second)[np.isfinite(first)]
        limit = threshold * second[np.isfinite(first)] if relative else threshold
        return float(np.mean(error > limit))

    def rmse_v(self) -> float:
        """Return the root mean square of differences of the first three shadings."""
        first, second = (shadings[:3] for shadings in self.shadings)
        return float(np.sqrt(np.nanmean((first - second) ** 2)))

    def rmse_v1(self) -> list[float]:
        """Return the same of each shading alone."""
        first, second = self.shadings
        return [float(np.sqrt(np.nanmean((first[i] - second[i]) ** 2))) for i in range(4)]

    def bad_pix_v(self, threshold: float) -> list[float]:
        """Return the fraction of pixels whose rendering is off by more than a threshold in 8-bit levels."""
        first, second = self.renderings
        known = np.isfinite(first[0])
        return [float(np.mean(np.abs(first[i] - second[i])[known] > threshold / 255)) for i in range(4)]

    def dssim_v(self) -> list[float]:
        """Return one minus the mean structural similarity of each rendering."""
        first, second = self.renderings
        centres = np.isfinite(first[0])[3:-3, 3:-3]
        values = []
        for x, y in zip(np.nan_to_num(first), np.nan_to_num(second), strict=True):
            ssim_map = structural_similarity(x, y, data_range=2, full=True)[1][3:-3, 3:-3]
            values.append(1 - float(ssim_map[centres].mean()))
        return values

    def bumpiness_d(self) -> float:
        """Return the clipped norm of second derivatives of the difference of disparities."""
        first, second = self.depths
        known = np.isfinite(first)
        difference = 20.48 / np.where(known, first, 1.0) - 20.48 / np.where(known, second, 1.7)
        squares = 0.0
        for outer in (scharr_v, scharr_h):
            derivative = _zero_border(outer(difference))
            squares = squares + sum(_zero_border(inner(derivative)) ** 2 for inner in (scharr_v, scharr_h))
        needed = ndimage.minimum_filter(known.astype(int), 5, mode="constant", cval=1) == 1
        return float(100 * np.minimum(0.05, np.sqrt(squares))[needed].mean())

    def all_metrics(self) -> dict[str, float | list[float]]:
        """Return every metric by its name in score files; a list has a value for each of the four lights."""
        return {
            "RMSE_d": self.rmse_d(),
            **{f"BadPix_d_{n}cm": self.bad_pix_d(n / 100, relative=False) for n in (1, 5, 10)},
            **{f"BadPix_d_{n}pct": self.bad_pix_d(n / 100, relative=True) for n in (1, 5, 10)},
            "RMSE_v": self.rmse_v(),
            "RMSE_v1": self.rmse_v1(),
            **{f"BadPix_v_{n}": self.bad_pix_v(n) for n in (1, 5, 10)},
            "DSSIM_v": self.dssim_v(),
            "Bumpiness_d": self.bumpiness_d(),
        }


def _zero_border(values: Array) -> Array:
    return np.pad(values[1:-1, 1:-1], 1)
