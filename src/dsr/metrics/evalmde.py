"""RelNormal and SAWA-H of EvalMDE, and the parts of SAWA-H singly.

Wu et al., *Toward a Better Understanding of Monocular Depth Evaluation* (arXiv 2510.19814); princeton-vl/EvalMDE
ea9e21c. SAWA-H is a sum of errors, weighted to agree with human judgment:

    SAWA-H = 3.65 wkdr + 0.18 beyond_disparity + 0.01 beyond_depth + 0.20 (1 - boundary F1) + 1.94 RelNormal

WKDR is of all pairs of pixels, of which theirs draws 10^7 without a seed; Sobol points are in 64 bits, not 32.

Pixels without a truth are left out. Holes of a prediction count as errors, except for false edges, which they spare.
"""

import math
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.surface import length
from dsr.metrics.boundaries import depth_pro_scores
from dsr.metrics.depth import covered
from dsr.metrics.formats import Metric, column, of_parts, target_mask
from dsr.metrics.functional import SurfacePair, once_per_pair
from dsr.utils.compute_device import in_own_precision

SCALES = (1, 2, 4, 8)
RADIUS, SMALLEST_RADIUS = 32, 3  # pixels: limits of the distance of two normals along each axis, at scale 1 and at any
PAIRS = 10**6
CHUNK = 1 << 15  # how many points or pairs are worked on at a time
STEEPEST = 1e-5  # sine of the angle between the two edges of a triangle below which it has no normal
RATIO = 1.25**0.125
NEAREST = 1e-4  # lower limit of aligned depth in metres and of aligned disparity in 1/m
MIN_SIZE = 2 * SCALES[-1] + 1  # of a map with a normal at the coarsest scale


@once_per_pair
def rel_normal(pair: SurfacePair) -> Tensor:
    """Return RelNormal, (B,) in radians, the mean error of the angle between two normals; lower is better.

    At each of four scales, 10^6 pairs of pixels up to 32 pixels of scale 1 apart, and the mean of the scales' means.
    A pair counts if the truth has both normals, as an error of pi if the prediction has not.
    """
    shape, found = pair.target.shape, []
    target = torch.where(pair.target_mask, pair.given[1], 1)
    for scale, (first, second) in zip(SCALES, sobol_pairs(*shape[-2:], pair.target.device), strict=True):
        source = nearest_to_centres(pair.target_mask, scale)
        rays = _taken(pair.rays.expand(len(source), -1, -1, -1), source)
        maps = ((target, pair.target_mask), (pair.prediction, pair.depth_mask))
        surfaces = [_normals(_taken(depth, source) * rays, _taken(mask, source)) for depth, mask in maps]
        rows = torch.cat(surfaces, dim=1).flatten(2).mT.contiguous()  # (B, h w, 8): what a pair reads lies together
        found.append(torch.stack([_pair_error(each, first, second) for each in rows]))
    return torch.stack(found, dim=1).nanmean(dim=1)


def nearest_to_centres(mask: Tensor, scale: int) -> Tensor:
    """Return for each block the index, in the flattened mask, of the set pixel nearest to its centre, (B, h, w)."""
    (height, width), device = mask.shape[-2:], mask.device
    padded = torch.nn.functional.pad(mask, (0, -width % scale, 0, -height % scale))
    blocks = torch.nn.functional.pixel_unshuffle(padded.float(), scale)  # (B, scale^2, h, w), row by row
    offset = torch.arange(scale, device=device)
    squares = (2 * offset - scale + 1) ** 2
    order = (squares[:, None] + squares).flatten().argsort(stable=True)
    inside = order[blocks[:, order].argmax(dim=1)]
    v = torch.arange(blocks.shape[-2], device=device)[:, None] * scale + inside // scale
    u = torch.arange(blocks.shape[-1], device=device) * scale + inside % scale
    return v.clamp(max=height - 1) * width + u.clamp(max=width - 1)


@lru_cache(maxsize=2)
@torch.inference_mode(mode=False)  # what is kept serves gradients, too
def sobol_pairs(height: int, width: int, device: torch.device) -> list[Tensor]:
    """Return the pairs of normals to compare, of a Sobol sequence, for each scale (2, 10^6) int32 indices."""
    engine, found = torch.quasirandom.SobolEngine(4), []
    draws: list[Tensor] = []
    for scale in SCALES:
        h, w = (-(-size // scale) - 2 for size in (height, width))
        reach = min(max(RADIUS // scale, SMALLEST_RADIUS), max(h, w))
        keys: list[Tensor] = []
        while sum(map(len, keys)) < PAIRS:
            if len(keys) == len(draws):
                draws.append(engine.draw(CHUNK, dtype=torch.float64).T.contiguous())
            v, u, down, right = draws[len(keys)]
            v, u = v * h, u * w
            below, beside = (v + (2 * reach * down - reach)).floor(), (u + (2 * reach * right - reach)).floor()
            inside = (below >= 0) & (below < h) & (beside >= 0) & (beside < w)
            first, second = (v.floor() * w + u.floor()).long(), (below * w + beside).long()
            keys.append(((first << 32) + second)[inside])
        ordered = torch.from_numpy(np.sort(torch.cat(keys)[:PAIRS].numpy()))
        found.append(torch.stack((ordered >> 32, ordered & 0xFFFFFFFF)).int().to(device))
    return found


@once_per_pair
def wkdr(pair: SurfacePair) -> Tensor:
    """Return the fraction of ordered pairs of true pixels that the prediction has in another order or lacks, (B,)."""
    from scipy.stats import kendalltau  # noqa: PLC0415 - it takes half a second to import

    errors = []
    for prediction, target, known, true in zip(*pair.given, pair.depth_mask, pair.target_mask, strict=True):
        x, y = (each[known].detach().float().cpu() for each in (prediction, target))  # in 32 bits, as theirs
        keys = [each.view(torch.int32) for each in (x, y)]
        ties = []  # how many pairs of numbers are equal
        for each in (*keys, (keys[0].long() << 32) | keys[1]):
            counts = torch.unique_consecutive(each.sort().values, return_counts=True)[1]
            ties.append(int((counts * (counts - 1) // 2).sum()))
        count = len(x) * (len(x) - 1) // 2
        tau = kendalltau(x.numpy(), y.numpy()).statistic if count > max(ties) else 0
        balance = round(tau * math.sqrt((count - ties[0]) * (count - ties[1])))  # concordant pairs less discordant ones
        right = len(x) ** 2 - (count - ties[2] - balance)
        total = int(true.sum())
        errors.append(1 - right / total**2 if total else math.nan)
    return torch.tensor(errors, dtype=torch.float64, device=pair.target.device)


@once_per_pair
def beyond(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the fractions of pixels with a ratio to the true depth of :data:`RATIO` or more, (B,) each.

    They are named by what is fitted to the truth by least squares, ``disparity`` or ``depth``.
    """
    weights, found = pair.depth_mask.double(), {}
    count = weights.sum(dim=(2, 3), keepdim=True)
    for fitted in ("disparity", "depth"):
        inverse = fitted == "disparity"
        given = (1 / pair.prediction, 1 / pair.target) if inverse else (pair.prediction, pair.target)
        values, target = (each.double() for each in given)
        means = [(each * weights).sum(dim=(2, 3), keepdim=True) / count for each in (values, target)]
        centred = (values - means[0]) * weights
        square = (centred * centred).sum(dim=(2, 3), keepdim=True)
        factor = (centred * (target - means[1])).sum(dim=(2, 3), keepdim=True) / square.clamp(min=1e-300)
        aligned = ((values - means[0]) * factor + means[1]).clamp(min=NEAREST)
        aligned = 1 / aligned if inverse else aligned
        ratio = torch.maximum(aligned / pair.target, pair.target / aligned)
        within = ((ratio < RATIO) & pair.depth_mask).sum(dim=(1, 2, 3))
        found[fitted] = 1 - within.double() / pair.target_mask.sum(dim=(1, 2, 3))
    return found


def boundary_error(pair: SurfacePair) -> Tensor:
    """Return 1 less the boundary F1 of Depth Pro, (B,)."""
    return 1 - depth_pro_scores(pair)["F1"]


def sawa_h(pair: SurfacePair) -> Tensor:
    """Return SAWA-H, (B,), see the module; lower is better."""
    fitted = beyond(pair)
    parts = (
        (3.65, wkdr(pair)),
        (0.18, fitted["disparity"]),
        (0.01, fitted["depth"]),
        (0.20, boundary_error(pair)),
        (1.94, rel_normal(pair)),
    )
    return torch.stack([weight * part.double() for weight, part in parts]).sum(dim=0)


def _taken(values: Tensor, source: Tensor) -> Tensor:
    """Return the pixels (B, h, w) of a map (B, C, H, W), (B, C, h, w)."""
    index = source.flatten(1)[:, None].expand(-1, values.shape[1], -1)
    return values.flatten(2).gather(2, index).unflatten(2, source.shape[1:])


def _normals(points: Tensor, mask: Tensor) -> Tensor:
    """Return the normals of points (B, 3, h, w) and whether there are any, in 32 bits, (B, 4, h - 2, w - 2)."""
    corner, below, beside = points[..., :-2, :-2], points[..., 2:, :-2], points[..., :-2, 2:]
    (a, b, c), (d, e, f) = ((each - corner).unbind(1) for each in (below, beside))
    normal = torch.stack((b * f - c * e, c * d - a * f, a * e - b * d), dim=1)
    lengths = length(normal)
    least = STEEPEST * (length(below - corner) * length(beside - corner))
    valid = (lengths > least) & mask[..., :-2, :-2] & mask[..., 2:, :-2] & mask[..., :-2, 2:]
    return torch.cat((torch.where(valid, normal / lengths, 0), valid), dim=1).float()


@in_own_precision
def _pair_error(rows: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Return the mean error of the pairs of one scale, (): NaN if the truth has both normals of none."""
    sums = rows.new_zeros(8, 2)  # of squares: a matrix product, as sums over three columns are slow
    sums[:3, 0] = sums[4:7, 1] = 1
    total, count = rows.new_zeros((), dtype=torch.float64), rows.new_zeros((), dtype=torch.float64)
    for one, two in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
        a, b = rows.index_select(0, one), rows.index_select(0, two)
        valid = a[:, 3::4] * b[:, 3::4]
        # from the chord, which is precise for small angles in 32 bits
        angles = 2 * (((a - b).square() @ sums).sqrt() / 2).clamp(max=1).asin()
        error = torch.where(valid[:, 1] > 0, (angles[:, 0] - angles[:, 1]).abs(), torch.pi)
        total, count = total + (error * valid[:, 0]).sum(), count + valid[:, 0].sum()
    return total / count


_alone = partial(Metric, mask=target_mask, min_size=MIN_SIZE, whole=True)
_fitted = {name: column("Beyond", f"1.028 x, {name} fitted, %", 1e2) for name in ("disparity", "depth")}
METRICS: tuple[Metric, ...] = (
    _alone("EvalMDE_SAWA_H", sawa_h, format=column("SAWA-H", "", digits=3)),
    _alone("EvalMDE_RelNormal", rel_normal, format=column("RelNormal", "rad", digits=3)),
    _alone("EvalMDE_WKDR", wkdr, format=column("WKDR", "%", 1e2, 2)),
    *of_parts("EvalMDE_beyond_", beyond, target_mask, _fitted, min_size=MIN_SIZE, whole=True),
    _alone("EvalMDE_boundary", boundary_error, format=column("1 - F1", "Depth Pro, %", 1e2)),
    _alone("EvalMDE_covered", covered, format=column("Covered", "%", 1e2, higher_is_better=True)),
)
