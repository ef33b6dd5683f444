"""Downsampling models: how a high-resolution depth map becomes a low-resolution one.

Every model is a separable kernel, and averages valid pixels only. Kernels for the factor f, in high-resolution pixels
from the centre of the low-resolution pixel:

- ``box``: the mean of the f x f block.
- ``nearest``: the block's pixel [f // 2, f // 2], as in ``depth[f // 2 :: f, f // 2 :: f]``.
- ``bilinear``, ``bicubic`` (a = -0.5): antialiased, their kernels stretched by f, as Pillow resizes.
- ``gaussian``: standard deviation ``sigma`` * f, truncated at three standard deviations.

At the border, kernels are truncated and normalised.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.holes import Holes
from dsr.degradation.noise import Noise
from dsr.geometry.camera import Camera, RangeType, from_range, to_range
from dsr.sample import FARTHEST, NEAREST, AllHolesError, DepthSample, Scene
from dsr.utils.compute_device import known_true, made_once
from dsr.utils.guards import expect_one_of, naming, unchecked
from dsr.utils.ratios import check_scale, match_ratio

Kernel = Literal["box", "nearest", "bilinear", "bicubic", "gaussian"]
KERNELS: tuple[Kernel, ...] = get_args(Kernel)  # in the order that stored weights know them by
FACTS = len(KERNELS) + 3  # number of the facts of a map
_LEAST_WEIGHT = 0.5
_LEAST_SIGMA = 0.1  # as a fraction of the scale: at x2 the nearest pixel centre is 0.25 away, within three sigmas
_LARGEST = 0.1  # relative errors beyond this are outliers, not noise
_WINDOW = 9  # low-resolution pixels of the window in which the noise is measured


@dataclass(frozen=True)
class Downsampling:
    """A downsampling model."""

    kernel: Kernel
    sigma: float = 0.5
    range_type: RangeType | None = None
    assumed: Kernel | None = None

    def __post_init__(self) -> None:
        for name, kernel in (("kernel", self.kernel), ("assumed", self.assumed or self.kernel)):
            expect_one_of(name, kernel, KERNELS)
        if not self.sigma >= _LEAST_SIGMA:
            raise ValueError(f"sigma: expected at least {_LEAST_SIGMA} (of the scale), got {self.sigma}")

    def assumed_model(self) -> Downsampling:
        """Return the forward model that a method assumes."""
        return replace(self, kernel=self.assumed or self.kernel, assumed=None)

    def camera(self, camera: Camera, scale: int) -> Camera:
        """Return the camera of the low-resolution map; that of ``nearest`` differs from that of the centred kernels."""
        if self.kernel == "nearest":
            return camera.decimate(scale, scale // 2)
        return camera.downscale(scale)

    def __call__(self, values: Tensor, scale: int, *, complete: bool | None = None) -> Tensor:
        """Downsample (..., H, W) maps with NaN in holes; ``complete`` says whether there are none, None if not known.

        A low-resolution pixel whose block has no valid pixel is a hole. If less than half of a kernel's weight falls on
        valid pixels, the result is the mean of the block's valid pixels.
        """
        height, width = values.shape[-2:]
        if height % scale or width % scale:
            raise ValueError(f"downsampling: expected a size divisible by {scale}, got {height} x {width}")
        if self.kernel == "nearest":
            return values[..., scale // 2 :: scale, scale // 2 :: scale]
        if complete:
            return self._apply(values, scale)
        valid = values.isfinite()
        if complete is None and known_true(valid):
            return self._apply(values, scale)
        filled, weight = torch.where(valid, values, 0), valid.to(values.dtype)
        mean, fraction = self._apply(filled, scale), self._apply(weight, scale)
        box = Downsampling("box")
        block_mean, block_fraction = box._apply(filled, scale), box._apply(weight, scale)
        tiny = torch.finfo(values.dtype).tiny
        smooth = mean / fraction.clamp(min=_LEAST_WEIGHT)
        depth_lr = torch.where(fraction >= _LEAST_WEIGHT, smooth, block_mean / block_fraction.clamp(min=tiny))
        return torch.where(block_fraction > 0, depth_lr, torch.nan)

    def _apply(self, values: Tensor, scale: int) -> Tensor:
        rows, columns = (
            _matrix(self.kernel, self.sigma, size, scale, values.dtype, values.device) for size in values.shape[-2:]
        )
        return rows @ values @ columns.T


@made_once
def _matrix(kernel: Kernel, sigma: float, size: int, scale: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a kernel's weights, (size / scale, size); every row sums to 1."""
    centres = (torch.arange(size // scale, dtype=torch.float64) + 0.5) * scale - 0.5
    x = ((torch.arange(size, dtype=torch.float64) - centres[:, None]) / scale).abs()
    if kernel == "box":
        weights = (x < 0.5).double()
    elif kernel == "bilinear":
        weights = (1 - x).clamp(min=0)
    elif kernel == "bicubic":
        weights = cubic_kernel(x)
    else:
        weights = torch.exp(-0.5 * (x / sigma).square()) * (x <= 3 * sigma)
    return (weights / weights.sum(dim=1, keepdim=True)).to(device, dtype)


def kernel_matrix(model: Downsampling, size: int, scale: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weights with which a model averages the pixels along an axis, (size / scale, size)."""
    if model.kernel == "nearest":
        return torch.eye(size, dtype=dtype, device=device)[scale // 2 :: scale]
    return _matrix(model.kernel, model.sigma, size, scale, dtype, device)


def cubic_kernel(x: Tensor, a: float = -0.5) -> Tensor:
    """Return the weights of cubic convolution (Keys 1981) at distances of ``x`` pixels, 0 or more."""
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = ((x - 5) * x + 8) * x * a - 4 * a
    return torch.where(x < 1, near, torch.where(x < 2, far, 0))


@dataclass(frozen=True)
class Measured:
    """In place of a downsampling model: the scene's own low-resolution map, measured by a sensor."""

    assumed: Kernel = "box"

    def assumed_model(self) -> Downsampling:
        """Return the forward model that a method assumes."""
        return Downsampling(self.assumed)


def scene_generator(seed: int, *names: str | float) -> torch.Generator:
    """Return a generator that is a pure function of a seed and of names."""
    digest = hashlib.sha256(repr((seed, *names)).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)


def make_sample(
    scene: Scene,
    scale: float | Literal["native"],
    downsampling: Downsampling | Measured,
    range_type: RangeType,
    noise: Noise | None = None,
    generator: torch.Generator | int = 0,
    holes: Holes | None = None,
) -> DepthSample:
    """Return the super-resolution problem of a scene.

    ``scale`` is 2, 4, 8 or 16 with a model; for a measured map its ratio (to within 1 %), or ``native`` for that of the
    scene's only one. ``generator`` is of noise and holes; from a seed, each scene gets generators of its own. An image
    whose size is not a multiple of a whole scale is cropped at the bottom and the right, with a note.
    """
    if isinstance(downsampling, Measured):
        with naming(scene.name):
            ratio = match_ratio(scale, scene.measured)
        factor = ratio if isinstance(ratio, int) else 1
    else:
        check_scale(scale)
        ratio = factor = int(scale)
        if scene.depth is None:
            raise ValueError(f"{scene.name}: expected a high-resolution depth map to downsample, there is none")
    size, notes = (scene.camera.height, scene.camera.width), scene.notes
    height, width = (length // factor * factor for length in size)
    if not height or not width:
        raise ValueError(f"{scene.name}: expected at least {factor} x {factor} pixels, got {size[0]} x {size[1]}")
    if (height, width) != size:
        notes = (*notes, f"cropped from {size[0]} x {size[1]} to {height} x {width}, which {factor} divides")
        scene = scene.crop(0, 0, height, width)
    if isinstance(generator, int):
        of_noise = scene_generator(generator, scene.dataset, scene.name, ratio)
        of_holes = scene_generator(generator, scene.dataset, scene.name, ratio, "holes")
    else:
        of_noise = of_holes = generator
    if isinstance(downsampling, Measured):
        depth_lr = scene.measured[ratio]
        camera_lr = scene.camera.reduce(depth_lr.shape[-1], depth_lr.shape[-2])
    else:
        noisy = None if noise is None else (noise, of_noise)
        depth_lr, camera_lr = downsample_depth(scene.true_depth, scene.camera, factor, downsampling, range_type, noisy)
    if holes is not None:
        depth_lr = depth_lr.masked_fill(holes(depth_lr, camera_lr, of_holes), torch.nan)
    if not bool(depth_lr.isfinite().any()):
        raise AllHolesError(f"{scene.name}: depth_lr: expected at least one known pixel, all are holes")
    return unchecked(
        DepthSample, dataset=scene.dataset, scene=scene.name, rgb=scene.rgb, depth_lr=depth_lr, camera=scene.camera,
        camera_lr=camera_lr, scale=ratio, depth=scene.depth, notes=notes, unit=scene.unit, regions=scene.regions,
    )  # fmt: skip


def downsample_depth(
    depth: Tensor,
    camera: Camera,
    scale: int,
    downsampling: Downsampling,
    range_type: RangeType,
    noise: tuple[Noise, torch.Generator] | None = None,
    *,
    complete: bool | None = None,
) -> tuple[Tensor, Camera]:
    """Return the low-resolution depth that a model makes of depth, (..., H, W) in metres, and its camera.

    Differentiable. Averages and ``noise``, a model and its generator, are of a range type, unless they set another one.
    ``complete`` says whether neither map can have holes or values out of range; None if not known.
    """
    range_type = downsampling.range_type or range_type
    camera_lr = downsampling.camera(camera, scale)
    values_hr = to_range(depth, camera, range_type)
    if range_type == "disparity":  # in the low-resolution camera's pixels
        values_hr = values_hr / scale
    values = downsampling(values_hr, scale, complete=complete)
    if noise is not None:
        kind, generator = noise
        if kind.range_type is not None:
            averages = from_range(values, camera_lr, range_type)
            range_type, values = kind.range_type, to_range(averages, camera_lr, kind.range_type)
        values = kind(values, generator)
    depth_lr = from_range(values, camera_lr, range_type)
    if complete:
        return depth_lr, camera_lr
    held = (depth_lr >= NEAREST) & (depth_lr <= FARTHEST)  # bicubic may undershoot beside a depth step
    return torch.where(held, depth_lr, torch.nan), camera_lr


class Hints(NamedTuple):
    """What is known of a low-resolution map."""

    noise: Tensor  # (1, h, w), the standard deviation of the logarithm of its inverse depth, 0 where not given
    facts: Tensor  # (FACTS,), those of encode_facts


def encode_facts(kernel: str | None = None, soft: bool | None = None, *, noise: bool = False) -> Tensor:
    """Encode what is known of a map as (``FACTS``,) numbers: five for the kernel, two for softness, one for noise."""
    facts = torch.zeros(FACTS)
    if kernel is not None:
        expect_one_of("kernel", kernel, KERNELS)
        facts[KERNELS.index(kernel)] = 1
    if soft is not None:
        facts[len(KERNELS) + int(soft)] = 1
    facts[-1] = noise
    return facts


def known_kernels(facts: Tensor) -> list[str | None]:
    """Return the kernel in the facts of each map, (B, ``FACTS``); None where there is none."""
    kernels = facts[:, : len(KERNELS)].tolist()
    return [KERNELS[each.index(max(each))] if any(each) else None for each in kernels]


def relative_error(given: Tensor, result: Tensor) -> tuple[Tensor, Tensor]:
    """Return the relative error of inverse depth, 0 in holes and of outliers, and the known pixels, (B, 1, h, w)."""
    scale = result.shape[-1] // given.shape[-1]
    error = given / functional.avg_pool2d(result, scale) - 1
    known = error.isfinite() & (error.abs() < _LARGEST)
    return torch.where(known, error, 0), known.to(given.dtype)


def local_noise(given: Tensor, result: Tensor) -> Tensor:
    """Return the root mean square of :func:`relative_error` around each pixel, (B, 1, h, w); 0 where none is known."""
    error, weight = relative_error(given, result)
    padding = (_WINDOW // 2,) * 4
    squares, weights = (
        functional.avg_pool2d(functional.pad(each, padding, mode="replicate"), _WINDOW, stride=1)
        for each in (error.square(), weight)
    )
    return (squares / weights.clamp(min=1e-6)).sqrt()
