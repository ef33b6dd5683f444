"""Glass, mirrors and gloss: where the depth of a sensor is probably not that of the surface which the photo shows.

A sensor sees through clear objects, and mirrors deceive it; its depth there is smooth, and looks right. What gives it
away is that photo and map contradict each other: the map has holes amid a surface, away from depth steps, where the
photo has texture, rims and highlights, beside which a sensor loses nothing elsewhere. :class:`GlassFinder` judges each
pixel by 26 such features, on a grid of at most 320 x 320 pixels. It was trained by ``scripts/train_glass.py`` on the
objects of :mod:`dsr.degradation.glass`, 6 to 70 % as wide as the grid.
"""

import functools
import math
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.geometry.hole_size import is_scattered, wide_holes, window_maxima

_WEIGHTS = Path(__file__).with_suffix(".safetensors")
GRID = 320  # pixels of the longer side of the grid on which features are computed
FEATURES = 26  # without units: means of holes, texture, roughness, depth steps, brightness and saturation
_MEMBERS = 4  # networks, whose logits are averaged
# pixels of the grid: standard deviations of means of holes, of holes amid a surface, of the photo's texture and of the
# map's roughness; and reaches of depth steps
_HOLES, _AMID, _TEXTURE, _ROUGHNESS, _NEAR = (2, 4, 8, 16), (4, 8, 16), (3, 6, 12), (3, 8), (3, 8, 16)
_AMID_REACH, _AMID_STEP = 16, 0.06  # a hole is amid a surface if the logarithms of the depths so near differ by less
WIDE = 40.0  # width of holes of the grid that are no sign of glass, as what is out of range or was cut away is
_EVIDENCE = 0.02  # least mean of the holes around a pixel: where a sensor loses nothing, texture is taken for glass
_BURNT, _DARK = 0.9, 0.1  # grey levels above and below which a pixel is burnt out and dark
_BEHIND = 0.06  # relative error of depth that was measured through a transparent object
NOTED = 0.02  # relative error because of glass from which a pixel is reported as glass
# Probabilities of glass from which it is expected in part, and in full: those of simulated objects, in the scenes of
# whose training they are more common than elsewhere.
_PERHAPS, _PROBABLY = 0.1, 0.3


class GlassFinder(nn.Module):
    """The probability that measured depth is wrong as in glass, by features of a pixel."""

    middle: Tensor  # (FEATURES,), as ``scale``: what features are normalised by
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.members = nn.ModuleList()
        for _ in range(_MEMBERS):
            first, second, last = nn.Linear(FEATURES, 48), nn.Linear(48, 32), nn.Linear(32, 1)
            self.members.append(nn.Sequential(first, nn.ReLU(inplace=True), second, nn.ReLU(inplace=True), last))
        self.register_buffer("middle", torch.zeros(FEATURES))
        self.register_buffer("scale", torch.ones(FEATURES))

    def normalise(self, features: Tensor) -> Tensor:
        """Return features, (..., FEATURES), in the range of those of the training."""
        return ((features - self.middle) / self.scale).clamp(-4, 4)

    def forward(self, features: Tensor) -> Tensor:
        """Return the logits of each member, (..., members), of normalised features, (..., FEATURES)."""
        return torch.cat([member(features) for member in self.members], dim=-1)


@functools.cache
def glass_finder(device: torch.device) -> GlassFinder:
    """Return the trained one, on a device."""
    with torch.inference_mode(mode=False), torch.device("meta"):  # draws no random numbers
        finder = GlassFinder().eval().requires_grad_(False)
    state = safetensors.torch.load(_WEIGHTS.read_bytes())
    finder.load_state_dict({name: value.to(device) for name, value in state.items()}, assign=True)
    return finder.requires_grad_(False)


@torch.no_grad()
def probability_of_glass(rgb: Tensor, inverse: Tensor) -> Tensor:
    """Return how probable it is that depth is not that of the surface which the photo shows, (1, H, W) float32.

    ``rgb`` (3, H, W) is in [0, 1], ``inverse`` (1, h, w) in 1/m as measured. It is 0 where no hole is near.
    """
    height, width = rgb.shape[-2:]
    inverse = inverse.to(rgb.device, torch.float32)
    if is_scattered(inverse.isfinite()):
        return torch.zeros(1, height, width, device=rgb.device)
    _, weight, holes = _on_grid(inverse, (height, width), GRID, WIDE)
    near = (_blur(holes, _HOLES[-1])[0] > _EVIDENCE) & weight.gt(0.5).any()  # nowhere if nothing is known
    found = torch.zeros(near.shape, device=rgb.device)
    if bool(near.any()):
        finder = glass_finder(rgb.device)
        features = glass_features(rgb, inverse)[:, near].T
        found[near] = finder(finder.normalise(features)).mean(dim=-1).sigmoid()
    return functional.interpolate(found[None, None], (height, width), mode="bilinear", align_corners=False)[0]


def expect_glass(rgb: Tensor, inverse: Tensor) -> Tensor:
    """Return the relative error of depth to expect because of glass, (1, H, W), 0 to 0.06."""
    share = (probability_of_glass(rgb, inverse) - _PERHAPS) / (_PROBABLY - _PERHAPS)
    return _BEHIND * share.clamp(0, 1)


def glass_features(rgb: Tensor, inverse: Tensor, grid: int = GRID, wide: float | None = WIDE) -> Tensor:
    """Return the features of the pixels of a grid, (FEATURES, g, g') float32, whose sides are 16 or more.

    ``grid`` are the pixels of its longer side; holes wider than ``wide`` of them do not count, except in the training.
    """
    logs, weight, holes = _on_grid(inverse.float(), (rgb.shape[-2], rgb.shape[-1]), grid, wide)
    size, known = weight.shape[-2:], weight > 0.5
    photo = functional.interpolate(rgb[None].float(), size, mode="bilinear", antialias=True, align_corners=False)[0]
    steps = {}  # by how much the known values of windows differ, (1, g, g'); much less than 0 where there is none
    for reach in {*_NEAR, _AMID_REACH}:
        highest, lowest = (window_maxima((sign * logs).masked_fill(~known, -1e3), reach) for sign in (1, -1))
        steps[reach] = highest + lowest
    around = steps[_AMID_REACH]
    amid = holes * ((around >= 0) & (around < _AMID_STEP))
    close = holes * ((steps[8] >= 0) & (steps[8] < 2 / 3 * _AMID_STEP))
    grey = photo.mean(dim=0, keepdim=True)
    texture = [_blur((grey - _blur(grey, 1.5)).square(), each).clamp(min=0).sqrt() + 1e-3 for each in _TEXTURE]
    covered = known.to(logs)
    smooth = _blur(logs * covered, 2) / _blur(covered, 2).clamp(min=1e-3)
    rough = ((logs - smooth) * covered).clamp(-0.05, 0.05).square()
    roughness = [
        (_blur(rough, each) / _blur(covered, each).clamp(min=0.05)).clamp(min=0).sqrt() + 1e-4 for each in _ROUGHNESS
    ]
    usual = roughness[1][known].median()
    colourful = photo.amax(dim=0, keepdim=True) - photo.amin(dim=0, keepdim=True)
    found = [
        *(_blur(holes, each) for each in _HOLES),
        *(_blur(amid, each) for each in _AMID),
        _blur(close, 4),
        *((each / texture[1].median()).log() / 2 for each in texture),
        texture[1].log() / 2 + 2,
        *((each / usual).log() / 2 for each in roughness),
        roughness[1].log() / 3 + 2,
        *(steps[reach].clamp(0, 1).sqrt() for reach in _NEAR),
        grey,
        grey - _blur(grey, 6),
        grey - _blur(grey, 16),
        colourful,
        colourful - _blur(colourful, 16),
        _blur((grey > _BURNT).to(grey), 4),
        _blur((grey < _DARK).to(grey), 4),
        3 * (photo - _blur(photo, 12)).abs().mean(dim=0, keepdim=True),
    ]
    return torch.cat(found)


def _on_grid(inverse: Tensor, photo: tuple[int, int], longer: int, wide: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Return logarithms of inverse depth on the grid, which part of each pixel is known, and which is a hole.

    All are (1, g, g'). The longer side of the photo's grid is given; thin holes, and those wider than ``wide``, do not
    count if that is given.
    """
    size = tuple(max(16, round(length * longer / max(photo))) for length in photo)
    mode = "area" if inverse.shape[-1] > size[1] else "nearest-exact"
    known = inverse.isfinite()
    values = torch.where(known, inverse, 1).clamp(min=1e-6).log()
    missing = (~known).float()
    if wide is not None and min(known.shape[-2:]) > 2:
        missing = window_maxima(-window_maxima(-missing, 1), 1)
    logs, weight, holes = (
        functional.interpolate(each[None], size, mode=mode)[0] for each in (values, known.to(values), missing)
    )
    if wide is not None:
        holes = holes.masked_fill(wide_holes(holes < 0.5, wide), 0)
    return torch.where(weight > 0, logs / weight.clamp(min=1e-3), 0), weight, holes


def _blur(values: Tensor, deviation: float) -> Tensor:
    """Return values, (c, g, g'), smoothed by a Gaussian; wide ones on a coarser grid."""
    size, factor = values.shape[-2:], max(1, int(deviation / 1.5))
    found = functional.avg_pool2d(values, factor, ceil_mode=True, count_include_pad=False) if factor > 1 else values
    reach = max(1, math.ceil(2.5 * deviation / factor))
    offsets = torch.arange(-reach, reach + 1, device=values.device) * (factor / deviation)
    taps = (-offsets.square() / 2).exp()
    taps = (taps / taps.sum()).to(values)
    for kernel, padding in ((taps[:, None], (0, 0, reach, reach)), (taps[None], (reach, reach, 0, 0))):
        padded = functional.pad(found[:, None], padding, mode="replicate")
        found = functional.conv2d(padded, kernel[None, None])[:, 0]
    if factor == 1:
        return found
    found = functional.interpolate(found[None], scale_factor=factor, mode="bilinear", align_corners=False)[0]
    return found[..., : size[0], : size[1]]
