"""The paper's metrics: pure functions of a pair of depth maps, one value per image (and light).

Voynov et al., *Perceptual Deep Depth Super-Resolution*, ICCV 2019, section 3, with the conventions that reproduce its
tables. Lower is better throughout; units are metres and fractions. A :class:`SurfacePair` computes what several
metrics use (masks, perspective depths, normals, renderings) once, on first access.

A pixel is valid if both depths are; a normal, if all pixels that it is computed from are. Invalid pixels are left out
of every mean, and are 0 in both renderings inside windows that contain them. An image without a valid pixel gets NaN.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import angle_between, depth_to_normals, length, lights, normal_mask, shade
from dsr.sample import CENTIMETRES, Unit
from dsr.utils.compute_device import in_own_precision, known_true, widened

_Derived = TypeVar("_Derived")
SSIM_WINDOW = 7
SSIM_DATA_RANGE = 2.0
BUMPINESS_CLIP = 0.05
BUMPINESS_DISPARITY = 20.48  # k in px m: 14 mm baseline x 100 mm focal length x 512 px / 35 mm (scene "origami")


def once_per_pair(function: Callable[[SurfacePair], _Derived]) -> Callable[[SurfacePair], _Derived]:
    """Let a function of a pair be computed once per pair, for quantities that several metrics share."""

    @functools.wraps(function)
    def kept(pair: SurfacePair) -> _Derived:
        if function not in pair.derived:
            pair.derived[function] = function(pair)
        found: _Derived = pair.derived[function]
        return found

    return kept


class SurfacePair:
    """Two depth maps of the same pixels, and the quantities that metrics derive from them.

    Args:
        prediction, target: (B, 1, H, W) orthogonal depth in metres; NaN is a hole, and so is a depth that is not
            positive, which no camera sees. float16 and bfloat16 become float32.
        rays: (B or 1, 3, H, W) rays with z = 1, see :meth:`dsr.geometry.camera.Camera.rays`.
        mask: (B, 1, H, W) bool, the pixels to compare; None for all.
        unit: unit of the metrics that are in the benchmark's own.
        regions: parts of the images by name, (B, 1, H, W) uint8, 0 outside, see :class:`dsr.sample.Scene`.
        depth_error, angle_error: (B, 1, H, W) expected absolute errors of the predicted depth in metres and of its
            normals in degrees, NaN where there is none; None from a method that states none.
        measured: (B, 1, H, W) orthogonal depth in metres that a sensor measured, NaN in holes; None if it is not known.
        image_dtype: of normals and renderings, None for the depth's. float32 halves their computing time and changes
            scores by about 1e-7; depths and their differences keep their own dtype.

    """

    def __init__(
        self,
        prediction: Tensor,
        target: Tensor,
        rays: Tensor,
        mask: Tensor | None = None,
        *,
        unit: Unit = CENTIMETRES,
        regions: Mapping[str, Tensor] | None = None,
        depth_error: Tensor | None = None,
        angle_error: Tensor | None = None,
        measured: Tensor | None = None,
        image_dtype: torch.dtype | None = None,
    ) -> None:
        prediction, target = widened(prediction), widened(target)
        shape, sizes = target.shape, f"{tuple(prediction.shape)} and {tuple(target.shape)}"
        if prediction.dim() != 4 or prediction.shape[1] != 1 or prediction.shape != shape:
            raise ValueError(f"prediction, target: expected two depth maps of shape (B, 1, H, W), got {sizes}")
        if not (prediction.is_floating_point() and target.is_floating_point()):
            raise ValueError(f"prediction, target: expected metres as floats, got {prediction.dtype}, {target.dtype}")
        if rays.shape not in ((1, 3, *shape[-2:]), (len(target), 3, *shape[-2:])):
            raise ValueError(f"rays: expected shape (B or 1, 3, {shape[-2]}, {shape[-1]}), got {tuple(rays.shape)}")
        if mask is not None and (mask.dtype != torch.bool or mask.shape != shape):
            raise ValueError(f"mask: expected bool of shape {tuple(shape)}, got {mask.dtype} {tuple(mask.shape)}")
        self.given, self.rays, self.mask = (prediction, target), rays.to(target.dtype), mask
        self.unit, self.regions, self.image_dtype = unit, dict(regions or {}), image_dtype or target.dtype
        self.depth_error, self.angle_error, self.measured = map(widened, (depth_error, angle_error, measured))
        known = target.isfinite() & (target > 0)
        self.target_mask = known if mask is None else known & mask
        self.depth_mask = self.target_mask & prediction.isfinite() & (prediction > 0)
        self.complete = known_true(self.depth_mask)
        self.prediction = torch.where(self.depth_mask, prediction, 1.0)  # finite, which keeps NaN out of gradients
        self.target = torch.where(self.depth_mask, target, 1.0)
        self.derived: dict[Any, Any] = {}  # what once_per_pair and within keep

    @classmethod
    def of(
        cls,
        preds: SurfacePair | Tensor | np.ndarray,
        target: Tensor | np.ndarray | None = None,
        camera: Camera | Sequence[Camera] | Tensor | np.ndarray | None = None,
        mask: Tensor | np.ndarray | None = None,
    ) -> SurfacePair:
        """Return a given pair, or make one of a prediction, a target and their camera, as metric classes accept either.

        Depth and mask are (B, 1, H, W), tensors or arrays; the camera is that of all images, a list, or their rays.
        """
        if isinstance(preds, SurfacePair):
            if not (target is camera is mask is None):
                raise ValueError("preds: expected a SurfacePair alone, got a target, a camera or a mask beside it")
            return preds
        if target is None or camera is None:
            lack = "target" if target is None else "camera"
            raise ValueError(f"{lack}: expected preds, target and camera, or a SurfacePair alone; got none")
        first, second = torch.as_tensor(preds), torch.as_tensor(target)
        if isinstance(camera, Camera):
            rays = camera.rays(device=second.device)
        elif isinstance(camera, Sequence):
            if not all(isinstance(each, Camera) for each in camera):
                raise ValueError(f"camera: expected dsr.Camera, a list of them, or rays; got {camera!r:.60}")
            if len(camera) != len(first) or len({(each.height, each.width) for each in camera}) != 1:
                raise ValueError(f"camera: expected one for each of {len(first)} maps, of one size, got {len(camera)}")
            rays = torch.stack([each.rays(device=second.device) for each in camera])
        else:
            rays = torch.as_tensor(camera)
        rays = rays[None] if rays.ndim == 3 else rays
        return cls(first, second, rays, None if mask is None else torch.as_tensor(mask))

    def replaced(self, **changes: Any) -> SurfacePair:
        """Return a pair with other arguments; those that are not named stay."""
        prediction, target = self.given
        names = ("rays", "mask", "unit", "regions", "depth_error", "angle_error", "measured", "image_dtype")
        kept = {name: getattr(self, name) for name in names}
        return SurfacePair(**{"prediction": prediction, "target": target, **kept, **changes})

    def within(self, region: str) -> SurfacePair:
        """Return the pair in a region alone."""
        if region not in self.derived:
            inside = self.regions[region] > 0
            self.derived[region] = self.replaced(mask=inside if self.mask is None else inside & self.mask)
        found: SurfacePair = self.derived[region]
        return found

    @cached_property
    def normals(self) -> tuple[Tensor, Tensor]:
        """The two normal maps, (B, 3, H, W); meaningful where ``normal_mask`` is set."""
        first = depth_to_normals(self.prediction, self.rays, self.image_dtype)
        return first, depth_to_normals(self.target, self.rays, self.image_dtype)

    @cached_property
    def normal_mask(self) -> Tensor:
        """(B, 1, H, W) bool: where both normals are valid."""
        return self.depth_mask if self.complete else normal_mask(self.depth_mask)

    @cached_property
    def shadings(self) -> tuple[Tensor, Tensor]:
        """The two maps of e . n for the four lights, (B, 4, H, W), unclipped; 0 where invalid."""
        directions = lights(dtype=self.image_dtype, device=self.target.device)
        first, second = (in_own_precision(shade)(normals, directions) for normals in self.normals)
        return first * self.normal_mask, second * self.normal_mask

    @cached_property
    def renderings(self) -> tuple[Tensor, Tensor]:
        """The two maps of clip(e . n, 0, 1) for the four lights, (B, 4, H, W); 0 where invalid."""
        first, second = self.shadings
        return first.clamp(0, 1), second.clamp(0, 1)

    @cached_property
    def ray_lengths(self) -> Tensor:
        """(B or 1, 1, H, W): the perspective depth of a point with orthogonal depth 1."""
        return length(self.rays)

    @cached_property
    def perspective_error(self) -> Tensor:
        """(B, 1, H, W) absolute difference of the perspective depths in metres; 0 where invalid."""
        return (self.prediction - self.target).abs() * self.ray_lengths

    @cached_property
    def ssim_mask(self) -> Tensor:
        """(B, 1, H - 6, W - 6) bool: window centres whose normal is valid."""
        border = SSIM_WINDOW // 2
        return self.normal_mask[..., border:-border, border:-border]

    @cached_property
    def bumpiness_mask(self) -> Tensor:
        """(B, 1, H, W) bool: where the 5 x 5 pixels of a second derivative are valid or outside the map."""
        if self.complete:
            return self.depth_mask
        missing = (~self.depth_mask).to(self.target.dtype)
        return torch.nn.functional.max_pool2d(missing, 5, stride=1, padding=2) == 0


def rmse_d(pair: SurfacePair) -> Tensor:
    """Return the RMS difference of the perspective depths in metres, (B,)."""
    return masked_mean(pair.perspective_error.square(), pair.depth_mask).sqrt().squeeze(1)


def bad_pix_d(pair: SurfacePair, threshold: float, *, relative: bool = False) -> Tensor:
    """Return the fraction of pixels whose perspective depths differ by more than metres, or a share of the truth."""
    limit = pair.target * pair.ray_lengths * threshold if relative else threshold
    return masked_mean(pair.perspective_error > limit, pair.depth_mask).squeeze(1)


def mse_v(pair: SurfacePair) -> Tensor:
    """Return MSE_v, (B,), eq. 3: under orthonormal lights the mean squared difference of the normals' components."""
    first, second = pair.normals
    return masked_mean((first - second).square().mean(dim=1, keepdim=True), pair.normal_mask).squeeze(1)


def rmse_v(pair: SurfacePair) -> Tensor:
    """Return RMSE_v = sqrt(MSE_v), (B,)."""
    return mse_v(pair).sqrt()


def rmse_v1(pair: SurfacePair) -> Tensor:
    """Return RMSE_v^1 per light, (B, 4): the RMS difference of the unclipped renderings e . n."""
    first, second = pair.shadings
    return masked_mean((first - second).square(), pair.normal_mask).sqrt()


def bad_pix_v(pair: SurfacePair, threshold: float) -> Tensor:
    """Return the fraction of pixels whose renderings differ by more than ``threshold`` / 255, per light, (B, 4)."""
    first, second = pair.renderings
    return masked_mean((first - second).abs() > threshold / 255, pair.normal_mask)


def dssim_v(pair: SurfacePair, mask: Tensor | None = None) -> Tensor:
    """Return DSSIM_v = 1 - SSIM per light, (B, 4), over windows at the centres in a mask, by default all valid ones.

    SSIM (Wang et al. 2004) with a 7 x 7 uniform window, sample covariance and a data range of 2, inside the map.
    """
    first, second = pair.renderings
    if min(first.shape[-2:]) < SSIM_WINDOW:
        raise ValueError(f"DSSIM_v: expected a map of at least 7 x 7 pixels, got {tuple(first.shape[-2:])}")
    mask = pair.ssim_mask if mask is None else mask
    lights_apart = zip(first.unbind(1), second.unbind(1), strict=True)  # one light's maps stay in the cache
    return torch.cat([1 - masked_mean(ssim_map(x, y)[:, None], mask) for x, y in lights_apart], dim=1)


def bumpiness_d(pair: SurfacePair) -> Tensor:
    """Return Bumpiness_d, (B,): 100 x the mean of min(0.05, |Hessian of k / z1 - k / z0|).

    Metric of the 4D light field benchmark (Honauer et al. 2016), with k in px m as if its camera had seen the scene.
    Derivatives are Scharr filters, 0 on the map's outermost pixel after each.
    """
    difference = (BUMPINESS_DISPARITY * (1 / pair.prediction - 1 / pair.target)).to(pair.image_dtype)
    squares = torch.zeros_like(difference)
    for first in _scharr(difference):
        for second in _scharr(first):
            squares = squares + second.square()
    return 100 * masked_mean(squares.sqrt().clamp(max=BUMPINESS_CLIP), pair.bumpiness_mask).squeeze(1)


@once_per_pair
def angle(pair: SurfacePair) -> Tensor:
    """Return the angle between the two normals in degrees, (B, 1, H, W); meaningful where ``normal_mask`` is set."""
    return angle_between(*pair.normals)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over the last two axes of ``values`` (B, C, H, W) where ``mask`` (B, 1, H, W) is set, (B, C)."""
    values = values if values.is_floating_point() else values.double()
    if known_true(mask):
        return values.mean(dim=(-2, -1))
    return torch.where(mask, values, 0).sum(dim=(-2, -1)) / mask.sum(dim=(-2, -1))


def masked_median(values: Tensor, mask: Tensor) -> Tensor:
    """Return the median of (B, 1, H, W) where the mask is set, (B, 1, 1, 1); of an even number of the middle two."""
    ordered = values.masked_fill(~mask, torch.inf).flatten(1).sort(dim=1).values
    count = mask.flatten(1).sum(dim=1, keepdim=True)
    middle = torch.cat(((count - 1).clamp(min=0) // 2, count // 2), dim=1)
    median = ordered.gather(1, middle.clamp(max=ordered.shape[1] - 1)).mean(dim=1)
    return torch.where(count[:, 0] > 0, median, torch.nan)[:, None, None, None]


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """Return SSIM at every window inside the map, (B, H, W) -> (B, H - 6, W - 6)."""
    # With sums over N pixels in place of means, the numerators and denominators are multiplied by the same factor.
    area = SSIM_WINDOW**2
    c1 = (0.01 * SSIM_DATA_RANGE) ** 2 * area**2
    c2 = (0.03 * SSIM_DATA_RANGE) ** 2 * area * (area - 1)  # N - 1: sample covariance
    sum_x, sum_y = _window_sum(x), _window_sum(y)
    product, squares = sum_x * sum_y, torch.addcmul(sum_x.square(), sum_y, sum_y)
    covariance = c2 / 2 - torch.sub(product, _window_sum(x * y), alpha=area)
    variances = c2 - torch.sub(squares, _window_sum(torch.addcmul(x.square(), y, y)), alpha=area)
    return 4 * (product + c1 / 2) * covariance / ((squares + c1) * variances)


def _window_sum(values: Tensor) -> Tensor:
    """Return the sums over all 7 x 7 windows inside the map, (..., H, W) -> (..., H - 6, W - 6)."""
    for axis in (-2, -1):  # seven terms in four additions: pairs, fours, four + two + one
        size = values.shape[axis] - SSIM_WINDOW + 1
        pairs = values.narrow(axis, 0, size + 5) + values.narrow(axis, 1, size + 5)
        fours = pairs.narrow(axis, 0, size) + pairs.narrow(axis, 2, size)
        values = fours + pairs.narrow(axis, 4, size) + values.narrow(axis, 6, size)
    return values


def _scharr(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Scharr responses along v and along u, (B, 1, H, W) each: 2 to a ramp of slope 1, 0 at the border."""
    found = []
    for along, across in ((-2, -1), (-1, -2)):
        size = values.shape[along] - 2
        steps = values.narrow(along, 2, size) - values.narrow(along, 0, size)
        size = values.shape[across] - 2
        outer = steps.narrow(across, 0, size) + steps.narrow(across, 2, size)
        smooth = outer * (3 / 16) + steps.narrow(across, 1, size) * (10 / 16)
        found.append(torch.nn.functional.pad(smooth, (1, 1, 1, 1)))
    return found[0], found[1]
