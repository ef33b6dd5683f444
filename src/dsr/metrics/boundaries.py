"""Metrics of depth boundaries and planes: Depth Pro's and MoGe's boundary F1, and the geometric errors of iBims-1.

An edge is a pair of pixels whose depths have a ratio above a threshold; a prediction has found it where its own ratio
of the same two pixels is above the same threshold. This is scale-invariant and has no tolerance in place.

- Depth Pro (Bochkovskii et al., *Depth Pro: Sharp Monocular Metric Depth in Less Than a Second*, ICLR 2025; apple/
  ml-depth-pro 9efe5c1, ``src/depth_pro/eval/boundary_metrics.py``): neighbours in a row or column, thresholds 1.05 to
  1.25; precision and recall are means over four directions, and a direction without edges counts 0. So a truth may
  score less than 1 against itself; ``DepthPro_ceiling`` is that score.
- MoGe (Wang et al., *MoGe-2*, 2025; microsoft/MoGe 0744441, ``moge/test/metrics.py``): pixels up to a radius
  apart in any direction, counted together, a border of the radius left out. Its code has the names of precision and
  recall the wrong way round, which F1 does not see, and weights thresholds by 0.05 to 0.25 where Depth Pro has 1.05 to
  1.25.
- iBims-1 (Koch et al., *Evaluation of CNN-based Single-Image Depth Estimation Methods*, ECCV Workshops 2018; its Python
  v0.9, in bulatko/DepthART b2bc093, ``mde/capsules/meter/ibims_official/evaluate_ibims_error_metrics.py``): depth
  boundary error, to annotated boundaries where a scene has them; directed depth error, planarity error.

Unknown truth is left out of both maps. A prediction has no edges at its holes: true edges there are missed, but false
ones cannot be there, and the directed errors leave holes out as their authors do. Therefore the fraction of the true
pixels that have a prediction, ``Boundary_covered``, belongs to every score.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dsr.metrics.depth import covered
from dsr.metrics.formats import BEFORE_THE_PAPER, MetricFormat, column
from dsr.metrics.functional import SurfacePair, masked_mean, masked_median, once_per_pair
from dsr.metrics.metric import Metric, depth_mask, part_of, target_mask
from dsr.utils.compute_device import in_own_precision

# Depth Pro's thresholds, which are their own weights; MoGe's weights are 1 less
RATIOS = tuple(np.linspace(1.05, 1.25, 10).tolist())
DBE_RANGE = 10.0  # pixels; predicted boundaries further from a true one are no boundaries of it
DDE_PLANE = 3.0  # metres from the camera to the plane that the directed depth error is about
EDGES = "edges"  # the region with annotated depth boundaries, see `dsr.sample.Scene`; a band about outlines is none
_BAND = 5  # width and height in pixels of squares that a band has and lines have not
PLANES = "planes"  # the region with numbered planes, see `dsr.sample.Scene`
PLANE_SHARE = 0.05  # smaller planes, as a fraction of the image, have no planarity error


@once_per_pair
def known_maps(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the prediction and the truth with NaN where the truth is unknown, and in holes, (B, 1, H, W) each."""
    prediction, target = pair.given
    return torch.where(pair.depth_mask, prediction, torch.nan), torch.where(pair.target_mask, target, torch.nan)


def count_edges(first: Tensor, second: Tensor) -> Tensor:
    """Return how many ratios are above each of :data:`RATIOS`, (B, 3, T): in the first map, in the second, in both.

    The two (B, ...) are ratios of the same pairs of pixels in two maps; NaN is below.
    """
    images, steps = len(first), len(RATIOS) + 1
    first, second = first.flatten(1), second.flatten(1)
    image, place = ((first > RATIOS[0]) | (second > RATIOS[0])).nonzero(as_tuple=True)  # the others are above none
    thresholds = torch.tensor(RATIOS, dtype=first.dtype, device=first.device)
    levels = [torch.bucketize(ratios[image, place].nan_to_num(0), thresholds) for ratios in (first, second)]
    levels.append(torch.minimum(*levels))
    counts = [(image * steps + level).bincount(minlength=images * steps).view(images, steps) for level in levels]
    return torch.stack(counts, dim=1).flip(2).cumsum(2).flip(2)[..., 1:]


@once_per_pair
def boundary_counts(pair: SurfacePair) -> Tensor:
    """Return the counts of Depth Pro's edges, (B, 4, 3, T): for each direction as :func:`count_edges` has them."""
    prediction, target = known_maps(pair)
    counts = []
    for here, beside in (
        ((..., slice(1, None)), (..., slice(-1))),
        ((..., slice(-1)), (..., slice(1, None))),
        ((..., slice(1, None), slice(None)), (..., slice(-1), slice(None))),
        ((..., slice(-1), slice(None)), (..., slice(1, None), slice(None))),
    ):
        counts.append(count_edges(prediction[here] / prediction[beside], target[here] / target[beside]))
    return torch.stack(counts, dim=1)


def boundary_f1(pair: SurfacePair) -> Tensor:
    """Return Depth Pro's scale-invariant boundary F1, (B,), a fraction, higher is better."""
    predicted, true, both = boundary_counts(pair).double().unbind(2)
    recall, precision = ((both / each.clamp(min=1)).mean(dim=1) for each in (true, predicted))
    f1 = 2 * recall * precision / (recall + precision).clamp(min=torch.finfo(torch.float64).tiny)
    return _over_thresholds(f1, 0, pair)


def boundary_ceiling(pair: SurfacePair) -> Tensor:
    """Return :func:`boundary_f1` of the truth against itself, (B,): the fraction of directions that have edges."""
    true = boundary_counts(pair)[:, :, 1]
    return _over_thresholds((true > 0).double().mean(dim=1), 0, pair)


def moge_f1(pair: SurfacePair, radius: int = 1) -> Tensor:
    """Return MoGe's boundary F1, (B,), a fraction, higher is better; without any true edge it is 0, as theirs is.

    Two pixels are at most ``radius`` apart, 1, 2 or 3 in their tables; the maps are larger than twice that. MoGe fits
    the prediction to the truth first by a factor, which changes nothing, or by a factor and an offset, which is up to
    the caller.
    """
    height, width = (size - 2 * radius for size in pair.target.shape[-2:])
    span = range(2 * radius + 1)
    near = [(v, u) for v in span for u in span if 0 < math.hypot(v - radius, u - radius) <= radius]
    maps = known_maps(pair)
    inner = [each[..., radius : radius + height, radius : radius + width] for each in maps]
    counts = []
    for v, u in near:
        ratios = (each[..., v : v + height, u : u + width] / own for each, own in zip(maps, inner, strict=True))
        counts.append(count_edges(*ratios))
    predicted, true, both = torch.stack(counts).sum(dim=0).double().unbind(1)
    return _over_thresholds(2 * both / (predicted + true).clamp(min=1), 1, pair)


def depth_boundaries(depth: Tensor) -> Tensor:
    """Return the boundaries of a depth map as iBims-1 finds them in a prediction, (B, 1, H, W) bool.

    A Canny filter (sigma sqrt 2, thresholds 0.1 and 0.2, scikit-image's) of the map between its own smallest and
    largest depth. Holes, NaN, have none, nor has what the filter's Gaussian reaches from them.
    """
    from skimage.feature import canny  # noqa: PLC0415 - it takes a third of a second to import

    found = torch.zeros(depth.shape, dtype=torch.bool)
    for image, each in zip(found[:, 0], depth.detach()[:, 0].cpu().float().numpy(), strict=True):
        if np.isfinite(each).any():
            shifted = each - np.nanmin(each)
            with np.errstate(invalid="ignore"):
                scaled = shifted / np.nanmax(shifted)  # as they have it, in 32 bits
            image[:] = torch.from_numpy(canny(scaled, math.sqrt(2), 0.1, 0.2))
    return found.to(depth.device)


def depth_boundary_error(found: Tensor, true: Tensor, quantile: float | None = None) -> tuple[Tensor, Tensor]:
    """Return iBims-1's accuracy and completeness of depth boundaries, (B,) float64 each, in pixels, lower is better.

    The accuracy is the mean distance of found boundaries to true ones, (B, 1, H, W) bool, of those less than
    :data:`DBE_RANGE` away; the completeness that of true boundaries to found ones, without limit. Both are that range
    where no boundary is found within it, and NaN without true ones. Others' copies limit the completeness, too, or use
    thresholds of .15 and .3. A ``quantile`` of the distances may take the place of their mean.
    """
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - as above

    errors = torch.full((2, len(true)), torch.nan, dtype=torch.float64)
    for i, (mine, theirs) in enumerate(zip(found[:, 0].cpu().numpy(), true[:, 0].cpu().numpy(), strict=True)):
        if theirs.any():
            distance = distance_transform_edt(~theirs)
            near = mine & (distance < DBE_RANGE)
            both = (distance[near], distance_transform_edt(~mine)[theirs]) if near.any() else ([DBE_RANGE],) * 2
            of_both = [np.mean(each) if quantile is None else np.quantile(each, quantile) for each in both]
            errors[:, i] = torch.tensor(of_both, dtype=torch.float64)
    accuracy, completeness = errors.to(true.device)
    return accuracy, completeness


def directed_depth_error(pair: SurfacePair, plane: float = DDE_PLANE) -> tuple[Tensor, ...]:
    """Return iBims-1's directed depth error about a plane at a depth in metres, three fractions of pixels, (B,) each.

    They are on the right side, in front of it though the truth is not, and beyond it though the truth is not. Their
    code overwrites depths by 0 and 1 before it has compared all of them, so that planes nearer than 1 m came out wrong.
    """
    before, truly = pair.prediction <= plane, pair.target <= plane
    parts = (before == truly, before & ~truly, ~before & truly)
    return tuple(masked_mean(part, pair.depth_mask).squeeze(1) for part in parts)


def planarity(
    pair: SurfacePair, planes: Tensor, normals: Tensor | None = None, smallest: float = PLANE_SHARE
) -> tuple[Tensor, Tensor]:
    """Return iBims-1's planarity errors of each plane, (B, P) each, lower is better.

    The prediction is scaled by the ratio of the two median depths in the plane, and a plane is fitted to its points.
    An image's error is the mean over its planes (``nanmean``).

    Planes are (B, P, H, W) bool; true normals, (B, P, 3) of either sign, x right, y down, z forward, or None for those
    of the truth's points, fitted alike. iBims-1's are x right, y forward, z up: (x, y, z) is (x, -z, y) here. Planes
    with less than the fraction ``smallest`` of the image's pixels get NaN, and so does one without a prediction.

    Returns the flatness, the standard deviation of the points about their plane in metres, and the orientation, the
    angle between its normal and the true one in degrees.
    """
    images, _, height, width = pair.target.shape
    if planes.dim() != 4 or planes.dtype != torch.bool or planes[:, :1].shape != pair.target.shape:
        came = f"{planes.dtype} {tuple(planes.shape)}"
        raise ValueError(f"planes: expected bool of shape ({images}, P, {height}, {width}), got {came}")
    if normals is not None and normals.shape != (*planes.shape[:2], 3):
        raise ValueError(f"normals: expected shape {(*planes.shape[:2], 3)}, got {tuple(normals.shape)}")
    flatness, orientation = [], []
    for index in range(planes.shape[1]):
        mask = planes[:, index : index + 1] & pair.depth_mask
        factor = masked_median(pair.target, mask) / masked_median(pair.prediction, mask)
        spread, normal = _fit_plane(pair.prediction * factor * pair.rays, mask)
        true = _fit_plane(pair.target * pair.rays, mask)[1] if normals is None else normals[:, index].to(normal)
        angle = torch.atan2(torch.linalg.cross(normal, true).norm(dim=1), (normal * true).sum(dim=1).abs())
        large = (planes[:, index].double().mean(dim=(1, 2)) >= smallest) & mask.flatten(1).any(dim=1)
        flatness.append(torch.where(large, spread, torch.nan))
        orientation.append(torch.where(large, angle.rad2deg(), torch.nan))
    return torch.stack(flatness, dim=1), torch.stack(orientation, dim=1)


def _over_thresholds(scores: Tensor, less: float, pair: SurfacePair) -> Tensor:
    """Return the mean of (B, T) weighted by the thresholds less something, (B,); NaN for an image without a truth."""
    weights = torch.tensor(RATIOS, dtype=scores.dtype, device=scores.device) - less
    return torch.where(pair.target_mask.flatten(1).any(dim=1), scores @ (weights / weights.sum()), torch.nan)


@in_own_precision
def _fit_plane(points: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Return the standard deviation of points (B, 3, H, W) about their plane, (B,), and its normal, (B, 3)."""
    weights = mask.to(points).flatten(2)
    weights = weights / weights.sum(dim=2, keepdim=True).clamp(min=1)
    centred = torch.where(mask, points, 0).flatten(2)
    centred = centred - (centred * weights).sum(dim=2, keepdim=True)
    values, vectors = torch.linalg.eigh((centred * weights) @ centred.mT)
    return values[:, 0].clamp(min=0).sqrt(), vectors[..., 0]


@once_per_pair
def _boundary_errors(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the errors to the annotated boundaries, without a mask, as iBims-1; else to the truth's own."""
    prediction, target = known_maps(pair)
    edges = pair.regions.get(EDGES, torch.zeros_like(target)) > 0
    band = avg_pool2d(edges.float(), _BAND, stride=1, padding=_BAND // 2) > 1 - 1e-3
    annotated = (edges.flatten(1).any(dim=1) & ~band.flatten(1).any(dim=1)).view(-1, 1, 1, 1)
    given = pair.given[0].where((pair.given[0] > 0) & pair.given[0].isfinite(), torch.nan)
    found = depth_boundaries(torch.where(annotated, given, prediction))
    return depth_boundary_error(found, torch.where(annotated, edges, depth_boundaries(target)))


@once_per_pair
def _planarity(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the planarity errors, means over the large planes of the region ``planes``, (B,) each.

    NaN if one of them has no prediction.
    """
    numbers = pair.regions[PLANES]
    count = max(int(numbers.max()), 1)
    planes = numbers == torch.arange(1, count + 1, dtype=numbers.dtype, device=numbers.device).view(1, -1, 1, 1)
    large = planes.double().mean(dim=(2, 3)) >= PLANE_SHARE
    flatness, orientation = (
        torch.where(large, each, 0).sum(dim=1) / large.sum(dim=1) for each in planarity(pair, planes)
    )
    return flatness, orientation


_whole = partial(Metric, whole=True)
_shown = partial(column, higher_is_better=True)
METRICS: tuple[Metric, ...] = (
    _whole("DepthPro_F1", boundary_f1, target_mask, _shown("F1", "Depth Pro, %", 1e2)),
    _whole("DepthPro_ceiling", boundary_ceiling, target_mask, _shown("F1", "of the truth, %", 1e2)),
    *(
        _whole(
            f"MoGe_F1_{radius}",
            partial(moge_f1, radius=radius),
            target_mask,
            replace(_shown("F1", f"MoGe, {radius} px, %", 1e2), position=BEFORE_THE_PAPER if radius == 1 else None),
            min_size=7,
        )
        for radius in (1, 2, 3)
    ),
    *(
        _whole(
            f"DBE_{name}",
            partial(part_of, function=_boundary_errors, part=part),
            target_mask,
            column("DBE", f"{name}, px"),
            min_size=3,
        )
        for part, name in enumerate(("accuracy", "completeness"))
    ),
    *(
        _whole(
            f"DDE_{name}",
            partial(part_of, function=directed_depth_error, part=part),
            depth_mask,
            MetricFormat("DDE", f"3 m, {name}, %", 1e2, 1, higher_is_better=part == 0, position=None),
            min_size=1,
        )
        for part, name in enumerate(("right", "before", "beyond"))
    ),
    *(
        _whole(
            f"PE_{name}",
            partial(part_of, function=_planarity, part=part),
            depth_mask,
            column("PE", f"{name}, {unit}", factor),
            min_size=3,
            region=PLANES,
        )
        for part, (name, unit, factor) in enumerate((("flatness", "mm", 1e3), ("orientation", "deg", 1)))
    ),
    _whole("PE_covered", covered, target_mask, _shown("PE", "covered, %", 1e2), min_size=1, region=PLANES),
    _whole("Boundary_covered", covered, target_mask, _shown("Covered", "%", 1e2), min_size=1),
)
