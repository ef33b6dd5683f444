"""Edge-guided upsampling of a depth map alone: a bilateral filter whose means do not cross predicted edges.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016, in its self-similar mode.
:mod:`dsr.methods.classical.edge_map` predicts the high-resolution edges; the modified joint bilateral filter then is

    S_p = 1 / k_p * sum over low-resolution pixels q of S_q f(|p - q|) r(p, q),

with f a Gaussian of the distance in low-resolution pixels, r = 1 if a 4-connected path from p to q within the
neighbourhood touches no edge and 0 otherwise, and k_p the sum of the weights.

What differs, besides the edge map and what docs/measurements/methods.md says: a low-resolution pixel with an edge
through it mixes both sides, so its weight is multiplied by ``mixed``. Pixels on edges get the value that preserves the
mean of their block, between the two sides; in the last stage, each then takes the reachable pixels of its most similar
neighbour off the edge. Where no pixel is reachable, the result is the bicubic map.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method, expect_positive, whole_scale
from dsr.methods.classical.edge_map import predict_edge_map
from dsr.methods.classical.guided_filter import BEYOND, estimate_slopes, expect_window
from dsr.methods.images import box_mean, inpaint, repeat_blocks, upsample_linear_border
from dsr.sample import DepthSample
from dsr.utils.progress import Steps, ignore, part_of

# rows and columns from a pixel to its neighbours, the nearest first
_BESIDE = ((-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))


def bilateral_filter(
    lr: Tensor,
    barrier: Tensor,
    scale: int,
    radius: int,
    sigma_space: float,
    mixed: float,
    *,
    doubtful: Tensor | None = None,
    sharp: bool = True,
) -> Tensor:
    """Upsample a map, (h, w), by the modified joint bilateral filter to (H, W); holes, NaN, stay holes.

    The barrier is the edge map, (H, W) bool. ``doubtful``, (h, w) bool, are further low-resolution pixels that mix two
    sides. If ``sharp``, pixels on edges take a side; otherwise they keep the value that preserves the block means.
    """
    valid = lr.isfinite()
    doubtful = torch.zeros_like(valid) if doubtful is None else doubtful
    lr_inpainted = inpaint(lr[None, None])
    cut = functional.max_pool2d(barrier[None, None].float(), scale)[0, 0] > 0
    lr_certain = lr.masked_fill(doubtful, torch.nan)
    trust = torch.where(cut | doubtful, mixed, 1.0).to(lr) * valid
    planes = torch.stack((lr_inpainted[0, 0], estimate_slopes(lr_certain, 0), estimate_slopes(lr_certain, 1), trust))
    smooth = upsample_linear_border(lr_inpainted, scale)[0, 0]
    reachable = find_reachable(barrier, scale, radius)
    hr = _fill_edges(_filter(planes, reachable, scale, sigma_space, smooth), barrier, lr_inpainted, smooth, scale)
    if sharp:
        _take_sides(reachable, barrier, hr, scale)
        hr = torch.where(barrier, _filter(planes, reachable, scale, sigma_space, smooth), hr)
    return hr.masked_fill(~repeat_blocks(valid[None, None], scale)[0, 0], torch.nan)


def find_reachable(barrier: Tensor, scale: int, radius: int) -> Tensor:
    """Return which low-resolution pixels each high-resolution pixel reaches, (2 radius + 1, 2 radius + 1, H, W) bool.

    [radius + a, radius + b] is for the one a rows below and b columns right of the pixel's own. Paths start in its
    middle, and are 4-connected, off the edges of the barrier, (H, W) bool, and within ``radius`` rows and columns.
    """
    height, width = barrier.shape[0] // scale, barrier.shape[1] // scale
    side, edge = 2 * radius + 1, radius * scale
    padded = functional.pad(barrier, (edge, edge, edge, edge), value=True)
    windows = padded.unfold(0, side * scale, scale).unfold(1, side * scale, scale).flatten(0, 1)
    ways = torch.ones_like(windows)
    cut = windows.flatten(1).any(dim=1)
    free = ~windows[cut]
    middle = slice((side * scale - 1) // 2, side * scale // 2 + 1)
    start = torch.zeros_like(free)
    start[:, middle, middle] = free[:, middle, middle]
    within = ndimage.generate_binary_structure(2, 1)[None]  # a window's neighbours are no other windows
    flooded = ndimage.binary_propagation(start.cpu().numpy(), within, free.cpu().numpy())
    ways[cut] = torch.from_numpy(flooded).to(free.device)
    ways = functional.pad(ways.view(height, width, -1), (0, 0, radius, radius, radius, radius))
    ways = ways.unflatten(2, (side, scale, side, scale))
    result = []
    for a in range(side):
        for b in range(side):
            there = ways[a : a + height, b : b + width, side - 1 - a, :, side - 1 - b]  # (h, w, scale, scale)
            result.append(there.transpose(1, 2).reshape(barrier.shape))
    return torch.stack(result).unflatten(0, (side, side))


def _filter(planes: Tensor, reachable: Tensor, scale: int, sigma_space: float, smooth: Tensor) -> Tensor:
    """Return means of planes, (4, h, w): value, slopes along rows and columns, weight; ``smooth`` where all weigh 0."""
    height, width = planes.shape[1:]
    rows, columns = (torch.arange(n, device=smooth.device) for n in smooth.shape)
    y, x = ((n.to(smooth) + 0.5) / scale - 0.5 for n in (rows, columns))
    total, weights = torch.zeros_like(smooth), torch.zeros_like(smooth)
    radius = reachable.shape[0] // 2
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            i, j = rows // scale + a, columns // scale + b
            at = i.clamp(0, height - 1)[:, None], j.clamp(0, width - 1)  # nothing beyond the border is reachable
            down, across = (y - i)[:, None], x - j
            weight = torch.exp((down.square() + across.square()) / (-2 * sigma_space**2))
            value, slope_down, slope_across, trust = planes[:, *at]
            weight = weight * trust * reachable[radius + a, radius + b]
            total += weight * (value + slope_down * down + slope_across * across)
            weights += weight
    return torch.where(weights > 0, total / torch.where(weights > 0, weights, 1), smooth)


def _fill_edges(hr: Tensor, barrier: Tensor, lr: Tensor, smooth: Tensor, scale: int) -> Tensor:
    """Return the map with smooth values on edges, shifted to preserve block means, clamped to the neighbours' range."""
    start = torch.where(barrier, smooth, hr)[None, None]
    fraction = box_mean(barrier[None, None].to(hr), scale)
    missing = repeat_blocks((lr - box_mean(start, scale)) / torch.where(fraction > 0, fraction, 1), scale)
    beside = torch.cat((start, -start)).masked_fill(barrier, -torch.inf)
    most, least = functional.max_pool2d(beside, 3, stride=1, padding=1).unbind(0)
    value = (start + missing)[0].clamp(-least, most)
    return torch.where(barrier & most.isfinite(), value, start[0])[0]


def _take_sides(reachable: Tensor, barrier: Tensor, hr: Tensor, scale: int) -> None:
    """Copy to each edge pixel, in place, what its most similar neighbour off the edge reaches, if there is one."""
    places = barrier.nonzero()
    beside = places[:, None] + places.new_tensor(_BESIDE)  # (N, 8, 2)
    inside = ((beside >= 0) & (beside < places.new_tensor(barrier.shape))).all(dim=2)
    beside = torch.where(inside[:, :, None], beside, places[:, None])
    off = ~barrier[beside[..., 0], beside[..., 1]]
    apart = (hr[beside[..., 0], beside[..., 1]] - hr[places[:, 0], places[:, 1]][:, None]).abs()
    best = apart.masked_fill(~off, torch.inf).argmin(dim=1)
    chosen = beside[torch.arange(len(places), device=places.device), best]  # an edge where there is no neighbour
    side = len(reachable)
    there = places // scale - chosen // scale + torch.arange(side, device=places.device)[:, None, None]  # (side, N, 2)
    within = (there >= 0) & (there < side)
    rows, columns = there.clamp(0, side - 1).unbind(2)
    seen = reachable[rows[:, None], columns[None], chosen[:, 0], chosen[:, 1]]  # (side, side, N)
    reachable[:, :, places[:, 0], places[:, 1]] = seen & within[:, None, :, 0] & within[None, :, :, 1]


@dataclass(eq=False)
class EdgeGuided(Method):
    """Edge-guided upsampling of the low-resolution disparity.

    Args:
        step: minimum step of disparity at an edge, as a fraction of the map's range.
        candidates: number of candidates for each patch of edges.
        sharp_weight: weight of the edges relative to that of their distance transform, in the similarity of patches.
        smoothness: weight of the disagreement of overlapping patches.
        iterations: maximum number of iterations of belief propagation in each stage.
        radius: radius of the filter's neighbourhood in low-resolution pixels of the stage.
        sigma_space: standard deviation of the distance's Gaussian, in low-resolution pixels of the stage.
        mixed: weight of a low-resolution pixel with an edge through it, relative to others.
        fill_holes: whether holes of the low-resolution map are inpainted; otherwise they stay.

    Attributes:
        history: of the last call: iterations (over all stages), energy of the labels, largest change of a message.

    """

    abilities = Abilities(cost=Cost(1500, 12))

    step: float = 0.05
    candidates: int = 5
    sharp_weight: float = 3.0
    smoothness: float = 1.0
    iterations: int = 100
    radius: int = 1
    sigma_space: float = 0.5
    mixed: float = 0.01
    fill_holes: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        expect_positive(step=self.step, candidates=self.candidates, sharp_weight=self.sharp_weight)
        expect_positive(smoothness=self.smoothness, iterations=self.iterations)
        expect_positive(sigma_space=self.sigma_space, mixed=self.mixed)
        expect_window(radius=self.radius)

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth."""
        disparity = disparity_lr = sample.disparity_lr(torch.float64)[0]
        lowest, highest = (float(bound) for bound in disparity_lr[disparity_lr.isfinite()].aminmax())
        step = self.step * (highest - lowest)
        self.history = []
        stages, rest = [], whole_scale(sample)  # the prime factors, the smallest first
        while rest > 1:
            stages.append(next(n for n in range(2, rest + 1) if rest % n == 0))
            rest //= stages[-1]
        barrier: Tensor | None = None
        for number, scale in enumerate(stages):
            report = part_of(progress, number * self.iterations, len(stages) * self.iterations) or ignore
            doubtful, last = barrier, number == len(stages) - 1
            barrier, history = predict_edge_map(
                disparity, scale, step, self.candidates, self.sharp_weight, self.smoothness, self.iterations, report
            )
            report(self.iterations, self.iterations)
            done = self.history[-1]["iteration"] if self.history else 0.0
            self.history += [{**entry, "iteration": entry["iteration"] + done} for entry in history]
            disparity = bilateral_filter(
                disparity, barrier, scale, self.radius, self.sigma_space, self.mixed, doubtful=doubtful, sharp=last
            )
        doffs = sample.camera.doffs  # disparity + doffs is inverse depth
        disparity = disparity.clamp((lowest + doffs) / BEYOND - doffs, (highest + doffs) * BEYOND - doffs)
        if self.fill_holes:
            disparity = inpaint(disparity[None, None])[0, 0]
        return from_range(disparity[None], sample.camera, "disparity").to(sample.depth_lr)
