"""The metrics of the protocol in plain NumPy and scikit-image, independent of the package."""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from skimage.filters import scharr_h, scharr_v
from skimage.metrics import structural_similarity

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

    def rays(self, height, width):
        """Return the rays with z = 1, (H, W, 3)."""
        v, u = np.mgrid[:height, :width]
        return np.stack(((u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)), axis=-1)


def normals_of(points):
    """Return the normals of points, (H, W, 3), by forward differences; NaN where a point that they need is."""
    along_u = np.diff(points, axis=1)
    along_u = np.concatenate((along_u, along_u[:, -1:]), axis=1)
    along_v = np.diff(points, axis=0)
    along_v = np.concatenate((along_v, along_v[-1:]), axis=0)
    normals = np.cross(along_v, along_u)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def reference_scores(prediction, target, intrinsics, mask=True):
    """Return every metric of two maps of orthogonal depth, (H, W) metres, by its name in score files.

    What is missing or masked is NaN on the way; a list has a value for each of the four lights.
    """
    known = np.isfinite(prediction) & np.isfinite(target) & mask
    points = [np.where(known, z, np.nan)[..., None] * intrinsics.rays(*z.shape) for z in (prediction, target)]
    perspective = [np.linalg.norm(each, axis=-1) for each in points]
    off, true = np.abs(perspective[0] - perspective[1])[known], perspective[1][known]
    shadings = [np.einsum("lc,hwc->lhw", LIGHTS, normals_of(each)) for each in points]
    squares = (shadings[0] - shadings[1]) ** 2
    renderings = [np.clip(shading, 0, 1) for shading in shadings]
    lit = np.isfinite(renderings[0][0]) & np.isfinite(renderings[1][0])
    apart = np.abs(renderings[0] - renderings[1])[:, lit]
    dissimilar = []
    for x, y in zip(*map(np.nan_to_num, renderings), strict=True):
        ssim_map = structural_similarity(x, y, data_range=2, full=True)[1][3:-3, 3:-3]
        dissimilar.append(1 - float(ssim_map[lit[3:-3, 3:-3]].mean()))
    return {
        "RMSE_d": np.sqrt((off**2).mean()),
        **{f"BadPix_d_{n}cm": np.mean(off > n / 100) for n in (1, 5, 10)},
        **{f"BadPix_d_{n}pct": np.mean(off > n / 100 * true) for n in (1, 5, 10)},
        "RMSE_v": np.sqrt(np.nanmean(squares[:3])),
        "RMSE_v1": [np.sqrt(np.nanmean(each)) for each in squares],
        **{f"BadPix_v_{n}": [np.mean(each > n / 255) for each in apart] for n in (1, 5, 10)},
        "DSSIM_v": dissimilar,
        "Bumpiness_d": _bumpiness(prediction, target, known),
    }


def _bumpiness(prediction, target, known):
    """Return the clipped norm of second derivatives of the difference of disparities."""
    difference = 20.48 / np.where(known, prediction, 1.0) - 20.48 / np.where(known, target, 1.7)
    squares = 0.0
    for outer in (scharr_v, scharr_h):
        derivative = np.pad(outer(difference)[1:-1, 1:-1], 1)
        for inner in (scharr_v, scharr_h):
            squares = squares + np.pad(inner(derivative)[1:-1, 1:-1], 1) ** 2
    needed = ndimage.minimum_filter(known.astype(int), 5, mode="constant", cval=1) == 1
    return float(100 * np.minimum(0.05, np.sqrt(squares))[needed].mean())
