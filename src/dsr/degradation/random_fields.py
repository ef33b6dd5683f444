"""Random numbers and fields from an explicit generator, and random changes of scenes made of them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.geometry.hole_size import window_maxima
from dsr.sample import Scene
from dsr.utils.guards import derived


def draw(shares: Mapping[str, float], generator: torch.Generator) -> str:
    """Return a random key, each as often as its share says."""
    weights = torch.tensor(list(shares.values()), dtype=torch.float64)
    return list(shares)[int(torch.multinomial(weights, 1, generator=generator))]


def chance(share: float, generator: torch.Generator) -> bool:
    """Return true with a probability of ``share``."""
    return float(torch.rand(1, generator=generator)) < share


def uniform(low: float, high: float, generator: torch.Generator) -> float:
    """Return a number from ``low`` to ``high``."""
    return low + (high - low) * float(torch.rand(1, generator=generator))


def power(low: float, high: float, generator: torch.Generator) -> float:
    """Return 10 to the power of a number from ``low`` to ``high``."""
    return 10 ** uniform(low, high, generator)


def normal(generator: torch.Generator) -> float:
    """Return a number with a mean of 0 and a variance of 1."""
    return float(torch.randn(1, generator=generator))


def field_of(like: Tensor, sigma: float | tuple[float, float], generator: torch.Generator) -> Tensor:
    """Return normal noise with a variance of 1, (1, h, w), blurred by a Gaussian of ``sigma`` pixels, or of two (v, u).

    Wide Gaussians are drawn on a coarse grid and enlarged, which costs little.
    """
    if sigma == 0:
        return torch.randn(like.shape, generator=generator)
    sigmas = sigma if isinstance(sigma, tuple) else (sigma, sigma)
    factors = [max(int(each / 1.25), 1) for each in sigmas]
    height, width = like.shape[-2:]
    down, across = (_normalised_taps(each / factor) for each, factor in zip(sigmas, factors, strict=True))
    rows, columns = (
        -(-size // factor) + 2 * (factor > 1) for size, factor in zip((height, width), factors, strict=True)
    )
    draws = torch.randn((1, 1, rows + len(down) - 1, columns + len(across) - 1), generator=generator)
    field = _weighted_sums(_weighted_sums(draws, down, -2), across, -1)
    if max(factors) == 1:
        return field[0]
    size = rows * factors[0], columns * factors[1]
    top, left = (factor if factor > 1 else 0 for factor in factors)
    fine = functional.interpolate(field, size, mode="bicubic", align_corners=False)
    return fine[0, :, top : top + height, left : left + width]


def waves_of(like: Tensor, length: float, generator: torch.Generator, stretch: float = 1) -> Tensor:
    """Return normal noise of several octaves with a variance of 1, (1, h, w), ``stretch`` times as long along rows.

    ``length``: full width at half maximum of its autocorrelation in pixels; white noise for 1 and less.
    """
    if length <= 1:
        return field_of(like, 0, generator)
    ratio = uniform(0.1, 0.6, generator)  # of one octave's standard deviation to that of the next longer one
    sigma = length / (4 * math.sqrt(math.log(2)) * (1 - 0.7 * ratio**2))  # fits the sum of the octaves within 5 %
    field, variance = torch.zeros(like.shape), 0.0
    for octave in range(3):
        size = sigma / 2**octave
        field += ratio**octave * field_of(like, (size / stretch, size * stretch), generator)
        variance += ratio ** (2 * octave)
    return field / math.sqrt(variance)


def _normalised_taps(sigma: float) -> Tensor:
    """Return the values of a Gaussian whose squares add up to 1."""
    radius = max(math.ceil(3.5 * sigma), 1)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma).square())
    return taps / taps.norm()


def _weighted_sums(values: Tensor, taps: Tensor, dim: int) -> Tensor:
    """Convolve along a dimension without padding; for a single channel faster than a convolution."""
    size = values.shape[dim] - len(taps) + 1
    result = values.narrow(dim, 0, size) * taps[0]
    for place, tap in enumerate(taps[1:].tolist(), 1):
        result.add_(values.narrow(dim, place, size), alpha=tap)
    return result


def window_means(values: Tensor, size: int) -> Tensor:
    """Return the means of windows of an odd size, (1, h, w)."""
    reach = size // 2
    return functional.avg_pool2d(functional.pad(values[None], (reach,) * 4, mode="replicate"), size, stride=1)[0]


def near_steps(values: Tensor, reach: int, jump: float = 0.04) -> Tensor:
    """Return the mask of pixels within ``reach`` pixels of a step, (1, h, w)."""
    high = window_maxima(values.nan_to_num(-math.inf), reach)
    low = -window_maxima((-values).nan_to_num(-math.inf), reach)
    return high > (1 + jump) * low


def add_relief(scene: Scene, generator: torch.Generator) -> Scene:
    """Return a scene whose true depth has grain of 1 to 4 pixels, as of a scan, or is rounded, as in a file."""
    values = scene.true_depth.reciprocal()
    if chance(0.3, generator):
        return derived(scene, depth=round_values(values, generator).reciprocal())
    grain = field_of(values.float(), uniform(0, 1.5, generator) if chance(0.6, generator) else 0, generator)
    return derived(scene, depth=(values * (1 + power(-4.6, -3, generator) * grain)).reciprocal())


def add_folds(scene: Scene, generator: torch.Generator) -> Scene:
    """Return a scene with smooth folds on parts of its surfaces, shaded by a light from a random side."""
    like = scene.true_depth.float()
    sizes = power(0.3, 1.4, generator), power(0.3, 1.4, generator)
    field = field_of(like, sizes, generator)
    if chance(0.4, generator):  # creases
        field = field.abs() - 0.8
    place = torch.sigmoid(6 * (field_of(like, 20, generator) + uniform(-1, 1, generator)))
    slope = power(-1.5, -0.2, generator)
    height = slope * min(sizes) / scene.camera.fx * field * place  # relative to the depth
    angle, strength = uniform(-math.pi, math.pi, generator), max(0.0, uniform(-0.4, 1.2, generator))
    down, across = (functional.pad(height.diff(dim=dim), pad) for dim, pad in ((-2, (0, 0, 0, 1)), (-1, (0, 1, 0, 0))))
    light = 1 + strength * scene.camera.fx * (math.cos(angle) * across + math.sin(angle) * down)
    rgb = (scene.rgb * light.clamp(0.2, 1.8).to(scene.rgb)).clamp(0, 1)
    return derived(scene, rgb=rgb, depth=scene.true_depth * (1 + height.clamp(-0.2, 0.2)).to(scene.true_depth))


def displace(values: Tensor, scale: int, generator: torch.Generator) -> Tensor:
    """Return a map (1, H, W) shifted by up to ``scale`` pixels along each axis, half of them also magnified."""
    for dim in (-2, -1):
        size = values.shape[dim]
        shift, growth = uniform(-scale, scale, generator), uniform(-scale, scale, generator)
        if chance(0.5, generator):
            growth = 0.0
        places = torch.arange(size, dtype=torch.float32)
        moves = (shift + growth * (2 * places / max(size - 1, 1) - 1)).clamp(-scale, scale)
        values = values.index_select(dim, (places + moves).round().long().clamp(0, size - 1))
    return values


def round_values(values: Tensor, generator: torch.Generator) -> Tensor:
    """Round to millimetres of depth, or to 8 bits of disparity."""
    if chance(0.6, generator):
        step = (0.001, 0.001, 0.002, 0.005)[int(torch.randint(4, (1,), generator=generator))]
        return ((values.reciprocal() / step).round() * step).clamp(min=step).reciprocal()
    top = float(values.nan_to_num(0).max()) * uniform(1, 1.3, generator)
    return ((values / top * 255).round() / 255 * top).clamp(min=top / 255)


def print_pattern(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Return a photo, (3, H, W), of surfaces on which a pattern is printed; values may exceed 1."""
    pattern = field_of(rgb[:1], power(0, 1.2, generator), generator)
    colour = 0.2 * torch.randn((3, 1, 1), generator=generator) + uniform(0.1, 0.5, generator)
    return rgb * (1 + colour * pattern.clamp(-2, 2)).clamp(min=0)


def take_another_photo(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Return a photo, (3, H, W), with another exposure, white balance and contrast, and with blur, noise and JPEG.

    One of twelve shows little, down to nothing, as at night or in fog.
    """
    gain = math.exp(uniform(-0.7, 0.5, generator)) * (1 + 0.08 * torch.randn((3, 1, 1), generator=generator))
    rgb = (rgb * gain).clamp(0, 1) ** math.exp(uniform(-0.4, 0.4, generator))
    if chance(1 / 12, generator):
        rgb = torch.lerp(rgb.mean(dim=(-2, -1), keepdim=True), rgb, uniform(0, 0.3, generator))
    if chance(0.5, generator):
        sigma = uniform(0.3, 1.2, generator)
        rgb = torch.from_numpy(ndimage.gaussian_filter(rgb.numpy(), (0, sigma, sigma), mode="nearest", truncate=2.5))
    rgb = (rgb + uniform(0, 0.03, generator) * torch.randn(rgb.shape, generator=generator)).clamp(0, 1)
    if chance(0.5, generator):
        pixels = (255 * rgb).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        _, code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, round(uniform(25, 90, generator))])
        decoded = cv2.cvtColor(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
        rgb = torch.from_numpy(decoded).permute(2, 0, 1).float() / 255
    return rgb
