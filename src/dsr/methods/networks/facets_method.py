"""The method around :class:`~dsr.methods.networks.facets_unet.FacetsUNet`: maps of any ratio, given or estimated noise.

There are weights for maps whose size is the photo's over 1 and 2, over 4, over 8 and over 16. For any other ratio the
photo is resized to a multiple of the map, and the result to the photo's size.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import Kernel, encode_facts, local_noise, relative_error
from dsr.geometry.hole_size import degrees_per_pixel, distance_to_known
from dsr.geometry.resampling import pad_inverse_depth, resize_inverse_depth
from dsr.methods.base import Abilities, Cost, InverseSample, InverseSurface, MapNoise, Method, NoiseLaw, Surface
from dsr.methods.images import pad_to_multiple
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.network import DTYPES, Answer, DisparityNetwork, Precision
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import linked_weights, load_network
from dsr.sample import DepthSample
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps

Edges = Literal["auto", "sharp", "soft"]
_TOLERANCE = 0.02  # a map is taken for one of the photo's own size up to this relative difference
CAUTION = 1.1  # measured errors over expected ones on held-out rendered scenes, see ``benchmarks/run.py confidence``
# of maps without noise, by kernel and depth steps: which further weights there may be, and ``CAUTION`` for them
SPECIAL: Mapping[tuple[Kernel | None, Edges], tuple[Literal["clean", "soft"], float]] = MappingProxyType(
    {("box", "sharp"): ("clean", 0.85), ("bicubic", "soft"): ("soft", CAUTION)}
)
# Relative error of depth in holes that the network does not expect, per degree from the nearest measured pixel. On
# Middlebury 2014 and ICL-NUIM with holes cut into them it expects 2 %, and depth is off by 4 % at 1 to 3 degrees.
_PER_DEGREE = 0.012
_ROUNDED = 16  # a map with fewer different values than one per so many pixels may be a rounded one
# Share of a level's borders that it has at least with the next nearer and with the next farther level, largest ratio of
# the two steps, and number of such levels from which a map is rounded, otherwise it shows boards at exact depths; and
# relative steps of other levels over the largest of these, at most.
_STAIR, _EVEN, _STAIRS, _EXCESS = 0.05, 1.3, 2, 2


class AnyMap(Method):
    """A method for maps of any ratio, kernel and noise.

    Maps known to be without noise, and either box means with sharp depth steps or bicubic with soft ones, are computed
    with weights of their own, if the file of weights names a file with such weights.
    """

    abilities = Abilities(
        ratios="any", own_size=True, needs="network", tolerant=True, cost=Cost(100, 2.5, 40, program=5e8)
    )

    def __init__(
        self,
        weights: Path | FacetsUNet,
        noise: float | None = None,
        smooth: float = 1.0,
        edges: Edges = "auto",
        kernel: Kernel | None = None,
        clean: bool = False,
        max_error: float | None = None,
        device: torch.device | str = "cpu",
        noise_growth: float = 0.0,
        model: str = "facets",
        precision: Precision = "float32",
        networks: Mapping[str, type[DisparityNetwork]] = NETWORKS,
    ) -> None:
        cleanly = noise is None and clean and smooth == 1
        if cleanly:
            noise = 0.0
        expect_one_of("edges", edges, get_args(Edges))
        for fits, message in (
            (0 <= smooth <= 2, f"smooth: expected a number from 0 to 2, got {smooth}"),
            (noise is None or 0 <= noise < 1, f"noise: expected metres, 0 or more and less than 1, got {noise}"),
            (0 <= noise_growth <= 4, f"noise_growth: expected a power of distance from 0 to 4, got {noise_growth}"),
            (noise is not None or not noise_growth, f"noise_growth: expected noise with it, got {noise_growth} alone"),
            (max_error is None or max_error > 0, f"max_error: expected a positive share of the depth, got {max_error}"),
        ):
            if not fits:
                raise ValueError(message)
        self._caution = CAUTION
        if isinstance(weights, str | Path):
            path = Path(weights)
            kind, caution = SPECIAL.get((kernel, edges), (None, CAUTION)) if cleanly else (None, CAUTION)
            if kind is not None and (special := linked_weights(path, kind)) is not None:
                path, self._caution = special, caution
            net = load_network(path, networks, None, model)
            if not isinstance(net, FacetsUNet):
                raise ValueError(f"{path}: expected weights of FacetsUNet, got those of {type(net).__name__}")
            weights = net.eval().requires_grad_(False).to(DTYPES[precision])
        self._max_error = max_error
        self._net = weights.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs
        self._device, self._smooth = torch.device(device), smooth
        self._noise = None if noise is None else (noise, noise_growth)
        self._facts = encode_facts(kernel, None if edges == "auto" else edges == "soft")[None]

    @torch.no_grad()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres on the sample's device."""
        return self.surface(sample, progress).depth

    def surface(self, sample: DepthSample, progress: Steps | None = None) -> Surface:
        """Return the high-resolution depth with its expected errors, and the noise of the low-resolution map."""
        return self._upsample(sample, self._noise, progress)

    def upsample_inverse(self, problem: InverseSample, progress: Steps | None = None) -> InverseSurface:
        """Return the same as inverse depth, with the noise that is known of the map, unless the method has one."""
        return InverseSurface.of(self._upsample(problem.in_depth(), self._noise or problem.noise, progress))

    @torch.no_grad()
    def _upsample(self, sample: DepthSample, noise: NoiseLaw | None, progress: Steps | None) -> Surface:
        """Return the result for a map of this noise; None for one that is not known."""
        inverse = sample.depth_lr.to(self._device).reciprocal()[None]
        height, width = sample.rgb.shape[-2:]
        rows, columns = inverse.shape[-2:]
        own_size = self._net.serves(self._net.scale, 1) and sample.scale <= 1 + _TOLERANCE
        factor = 1 if own_size else self._net.scale
        rgb = _resize(sample.rgb.to(self._device).float()[None], (factor * rows, factor * columns)).clamp(0, 1)
        padded = inverse
        if factor == 1:  # in pairs
            rgb = pad_to_multiple(rgb, 2)
            padded = pad_inverse_depth(inverse, 2)
        level = None if noise is None else (noise[0] * padded ** (1 - noise[1])).nan_to_num(0)
        if level is None and self._smooth != 1:
            first = self._answer(rgb, padded, None, _half(progress, 0))
            level, progress = local_noise(padded, first.disparity), _half(progress, 1)
        answer = self._answer(rgb, padded, None if level is None else self._smooth * level, progress)
        inside = (..., slice(factor * rows), slice(factor * columns))
        result = resize_inverse_depth(answer.disparity[inside][0], (height, width))
        depth = torch.where(result > 0, result, torch.nan).reciprocal().to(sample.depth_lr.device)

        def fit(error: Tensor) -> Tensor:
            return _resize(error, (height, width))[0].to(depth)

        focal = sample.camera_lr.fx
        known, guessing = inverse.isfinite(), torch.zeros_like(inverse)  # in holes beyond what the network expects
        if not bool(known.all()):
            away = torch.stack([distance_to_known(each) for each in known])
            guessing = (_PER_DEGREE * degrees_per_pixel(focal) * away).clamp(max=1)
        rounding, tilt, guessing = (each.to(depth) for each in (*_rounding(inverse, focal), guessing))
        spread = torch.maximum(self._caution * fit(answer.spread[inside]), fit(rounding)) + fit(guessing)
        angle = torch.maximum(self._caution * fit(answer.angle[inside]), fit(tilt))
        depth_error = spread * depth
        if self._max_error is not None:
            depth = depth.masked_fill(spread > self._max_error, torch.nan)
        return Surface(depth, depth_error, torch.rad2deg(angle), _describe_noise(padded, answer))

    def _answer(self, rgb: Tensor, inverse: Tensor, noise: Tensor | None, progress: Steps | None) -> Answer:
        facts = self._facts.to(self._device).clone()
        facts[0, -1] = noise is not None
        return self._net.answer(rgb, inverse, None if noise is None else noise.float(), facts, progress)


def _half(progress: Steps | None, before: int) -> Steps | None:
    """Return the progress of the first or the second of two passes of the same number of steps."""
    return None if progress is None else lambda done, total: progress(before * total + done, 2 * total)


def _describe_noise(given: Tensor, answer: Answer) -> MapNoise:
    """Return the noise of a map, from its difference to the result where that is smooth."""
    error, known = relative_error(given, answer.disparity)
    scale = answer.disparity.shape[-1] // given.shape[-1]
    calm = functional.avg_pool2d(answer.angle, scale)
    known = known * (calm <= calm.flatten().median())
    count = known.sum().clamp(min=1)
    error = (error - (error * known).sum() / count) * known
    variance = error.square().sum() / count
    depth = given[given.isfinite()].median().reciprocal()
    least = max(float(variance), 1e-20)
    before, extent = 1.0, 2.0 * 16  # the full width at half maximum of the correlation of neighbours, in pixels
    for step in range(1, min(16, error.shape[-1])):
        both = (known[..., step:] * known[..., :-step]).sum().clamp(min=1)
        now = float((error[..., step:] * error[..., :-step]).sum() / both) / least
        if now < 0.5:
            extent = max(1.0, 2 * (step - 1 + (before - 0.5) / max(before - now, 1e-6)))
            break
        before = now
    return MapNoise(float(variance.sqrt() * depth), extent, float(depth))


def _rounding(inverse: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Return the expected errors of maps rounded to few values, (B, 1, h, w), 0 where the values around a pixel differ.

    That of depth is relative, a quarter of the step to the next value, that of the normal, in radians, the tilt of a
    surface that gains it up to the next other value.
    """
    nothing, known = torch.zeros_like(inverse), inverse.isfinite()
    values = inverse[known].unique()
    if values.numel() < 2 or values.numel() * _ROUNDED >= known.sum():
        return nothing, nothing
    gaps = values.diff()
    smaller, larger = torch.minimum(gaps[:-1], gaps[1:]), torch.maximum(gaps[:-1], gaps[1:])
    level = torch.searchsorted(values, torch.where(known, inverse, values[0]))
    above, borders = torch.zeros_like(values), torch.zeros_like(values)  # with the next level, and all, by level
    for dim in (2, 3):
        count = inverse.shape[dim] - 1
        both = known.narrow(dim, 0, count) & known.narrow(dim, 1, count)
        ends = torch.stack((level.narrow(dim, 0, count)[both], level.narrow(dim, 1, count)[both]))
        low, high = ends.amin(dim=0), ends.amax(dim=0)
        above += torch.bincount(low[high - low == 1], minlength=len(values))
        borders += torch.bincount(ends[:, low < high].flatten(), minlength=len(values))
    stairs = (larger <= _EVEN * smaller) & (torch.minimum(above[1:-1], above[:-2]) > _STAIR * borders[1:-1])
    if stairs.sum() < _STAIRS:
        return nothing, nothing
    step = torch.cat((gaps[:1], smaller, gaps[-1:])) / values  # of single levels at most _EXCESS of a staircase's
    relative = (step.clamp(max=_EXCESS * step[1:-1][stairs].max()) / 4)[level]
    low = -functional.max_pool2d(-torch.where(known, inverse, torch.inf), 3, stride=1, padding=1)
    high = functional.max_pool2d(torch.where(known, inverse, -torch.inf), 3, stride=1, padding=1)
    flat = known & (low == high)
    away = torch.stack([distance_to_known(each) for each in ~flat])
    return torch.where(flat, relative, 0), torch.where(flat, torch.atan(focal * relative / (away + 1)), 0)


def _resize(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Return (B, C, *size), bilinear, antialiased where it shrinks."""
    if tuple(x.shape[-2:]) == tuple(size):
        return x
    return functional.interpolate(x, size, mode="bilinear", align_corners=False, antialias=True)
