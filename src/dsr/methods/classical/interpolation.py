"""Interpolation of the LR depth alone: nearest neighbour, bilinear, cubic spline (the paper's "Bicubic")."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.methods.networks.maps import lr_coordinates
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

Order = Literal["nearest", "bilinear", "bicubic"]


class Interpolation:
    """Spline interpolation of the coarse perspective depth; the photo is not looked at.

    ``bicubic`` is the interpolating cubic spline, with the outermost pixels repeated beyond the border. Coarse and fine
    pixels are matched through their cameras, so each downsampling model's own pixel centres are honoured.

    Args:
        order: ``nearest``, ``bilinear`` or ``bicubic``.
        fill_holes: whether holes of the low-resolution map are filled with their nearest known pixel; otherwise a
            high-resolution pixel whose nearest low-resolution pixel is a hole stays one.

    Raises:
        ValueError: an unknown order.

    """

    range_type: RangeType = "perspective"

    def __init__(self, order: Order = "bicubic", *, fill_holes: bool = False) -> None:
        if order not in get_args(Order):
            raise ValueError(f"order: expected one of {', '.join(get_args(Order))}, got {order!r}")
        self._degree = {"nearest": 0, "bilinear": 1, "bicubic": 3}[order]
        self._fill_holes = fill_holes

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres."""
        return self.interpolated(sample.depth_lr, sample.camera_lr, sample.camera)

    def interpolated(self, depth: Tensor, camera: Camera, fine_camera: Camera) -> Tensor:
        """Return depth, (1, h, w) in metres, at the pixels of another camera, whatever the ratio of their sizes."""
        coarse = to_range(depth, camera, "perspective")[0]
        known = depth.isfinite()[0].cpu().numpy()
        values = coarse.cpu().numpy()
        if not known.all():
            nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
            values = values[tuple(nearest)]
        places = lr_coordinates(fine_camera, camera)
        where = torch.stack(torch.meshgrid(*places, indexing="ij")).numpy()
        fine = ndimage.map_coordinates(values, where, order=self._degree, mode="nearest")
        if not (known.all() or self._fill_holes):
            fine[ndimage.map_coordinates(known.astype(np.uint8), where, order=0, mode="nearest") == 0] = np.nan
        fine[fine <= 0] = np.nan  # a spline may overshoot beside a depth step
        return from_range(torch.from_numpy(fine).to(coarse)[None], fine_camera, "perspective")
