"""The bilateral filter of a sensor's own depth map, without the photo: the baseline for noisy maps.

Tomasi and Manduchi, *Bilateral Filtering for Gray and Color Images*, ICCV 1998. A pixel becomes the mean of the pixels
of a round window, weighted by Gaussians of their distance and of the difference of their depths: noise is averaged,
while a depth step of several ``sigma_depth`` stays. Where the photo has more pixels than the map, the filtered map is
then interpolated: bilinear means of the planes that its pixels stand for, see
:mod:`dsr.methods.classical.photo_guided`.

Holes have no weight and stay holes; with ``fill_holes`` they are inpainted after filtering. OpenCV filters, in float32,
with weights from a table of 4096 entries over the map's range of depth.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import RangeType
from dsr.methods.base import Abilities, Cost
from dsr.methods.classical.photo_guided import Guided, GuidedMethod, expect_positive
from dsr.methods.inpainting import inpaint
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

_NO_WEIGHT = 10.0
"""Standard deviations of depth at which a pixel has no weight: exp(-50)."""


class Bilateral(GuidedMethod):
    """The bilateral filter of the low-resolution depth, and its interpolation where the scale is above 1.

    The defaults suit structured-light and time-of-flight cameras at 0.5 to 2 m, whose noise is a few millimetres. Noise
    grows with distance: a larger ``sigma_depth`` suits maps of rooms.

    Args:
        window: diameter of the window in low-resolution pixels.
        sigma_depth: standard deviation of the Gaussian of depth differences, in metres.
        sigma_space: standard deviation of the Gaussian of distances, in low-resolution pixels.
        fill_holes: whether holes are inpainted; otherwise a high-resolution pixel whose nearest low-resolution pixel is
            a hole is a hole.

    Raises:
        ValueError: a value is not positive.

    """

    abilities = Abilities(ratios="any", at_ratio=True, own_size=True, cost=Cost(150, 1))
    range_type: RangeType = "orthogonal"

    def __init__(
        self, window: int = 19, sigma_depth: float = 0.03, sigma_space: float = 3.0, *, fill_holes: bool = False
    ) -> None:
        super().__init__(fill_holes=fill_holes, slopes=True)
        expect_positive("the bilateral filter", window=window, sigma_depth=sigma_depth, sigma_space=sigma_space)
        self._window, self._sigma_depth, self._sigma_space = window, sigma_depth, sigma_space

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        filtered = filter_bilateral(sample.depth_lr, self._window, self._sigma_depth, self._sigma_space)
        if sample.scale > 1:
            return super().__call__(replace(sample, depth_lr=filtered), progress)
        return inpaint(filtered[None])[0] if self._fill_holes else filtered

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the interpolated maps, (N, H, W); the photo is not used."""
        return guided.interpolate()[0]


def filter_bilateral(depth: Tensor, window: int, sigma_depth: float, sigma_space: float) -> Tensor:
    """Filter a depth map, (1, h, w) in metres, NaN in holes, which stay holes; see the module.

    Args:
        depth: the map.
        window: diameter in pixels.
        sigma_depth: in metres.
        sigma_space: in pixels.

    """
    values = depth[0].cpu().numpy().astype(np.float32)
    valid = np.isfinite(values)
    outside = min(0.0, float(values[valid].min()) - _NO_WEIGHT * sigma_depth)
    filtered = cv2.bilateralFilter(np.where(valid, values, np.float32(outside)), window, sigma_depth, sigma_space)
    return torch.from_numpy(np.where(valid, filtered, np.nan))[None].to(depth)
