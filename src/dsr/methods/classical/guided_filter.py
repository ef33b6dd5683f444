"""Guided filter upsampling: in each window, depth is a linear function of the colours.

He, Sun, Tang, *Guided Image Filtering*, TPAMI 2013, with its colour guide. In every window w_k of the high-resolution
image, q_i = a_k . I_i + b_k with

    a_k = (S_k + eps U)^-1 (mean(I p) - m_k mean(p)),    b_k = mean(p) - a_k . m_k,

with the mean m_k and the 3 x 3 covariance S_k of the colours I, the input p (the bilinear interpolation of the
low-resolution map) and the identity U. The result is q_i = mean(a_k) . I_i + mean(b_k) over the windows that contain i.

What differs: means over a window weight pixels by their confidence (see :mod:`dsr.methods.classical.photo_guided`), so
that holes do not spread, and windows by their mean confidence. The radius is in low-resolution pixels. Time grows as
H * W * radius * scale; memory peaks at about 50 maps of H * W float64 values.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from dsr.methods.classical.photo_guided import Guided, GuidedMethod, expect_positive, expect_window

# the entries of a symmetric 3 x 3 matrix, in the order of storage
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ROWS = ([0, 1, 2], [1, 3, 4], [2, 4, 5])  # indices of the matrix's rows among these
_TINY = 1e-30


class GuidedFilter(GuidedMethod):
    """The guided filter of the interpolated low-resolution disparity.

    Args:
        radius: radius of the windows in low-resolution pixels.
        epsilon: regularisation added to the variances of colours in [0, 1]; smaller variances have no effect.
        fill_holes, slopes: see :class:`dsr.methods.classical.photo_guided.GuidedMethod`.

    """

    def __init__(
        self, radius: float = 0.5, epsilon: float = 1e-3, *, fill_holes: bool = False, slopes: bool = True
    ) -> None:
        super().__init__(fill_holes=fill_holes, slopes=slopes)
        expect_window("the guided filter", radius=radius)
        expect_positive("the guided filter", epsilon=epsilon)
        self._radius, self._epsilon = radius, epsilon

    def filter_maps(self, guided: Guided) -> Tensor:
        """Return the filtered interpolations, (N, H, W)."""
        maps, confidence = guided.interpolate()
        radius = max(round(self._radius * guided.scale), 1)
        return guided_filter(guided.rgb, maps, radius, self._epsilon, confidence)


def guided_filter(guide: Tensor, maps: Tensor, radius: int, epsilon: float, confidence: Tensor | None = None) -> Tensor:
    """Filter maps, (N, H, W) finite, with a colour guide, (3, H, W).

    Windows have (2 * radius + 1)^2 pixels, truncated at the border, and ``confidence`` weights pixels in [0, 1], (H,
    W). A pixel in no window with a positive confidence keeps its value.
    """
    weight = torch.ones_like(guide[0]) if confidence is None else confidence
    mean_weight = _box(weight, radius)
    divisor = torch.where(mean_weight > 0, mean_weight, 1)
    mean = _box(weight * guide, radius) / divisor
    products = torch.stack([guide[i] * guide[j] for i, j in _PAIRS])
    variances = _box(weight * products, radius) / divisor - torch.stack([mean[i] * mean[j] for i, j in _PAIRS])
    del products
    for k in (0, 3, 5):
        variances[k] += epsilon
    inverse = _invert(variances)
    mean_confidence = mean_weight / _box(torch.ones_like(weight), radius)
    total = _box(mean_confidence, radius)

    filtered = []
    for values in maps:
        mean_value = _box(weight * values, radius) / divisor
        cross = _box(weight * guide * values, radius) / divisor - mean * mean_value
        slopes = torch.stack([(inverse[row] * cross).sum(dim=0) for row in _ROWS])
        constant = mean_value - (slopes * mean).sum(dim=0)
        slopes, constant = _box(mean_confidence * slopes, radius), _box(mean_confidence * constant, radius)
        smooth = ((slopes * guide).sum(dim=0) + constant) / total.clamp(min=_TINY)
        filtered.append(torch.where(total > 0, smooth, values))
    return torch.stack(filtered)


def _box(x: Tensor, radius: int) -> Tensor:
    """Return the means over windows of (..., H, W), with 0 beyond the border; exactly 0 where all values are 0."""
    maps, side = x.reshape(-1, 1, *x.shape[-2:]), 2 * radius + 1
    maps = functional.avg_pool2d(functional.pad(maps, (0, 0, radius, radius)), (side, 1), stride=1)
    maps = functional.avg_pool2d(functional.pad(maps, (radius, radius)), (1, side), stride=1)
    return maps.reshape(x.shape)


def _invert(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric 3 x 3 matrices, (6, H, W) both, by cofactors.

    Covariances plus epsilon have determinants of at least epsilon cubed.
    """
    a, b, c, d, e, f = matrix
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    return torch.stack((aa, bb, cc, dd, ee, ff)) / (a * aa + b * bb + c * cc)
