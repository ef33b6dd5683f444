"""Plausible depth: removal of outliers, limits of results, and expected errors from the agreement with the input.

The expected errors of methods that predict none are estimated as follows. The result, averaged over low-resolution
pixels, is compared with the input averaged over 3 x 3 pixels: they differ by noise that the method has copied, by
detail that it has smoothed, and at depth steps, where results are worst. In holes the expected error grows with the
angular distance from the nearest measured pixel. This is a rough estimate, which sorts the pixels better than it states
their errors.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import degrees_per_pixel, distance_to_known, window_maxima
from dsr.geometry.surface import angle_between, depth_to_normals
from dsr.inference.resizing import resize_nearest, size_of
from dsr.methods.base import Outliers

_APART = math.log(4.0)  # logarithm of the ratio of two depths from which one is far from the other
LARGEST = 20  # rows and columns of the largest patch that is an outlier, in a map of _USUAL_WIDTH pixels or more
_USUAL_WIDTH = 640
# depth in metres up to which a value is a sensor's end, in a map whose median is at least the second
_NEAREST, _USUAL_DEPTH = 0.05, 0.2
# pixels around each one whose measured values bound the plausible ones: of the map for outliers, of the photo for a
# result
RADIUS = 24
# pixels around a patch in which another surface explains it, and the ratio of their depths up to which it does
_NEARBY, _ALIKE = 64, 1.5
_ROUNDING = 1e-3  # relative excess that is left to a result, so that flat surfaces stay as a method rounds them
_SPARSE = 1 / 16  # share of measured pixels in a window below which it does not limit the depth in a hole
_WINDOW = 5  # low-resolution pixels over which differences are averaged
# relative error of depth in holes: beside measured pixels, and added per degree from them; with ``facets`` on
# Middlebury 2014 and ICL-NUIM, errors are 1.7 % at 0.3, 4.8 % at 0.85, 7.3 % at 2.5 and 11 % at 5 degrees
_NEAR, _PER_DEGREE = 0.02, 0.03
_GUESSED = 45.0  # degrees between the normals, in holes


def find_outliers(depth: Tensor) -> Tensor:
    """Return where the depth of a map, (1, h, w) in metres with NaN in holes, cannot be, (1, h, w) bool.

    That is where it is nearer than 5 cm in a map of usual distances, and in connected patches of up to 20 x 20 pixels,
    less in maps narrower than 640 pixels, that are at least 4 times as near or as far as all larger surfaces within 24
    pixels. A patch is real, and not found, if it is part of a larger surface, however thin, if there is a larger
    surface of its depth nearby, as behind a gap or where a chair leg is broken into pieces, or if it reaches into the
    picture from the front.
    """
    known = depth.isfinite()
    found = torch.zeros_like(known)
    if not bool(known.any()):
        return found
    if float(depth[known].median()) >= _USUAL_DEPTH:
        found = known & (depth < _NEAREST)
        known = known & ~found
    values = depth[0].masked_fill(~known[0], torch.nan).log().cpu().numpy().astype(np.float32)
    largest = max(1, min(LARGEST, LARGEST * max(depth.shape[-2:]) // _USUAL_WIDTH))
    return found | torch.from_numpy(_isolated(values, largest))[None].to(known.device)


def find_filled(result: Tensor, depth: Tensor) -> Tensor:
    """Return where a result, (1, H, W), has depth whose nearest pixel of the map, (1, h, w), is a hole or outlier."""
    missing = depth.isnan() | find_outliers(depth)
    return resize_nearest(missing, size_of(result)).to(result.device) & result.isfinite()


def count_patches(mask: Tensor) -> Outliers:
    """Return the number of pixels of a mask, (1, h, w) bool, and of their patches, connected also at corners."""
    pixels = int(mask.sum())
    return Outliers(pixels, cv2.connectedComponents(mask[0].cpu().numpy().astype(np.uint8))[0] - 1 if pixels else 0)


def within_measured(result: Tensor, given: Tensor, radius: int = RADIUS) -> Tensor:
    """Return inverse depth, (1, H, W), clamped to the range that planes through measured values around a pixel allow.

    A plane's inverse depth is linear in the pixel, so that it leaves the measured values, (1, h, w) with NaN in holes,
    in a window of this radius in pixels of the result, of which at least half lies inside the map, by no more than half
    of their range. Holes are wider to cross: where one is further than a third of the radius from measured pixels, the
    window is three times as large. No depth becomes more than twice as far as all around it. Where the window has no
    measured pixel, or too few, nothing changes.
    """
    given = given.to(result)
    size = (result.shape[-2], result.shape[-1])
    reach = max(2, math.ceil(radius * max(n / m for n, m in zip(given.shape[-2:], size, strict=True))))
    known = given.isfinite()
    low, high = _bounds(given, known, reach)
    if not bool(known.all()):
        away = distance_to_known(known)
        window = (2 * reach + 1, 2 * reach + 1)
        measured = known[0].cpu().numpy().astype(np.float32)
        share = torch.from_numpy(cv2.boxFilter(measured, -1, window, borderType=cv2.BORDER_REFLECT))[None]
        silent = ~known & ((share.to(known.device) < _SPARSE) | (away > reach))
        further = (away > reach / 3) & ~silent
        if bool(further.any()):
            wide_low, wide_high = _bounds(given, known, 3 * reach)
            low, high = torch.where(further, wide_low, low), torch.where(further, wide_high, high)
        low, high = low.masked_fill(silent, -torch.inf), high.masked_fill(silent, torch.inf)
    low, high = (functional.interpolate(each[None], size, mode="nearest-exact")[0] for each in (low, high))
    return result.clamp(low, high)


def _bounds(given: Tensor, known: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return the smallest and largest value that the windows allow, (1, h, w), infinite where none is known."""
    high = window_maxima(given.masked_fill(~known, -torch.inf), reach)
    low = -window_maxima((-given).masked_fill(~known, -torch.inf), reach)
    margin = (high - low) / 2
    lowest, highest = torch.maximum(low - margin, low / 2), high + margin
    none = ~high.isfinite()
    return (
        ((1 - _ROUNDING) * lowest).masked_fill(none, -torch.inf),
        ((1 + _ROUNDING) * highest).masked_fill(none, torch.inf),
    )


def _isolated(values: np.ndarray, largest: int) -> np.ndarray:
    """Return where patches are far from all around them in the logarithm of depth, (h, w), NaN in holes."""
    found = np.zeros(values.shape, bool)
    small = _small_regions(values, largest)
    if not small.any():
        return found
    surfaces = np.where(small, np.nan, values)
    known = torch.from_numpy(surfaces)[None]
    nearest = -window_maxima((-known).nan_to_num(nan=-torch.inf), RADIUS)[0].numpy()  # infinite without any
    farthest = window_maxima(known.nan_to_num(nan=-torch.inf), RADIUS)[0].numpy()
    far = small & (((values <= nearest - _APART) & np.isfinite(nearest)) | (values >= farthest + _APART))
    far &= np.isfinite(farthest)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(far.astype(np.uint8), connectivity=8)
    for label in range(1, count):
        left, top, width, height = (int(each) for each in boxes[label, :4])
        window, nearby = (
            np.s_[max(top - margin, 0) : top + height + margin, max(left - margin, 0) : left + width + margin]
            for margin in (1, _NEARBY)
        )
        patch = labels[window] == label
        if max(width, height) > largest or _touches(values[window], patch):
            continue
        others = surfaces[nearby] - np.median(values[window][patch])
        inside = left and top and left + width < values.shape[1] and top + height < values.shape[0]
        reaches_in = not inside and np.nanmin(others) > 0  # at the border, in front of what is around it
        if not (np.abs(others) < math.log(_ALIKE)).any() and not reaches_in:
            found[window] |= patch
    return found


def _small_regions(values: np.ndarray, largest: int) -> np.ndarray:
    """Return the pixels of the regions, connected along rows and columns, that fit into a square."""
    known = ~np.isnan(values)
    height, width = known.shape
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)  # pixels, and between them what connects them
    grid[::2, ::2] = known
    grid[1::2, ::2], grid[::2, 1::2] = (np.abs(np.diff(values, axis=axis)) < _APART for axis in (0, 1))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(grid, connectivity=4)
    small = boxes[:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_HEIGHT + 1].max(axis=1) < 2 * largest
    small[0] = False
    return small[labels[::2, ::2]]


def _touches(values: np.ndarray, patch: np.ndarray) -> bool:
    """Return whether a pixel of a patch is near the depth of one outside, beside it or across a corner."""
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(None, -down or None), slice(max(-right, 0), -right if right > 0 else None))
        b = (slice(down, None), slice(max(right, 0), right if right < 0 else None))
        border = patch[a] != patch[b]
        if (np.abs(values[a] - values[b])[border] < _APART).any():
            return True
    return False


def expect_errors(inverse: Tensor, given: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the expected relative error of the depth and the expected error of the normal in degrees, (1, H, W) each.

    The result is inverse depth, (1, H, W) in pixels of the camera; ``given`` is that of the input, (1, h, w), NaN in
    holes.
    """
    size, size_lr = (inverse.shape[-2], inverse.shape[-1]), (given.shape[-2], given.shape[-1])
    camera_lr = camera.rescale(size_lr[1], size_lr[0])
    known = given.isfinite()
    weight = known[None].to(inverse)
    smooth = _mean(given.nan_to_num(0)[None].to(inverse), weight, 3)
    result = functional.adaptive_avg_pool2d(inverse[None], size_lr)
    both = known[None] & (smooth > 0) & (result > 0)
    off = torch.where(both, (result / smooth).log().abs(), 0)
    rays = camera_lr.rays()[None].to(inverse.device)
    normals, smooth_normals = (
        depth_to_normals(torch.where(both, each, torch.nan).reciprocal().double(), rays) for each in (result, smooth)
    )
    angle = angle_between(normals, smooth_normals).to(inverse)
    tilted = angle.isfinite().to(inverse)
    angle = _mean(angle.nan_to_num(0), tilted, _WINDOW)
    away = distance_to_known(known).to(inverse) * degrees_per_pixel(camera_lr.fx)
    hole = ~known[None]
    spread = _mean(off, weight, _WINDOW) + torch.where(hole, _NEAR + _PER_DEGREE * away, 0).clamp(max=1)
    angle = torch.where(hole, angle.clamp(min=_GUESSED), angle)
    spread, angle = (functional.interpolate(each, size, mode="bilinear")[0] for each in (spread, angle))
    return spread, angle


def _mean(values: Tensor, weight: Tensor, window: int) -> Tensor:
    """Return the means of the valid values around each pixel; 0 where there is none."""
    total = functional.avg_pool2d(values * weight, window, stride=1, padding=window // 2)
    count = functional.avg_pool2d(weight, window, stride=1, padding=window // 2)
    return torch.where(count > 0, total / torch.where(count > 0, count, 1), 0)
