"""Pixels and those around them: distances to measured ones, wide holes, largest values of windows."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

_NARROW = 2.5  # radius in pixels below which a hole is not wide, however coarse the map is
_TOGETHER = 0.5  # share of measured pixels whose four neighbours are measured, below which a map is of single points


def distance_to_known(known: Tensor) -> Tensor:
    """Return each pixel's distance to the nearest known one in pixels, (1, h, w); 0 there, infinite without any."""
    if not bool(known.any()):
        return torch.full(known.shape, math.inf, device=known.device)
    unknown = (~known)[0].cpu().numpy().astype(np.uint8)
    found = cv2.distanceTransform(unknown, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return torch.from_numpy(found)[None].to(known.device)


def degrees_per_pixel(focal: float) -> float:
    """Return the angle of view of a pixel in the middle of an image, in degrees, for a focal length in pixels."""
    return math.degrees(math.atan(1 / focal))


def wide_holes(known: Tensor, width: float) -> Tensor:
    """Return the parts of holes, (1, h, w) bool, wider than max(``width``, 5) pixels: the holes' opening by a disc."""
    radius = max(width / 2, _NARROW)
    core = distance_to_known(known) - 0.5 > radius  # from the known pixel's edge
    return ~known & (distance_to_known(core) <= radius + 0.5)


def is_scattered(known: Tensor) -> bool:
    """Return whether the known pixels of a map, (1, h, w), are single points, as those of a laser scanner."""
    inner = known[:, 1:-1, 1:-1]
    beside = known[:, :-2, 1:-1] & known[:, 2:, 1:-1] & known[:, 1:-1, :-2] & known[:, 1:-1, 2:]
    return bool((inner & beside).sum() < _TOGETHER * inner.sum())


def window_maxima(values: Tensor, reach: int) -> Tensor:
    """Return the largest values within ``reach`` rows and columns of each pixel, (1, h, w), without NaN."""
    result = functional.pad(values, (reach,) * 4, value=-math.inf)
    for dim in (-2, -1):
        size = 1
        while size < 2 * reach + 1:  # of windows twice as large, until they are large enough
            shift = min(size, 2 * reach + 1 - size)
            rest = result.shape[dim] - shift
            result = torch.maximum(result.narrow(dim, 0, rest), result.narrow(dim, shift, rest))
            size += shift
    return result
