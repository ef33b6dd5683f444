"""A floor under the flicker of a camera that stands still: an exponential mean of inverse depth over its results.

By RealSense's recursion, m = alpha x + (1 - alpha) m, white noise of deviation s becomes s sqrt(alpha / (2 - alpha)). A
pixel begins anew where it differs from the mean by more than a few expected errors, and beside a change of colour.
Expected errors grow to the differences that occur, so that pixels with more noise than expected are averaged, too. They
grow faster than they shrink, because a camera's first frames would flicker until they have grown.
"""

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.hole_size import window_maxima
from dsr.methods.base import Surface
from dsr.methods.classical.realsense import follow

_CHANGE = 5.0  # expected errors
_COLOUR = 0.05  # change of a mean over 3 x 3 pixels: five deviations if those of the photo's noise are 5 of 255
_REACH = 2  # pixels around a change of colours within which depth changes with it
_GROWTH, _DECAY = 0.4, 0.2  # weight of a frame's difference in the mean difference, where it is larger and smaller
KEPT = 8  # results that a mean depends on where the last of them have holes


class Steady:
    """Averages successive surfaces of a camera that stands still; it keeps the last result and photo.

    Args:
        alpha: weight of a frame against the mean of those before it, above 0 to 1.

    Example:
        >>> import torch
        >>> from dsr.inference import Steady
        >>> from dsr.methods.base import Surface
        >>> steady, photo, one = Steady(alpha=0.25), torch.zeros(3, 4, 4), torch.ones(1, 4, 4)
        >>> maps = [steady(Surface(z * one, 0.01 * one), photo).depth for z in (1.0, 1.02, 2.0)]
        >>> [f"{float(depth.mean()):.3f}" for depth in maps]
        ['1.000', '1.005', '2.000']

    """

    def __init__(self, alpha: float = 0.1) -> None:
        if not 0 < alpha <= 1:
            raise ValueError(f"alpha: expected a number above 0 and at most 1, got {alpha}")
        self._alpha = alpha
        self._depth = self._error = self._missing = self._rgb = torch.empty(0)

    def __call__(self, surface: Surface, rgb: Tensor) -> Surface:
        """Return the next surface, with expected errors, averaged with those before it; its holes stay holes."""
        surface = self.average(surface, rgb)
        self.remember(surface, rgb)
        return surface

    def average(self, surface: Surface, rgb: Tensor) -> Surface:
        """Return a surface averaged with those that are remembered; ``rgb`` is its photo, (3, H, W) in [0, 1]."""
        depth, error = surface.depth, surface.depth_error
        if error is None:
            raise ValueError("surface: expected one with expected errors of the depth, got none")
        if depth.shape != self._depth.shape:
            return surface
        inverse, mean = depth.reciprocal(), self._depth.reciprocal()
        colours = _sum3x3(functional.pad(rgb - self._rgb, (1, 1, 1, 1)))
        seen = window_maxima(colours.abs().amax(0, keepdim=True), _REACH).to(depth.device) > 9 * _COLOUR
        off = (inverse - mean).abs() * depth.square()  # in metres; NaN in holes and where there is no mean
        limit = _CHANGE * torch.fmax(error, self._error)
        rate = torch.where(off > self._error, _GROWTH, _DECAY).to(off)
        spread = torch.fmax(error, self._error.lerp(torch.minimum(off, limit), rate))
        return surface._replace(
            depth=follow(inverse, mean, (off < limit) & ~seen, self._alpha).reciprocal(),
            depth_error=torch.where(seen | off.isnan(), error, spread),
        )

    def remember(self, surface: Surface, rgb: Tensor) -> None:
        """Take a surface for the mean; where it has holes, the mean of the last ones is kept for a while."""
        assert surface.depth_error is not None  # noqa: S101 - see average
        known = surface.depth.isfinite()
        if surface.depth.shape != self._depth.shape:
            self._depth, self._error, self._missing = surface.depth, surface.depth_error, torch.zeros_like(known).byte()
        self._missing = (self._missing + 1).clamp(max=KEPT).masked_fill(known, 0)
        new = known | (self._missing == KEPT)
        self._depth = torch.where(new, surface.depth, self._depth)
        self._error = torch.where(new, surface.depth_error, self._error)
        self._rgb = rgb


def _sum3x3(x: Tensor) -> Tensor:
    """Return the sums of 3 x 3 pixels, (C, H, W) to (C, H - 2, W - 2), several times as fast as by pooling."""
    for dim in (-1, -2):
        size = x.shape[dim] - 2
        x = x.narrow(dim, 0, size) + x.narrow(dim, 1, size) + x.narrow(dim, 2, size)
    return x
