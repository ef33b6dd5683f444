"""Whether a method makes what a sensor measured worse, and errors of distances between points.

The measured pixels are those whose true depth and whose nearest pixel of the low-resolution map are known. A map of
another size than the photo's is enlarged as :mod:`dsr.geometry.resampling` does, so that planes stay planes. Near,
middle and far are thirds of an image's measured pixels by true depth, of equal numbers of pixels, so that each scene
has all three. The measurement itself as the prediction gives 0 for each share and 1 for each ratio.

RE and delta are those of Pumpire (2026): for two pixels with the true distance D between their points in space and the
predicted distance d, RE is |d - D| / D, and delta 1.05 the fraction of pairs with max(d / D, D / d) < 1.05. Pumpire has
pairs measured by tape; here :data:`PAIRS` pairs are drawn from the pixels with a true depth, see :func:`draw_pairs`.
"""

import math
from functools import partial

import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.geometry.resampling import resize_inverse_depth
from dsr.geometry.surface import length
from dsr.metrics.formats import Metric, column, depth_mask, of_parts
from dsr.metrics.functional import SurfacePair, masked_mean, masked_median, once_per_pair

CHANGE = 0.003  # metres by which an error has to grow or shrink to count
PAIRS = 2**16  # pairs of pixels
DELTA = 1.05
_DEVIATION = 1.4826  # standard deviation of a Gaussian over its median absolute value
_PLASTIC = 1.324717957244746  # its inverse powers give the evenest sequence of points in the square (Roberts 2018)
_UNIT = 2**31  # of fractions that are kept as whole numbers, which are exact on every device


def enlarge(measured: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a map, (1, h, w) in metres, at the photo's size; a pixel whose nearest one is a hole is a hole."""
    if tuple(measured.shape[-2:]) == size:
        return measured
    holes = ~measured.isfinite()
    nearest = ndimage.distance_transform_edt(holes[0].cpu().numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(nearest).to(measured.device)
    enlarged = resize_inverse_depth(measured[:, rows, columns].reciprocal(), size).reciprocal()
    holes = functional.interpolate(holes[None].float(), size, mode="nearest-exact")[0] > 0
    return enlarged.masked_fill(holes, torch.nan)


def measured_mask(pair: SurfacePair) -> Tensor:
    """Return the pixels with a measured, a true and a predicted depth, (B, 1, H, W) bool."""
    return pair.depth_mask & _measured(pair)


@once_per_pair
def compare_to_measured(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the comparison of a prediction with the measurement by name, (B,) each: shares, and ratios of mean errors.

    ``worse_noise`` is of pixels whose error grows by more than the noise: in each third, the standard deviation of the
    measurement's error by its median absolute deviation.
    """
    assert pair.measured is not None  # noqa: S101 - the metrics apply
    prediction, target = pair.given
    mask, there = measured_mask(pair), _measured(pair) & pair.target_mask
    offset = torch.where(there, pair.measured - target, 0)
    before, after = offset.abs(), torch.where(mask, prediction - target, 0).abs()
    noise, ratios = torch.zeros_like(before), {}
    for name, third in zip(("near", "middle", "far"), _thirds(target, there), strict=True):
        spread = masked_median((offset - masked_median(offset, third)).abs(), third)
        noise = torch.where(third, _DEVIATION * spread, noise)
        ratios[name] = masked_mean(after, third & mask) / masked_mean(before, third & mask)
    known = torch.stack([each.nan_to_num(nan=-math.inf) for each in ratios.values()]).amax(dim=0)
    found = {
        "worse_3mm": masked_mean(after > before + CHANGE, mask),
        "worse_noise": masked_mean(after > before + noise, mask),
        "better_3mm": masked_mean(after < before - CHANGE, mask),
        "ratio": masked_mean(after, mask) / masked_mean(before, mask),
        **ratios,
        "worst": known.masked_fill(known == -math.inf, torch.nan),
        "covered": masked_mean(mask, there),
    }
    return {name: value.squeeze(1) for name, value in found.items()}


def draw_pairs(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return pairs of pixels of a mask, (B, 1, H, W), as two flat indices, (B, PAIRS); the same for every method.

    Pair n has the mask's pixels number floor(N frac(1 / 2 + n / p)) and floor(N frac(1 / 2 + n / p^2)) in reading
    order, where N is their number and p the plastic number. Of an empty mask, the indices mean nothing.
    """
    pixels = mask.flatten(1).to(torch.uint8).sort(dim=1, descending=True, stable=True).indices
    count, numbers = mask.flatten(1).sum(dim=1, keepdim=True), torch.arange(PAIRS, device=mask.device)
    fractions = [(numbers * round(_UNIT / _PLASTIC**power) + _UNIT // 2) % _UNIT for power in (1, 2)]
    first, second = (pixels.gather(1, each * count // _UNIT) for each in fractions)
    return first, second


@once_per_pair
def pair_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return RE and delta 1.05 of the distances between points, (B,) each; pairs with a hole do not count."""
    prediction, target = pair.given
    ends = draw_pairs(pair.target_mask)
    own, true = (_distances(depth * pair.rays, ends) for depth in (prediction, target))
    known = own.isfinite() & (true > 0)
    error, quotient = (own - true).abs() / true, torch.maximum(own / true, true / own)
    found = {"RE": error, "delta_105": (quotient < DELTA).to(error)}
    return {name: masked_mean(each, known).squeeze(1) for name, each in found.items()}


def _distances(points: Tensor, ends: tuple[Tensor, Tensor]) -> Tensor:
    """Return the distances of pairs of pixels of points, (B, 3, H, W), as (B, 1, 1, PAIRS)."""
    first, second = (points.flatten(2).gather(2, each[:, None].expand(-1, 3, -1)) for each in ends)
    return length((first - second)[:, :, None])


def _measured(pair: SurfacePair) -> Tensor:
    assert pair.measured is not None  # noqa: S101 - the metrics apply
    return pair.measured.isfinite() & (pair.measured > 0)


def _thirds(depth: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the near, the middle and the far third of a mask's pixels, (B, 1, H, W) bool each."""
    ordered = depth.masked_fill(~mask, torch.inf).flatten(1).sort(dim=1).values
    count = mask.flatten(1).sum(dim=1, keepdim=True)
    first, second = (ordered.gather(1, (part * count // 3 - 1).clamp(min=0))[..., None, None] for part in (1, 2))
    near, far = mask & (depth <= first), mask & (depth > second)
    return near, mask & ~near & ~far, far


_harm = partial(
    of_parts, "Harm_", compare_to_measured, measured_mask, min_size=1, stated="measured", unit="cm", whole=True
)
_pairs = partial(of_parts, "Pairs_", pair_errors, depth_mask, min_size=1, unit="cm", whole=True)
METRICS: tuple[Metric, ...] = (
    *_harm({"worse_3mm": column("Worse", "by 3 mm, %", 1e2), "worse_noise": column("Worse", "by the noise, %", 1e2)}),
    *_harm({"better_3mm": column("Better", "by 3 mm, %", 1e2, higher_is_better=True)}),
    *_harm({"ratio": column("Error", "of measured", digits=2)}),
    *_harm({name: column("Error", f"{name} third", digits=2) for name in ("near", "middle", "far", "worst")}),
    *_harm({"covered": column("Covered", "measured, %", 1e2, higher_is_better=True)}),
    *_pairs({"RE": column("RE", "pairs, %", 1e2)}),
    *_pairs({"delta_105": column("delta 1.05", "pairs, %", 1e2, higher_is_better=True)}),
)
