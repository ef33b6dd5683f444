"""What a sensor measured and a result has lost: the residual that is more than the map's noise, added back.

A network that smooths noise smooths fine shape with it, and may shift whole areas. The noise that it took away averages
out: the mean residual around a pixel is as small as the noise, its correlation and the size of the window make it. The
residual of lost shape does not. So residuals are averaged, first over wide windows and then over small ones, and added
back as far as their power around a pixel exceeds that of averaged noise, as Wiener filters and spectral subtraction do.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from dsr.inference.resizing import size_of
from dsr.methods.base import MapNoise

# pixels of the map from a window's centre to its border, in averages of the residual, which are taken twice; and of
# their power
_REACHES, _AROUND = (12, 3), 24
_OUTLIER = 8.0  # standard deviations of the noise from which on a residual is of a depth step or an outlier
_MOST = 0.5  # of the inverse depth that may be taken away
_FARTHER = 8.0  # times the distance at which the noise was estimated, up to which it grows


def restore_measured(inverse: Tensor, measured: Tensor, noise: MapNoise) -> Tensor:
    """Return a result's inverse depth, (1, H, W), with what it has lost of the measured one, (1, h, w), NaN in holes.

    The noise is that of the residual where surfaces are calm, as facets states it: relative to the depth, and farther
    away than the distance at which it was estimated proportional to the depth.
    """
    own = functional.adaptive_avg_pool2d(inverse, size_of(measured))
    farther = (1 / (own * noise.distance)).clamp(1, _FARTHER).nan_to_num(1)
    deviation = noise.deviation / noise.distance * farther
    rest = measured / own - 1
    used = (rest.abs() < _OUTLIER * deviation).to(own)
    rest, lost = rest.nan_to_num(0), torch.zeros_like(own)
    blur = max(noise.extent, 1) ** 2 / (16 * math.log(2))  # variance in pixels of a Gaussian that makes such noise
    for reach in _REACHES:
        mean = _average(rest - lost, used, reach)
        wide = ((2 * reach + 1) ** 2 - 1) / 6  # variance of the two averages
        noisy = deviation.square() * blur / (blur + wide)
        power = _average(mean.square(), used, _AROUND).clamp(min=1e-20)
        lost = lost + mean * (1 - noisy / power).clamp(min=0).sqrt()
    lost = functional.interpolate(lost[None], size_of(inverse), mode="bilinear")[0]
    return inverse * (1 + lost.clamp(min=-_MOST))


def _average(values: Tensor, weights: Tensor, reach: int) -> Tensor:
    """Return weighted means around pixels, (1, h, w), that fade to 0 where less than half of the weights are."""
    both = torch.cat((values * weights, weights))
    for window in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        for _ in range(2):
            both = functional.avg_pool2d(both, window, stride=1, padding=(window[0] // 2, window[1] // 2))
    return both[:1] / both[1:].clamp(min=0.5)
