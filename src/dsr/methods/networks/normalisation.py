"""Operations on maps that several networks share: normalise, smooth, interpolate."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera

_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


class Normalised(NamedTuple):
    """A map normalised to 0..1 per sample, (B, 1, H, W), and its minimum and range, (B, 1, 1, 1), to undo it."""

    values: Tensor
    minimum: Tensor
    value_range: Tensor


def normalise(x: Tensor, min_max: Tensor | None = None) -> Normalised:
    """Return (x - min) / (max - min) per sample of (B, 1, H, W), over the finite values; the others become 0.

    A constant map becomes 0 with a range of 0. Without a finite value, the minimum is NaN.

    ``min_max`` (B, 2, 1, 1) are the minimum and maximum to use; None for those of the map.
    """
    valid = x.isfinite()
    min_max = compute_min_max(x) if min_max is None else min_max.to(x)
    minimum = min_max[:, :1]
    value_range = min_max[:, 1:] - minimum  # -inf where nothing is finite
    values = torch.where(valid, x - minimum, 0) / torch.where(value_range > 0, value_range, 1)
    return Normalised(values, torch.where(value_range >= 0, minimum, torch.nan), value_range)


def compute_min_max(x: Tensor) -> Tensor:
    """Return the minimum and the maximum finite value of each map of (B, 1, H, W), (B, 2, 1, 1).

    They are infinity and minus infinity for a map without a finite value.
    """
    valid, dims = x.isfinite(), (-3, -2, -1)
    lowest = x.masked_fill(~valid, torch.inf).amin(dims, keepdim=True)
    return torch.cat((lowest, x.masked_fill(~valid, -torch.inf).amax(dims, keepdim=True)), dim=1)


def mean3x3(x: Tensor) -> Tensor:
    """Return the 3 x 3 mean of (B, 1, H, W); edge pixels are repeated."""
    return functional.avg_pool2d(functional.pad(x, (1, 1, 1, 1), mode="replicate"), 3, stride=1)


def upsample_bicubic(x: Tensor, scale: int) -> Tensor:
    """Upsample (B, 1, h, w) to (B, 1, scale h, scale w): Keys' cubic kernel with a = -0.5, as Pillow resizes.

    At the border, the kernel is truncated and renormalised.
    """
    height, width = x.shape[-2:]
    return resize_bicubic(x, (scale * height, scale * width))


def resize_bicubic(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Enlarge (B, 1, h, w) to (B, 1, *size), as :func:`upsample_bicubic` does by a whole factor."""
    return functional.interpolate(x, size=size, mode="bicubic", align_corners=False, antialias=True)


def normalise_imagenet(rgb: Tensor) -> Tensor:
    """Return images, (B, 3, H, W) in 0..1, minus the mean colour of ImageNet, divided by its standard deviation."""
    mean, deviation = (rgb.new_tensor(values).view(3, 1, 1) for values in (_IMAGENET_MEAN, _IMAGENET_DEVIATION))
    return (rgb - mean) / deviation


def lr_coordinates(camera: Camera, camera_lr: Camera, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """Return the low-resolution row of each high-resolution row, (H,), and likewise the columns, (W,), in float64."""
    rows = torch.arange(camera.height, dtype=torch.float64, device=device)
    columns = torch.arange(camera.width, dtype=torch.float64, device=device)
    return (
        (rows - camera.cy) / camera.fy * camera_lr.fy + camera_lr.cy,
        (columns - camera.cx) / camera.fx * camera_lr.fx + camera_lr.cx,
    )
