"""Metrics of depth boundaries and planes: Depth Pro's and MoGe's boundary F1, and the geometric errors of iBims-1.

An edge is a pair of pixels whose depths have a ratio above a threshold, found if the predicted ratio is above it, too.

- Depth Pro (Bochkovskii et al., ICLR 2025; apple/ml-depth-pro 9efe5c1): neighbours in a row or column; precision and
  recall are means over four directions, and a direction without edges counts 0. So a truth may score less than 1.
- MoGe (Wang et al., *MoGe-2*, 2025; microsoft/MoGe 0744441): pixels up to a radius apart in any direction, counted
  together, without a border of the radius. Its weights of thresholds are Depth Pro's less 1.
- iBims-1 (Koch et al., ECCV Workshops 2018; its Python v0.9, in bulatko/DepthART b2bc093).

Unknown truth is left out of both maps. Holes of a prediction have no edges, so ``Boundary_covered`` belongs to scores.
"""

import itertools
import math
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dsr.metrics.depth import covered
from dsr.metrics.formats import BEFORE_THE_PAPER, Metric, MetricFormat, column, depth_mask, of_parts, target_mask
from dsr.metrics.functional import SurfacePair, masked_mean, masked_median, once_per_pair
from dsr.utils.compute_device import in_own_precision

RATIOS = tuple(np.linspace(1.05, 1.25, 10).tolist())  # Depth Pro's thresholds, which are their own weights
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
    """Return how many ratios (B, ...) are above each of :data:`RATIOS`, (B, 3, T): in one map, the other, both."""
    images, steps = len(first), len(RATIOS) + 1
    first, second = first.flatten(1), second.flatten(1)
    image, place = ((first > RATIOS[0]) | (second > RATIOS[0])).nonzero(as_tuple=True)  # the others are above none
    thresholds = torch.tensor(RATIOS, dtype=first.dtype, device=first.device)
    levels = [torch.bucketize(ratios[image, place].nan_to_num(0), thresholds) for ratios in (first, second)]
    levels.append(torch.minimum(*levels))
    counts = [(image * steps + level).bincount(minlength=images * steps).view(images, steps) for level in levels]
    return torch.stack(counts, dim=1).flip(2).cumsum(2).flip(2)[..., 1:]


@once_per_pair
def depth_pro_scores(pair: SurfacePair) -> dict[str, Tensor]:
    """Return Depth Pro's boundary F1, and its ceiling, the truth's own, by name, (B,) each, fractions."""
    maps, counts = known_maps(pair), []
    for dim in (-1, -2):
        size = pair.target.shape[dim] - 1
        forwards = [each.narrow(dim, 1, size) / each.narrow(dim, 0, size) for each in maps]
        backwards = [each.narrow(dim, 0, size) / each.narrow(dim, 1, size) for each in maps]
        counts += [count_edges(*forwards), count_edges(*backwards)]
    predicted, true, both = torch.stack(counts, dim=1).double().unbind(2)  # (B, 4, T)
    recall = (both / true.clamp(min=1)).mean(dim=1)
    precision = (both / predicted.clamp(min=1)).mean(dim=1)
    f1 = 2 * recall * precision / (recall + precision).clamp(min=torch.finfo(torch.float64).tiny)
    ceiling = (true > 0).double().mean(dim=1)
    return {"F1": _over_thresholds(f1, 0, pair), "ceiling": _over_thresholds(ceiling, 0, pair)}


@once_per_pair
def moge_scores(pair: SurfacePair) -> dict[str, Tensor]:
    """Return MoGe's boundary F1 by the largest distance of two pixels, (B,) each, fractions, 0 without a true edge."""
    maps, found = known_maps(pair), {}
    for radius in (1, 2, 3):
        height, width = (size - 2 * radius for size in pair.target.shape[-2:])
        inner = [each[..., radius : radius + height, radius : radius + width] for each in maps]
        counts = []
        for v, u in itertools.product(range(2 * radius + 1), repeat=2):
            if 0 < math.hypot(v - radius, u - radius) <= radius:
                beside = (each[..., v : v + height, u : u + width] for each in maps)
                counts.append(count_edges(*(near / own for near, own in zip(beside, inner, strict=True))))
        predicted, true, both = torch.stack(counts).sum(dim=0).double().unbind(1)
        found[str(radius)] = _over_thresholds(2 * both / (predicted + true).clamp(min=1), 1, pair)
    return found


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

    The accuracy is the mean distance, or a quantile, of found boundaries to true ones, (B, 1, H, W) bool, of those less
    than :data:`DBE_RANGE` away; the completeness that of true boundaries to found ones, without limit. Both are that
    range where no boundary is found within it, and NaN without true ones.
    """
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - as above

    average = np.mean if quantile is None else partial(np.quantile, q=quantile)
    errors = torch.full((2, len(true)), torch.nan, dtype=torch.float64)
    for i, (mine, theirs) in enumerate(zip(found[:, 0].cpu().numpy(), true[:, 0].cpu().numpy(), strict=True)):
        if not theirs.any():
            continue
        distance = distance_transform_edt(~theirs)
        near = mine & (distance < DBE_RANGE)
        errors[:, i] = DBE_RANGE
        if near.any():
            errors[0, i] = float(average(distance[near]))
            errors[1, i] = float(average(distance_transform_edt(~mine)[theirs]))
    accuracy, completeness = errors.to(true.device)
    return accuracy, completeness


@once_per_pair
def boundary_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the errors to the annotated boundaries, without a mask, as iBims-1; else to the truth's own, (B,) each."""
    prediction, target = known_maps(pair)
    edges = pair.regions.get(EDGES, torch.zeros_like(target)) > 0
    band = avg_pool2d(edges.float(), _BAND, stride=1, padding=_BAND // 2) > 1 - 1e-3
    annotated = (edges.flatten(1).any(dim=1) & ~band.flatten(1).any(dim=1)).view(-1, 1, 1, 1)
    given = pair.given[0].where((pair.given[0] > 0) & pair.given[0].isfinite(), torch.nan)
    found = depth_boundaries(torch.where(annotated, given, prediction))
    true = torch.where(annotated, edges, depth_boundaries(target))
    return dict(zip(("accuracy", "completeness"), depth_boundary_error(found, true), strict=True))


@once_per_pair
def directed_depth_error(pair: SurfacePair) -> dict[str, Tensor]:
    """Return iBims-1's directed depth error about a plane at 3 m: fractions right, before and beyond it, (B,) each."""
    before, truly = pair.prediction <= DDE_PLANE, pair.target <= DDE_PLANE
    parts = {"right": before == truly, "before": before & ~truly, "beyond": ~before & truly}
    return {name: masked_mean(part, pair.depth_mask).squeeze(1) for name, part in parts.items()}


@once_per_pair
def planarity(pair: SurfacePair) -> dict[str, Tensor]:
    """Return iBims-1's planarity errors, means over the large planes of the region ``planes``, (B,) each.

    The prediction is scaled by the ratio of the median depths in a plane. Flatness is the standard deviation of the
    predicted points about their plane in metres, orientation the angle between both normals in degrees.
    """
    numbers = pair.regions[PLANES]
    errors, large = [], []
    for number in range(1, max(int(numbers.max()), 1) + 1):
        plane = numbers == number
        mask = plane & pair.depth_mask
        factor = masked_median(pair.target, mask) / masked_median(pair.prediction, mask)
        spread, normal = _fit_plane(pair.prediction * factor * pair.rays, mask)
        _, true = _fit_plane(pair.target * pair.rays, mask)
        angle = torch.atan2(torch.linalg.cross(normal, true).norm(dim=1), (normal * true).sum(dim=1).abs())
        both = torch.stack((spread, angle.rad2deg())).where(mask.flatten(1).any(dim=1), torch.nan)
        large.append(plane.double().mean(dim=(1, 2, 3)) >= PLANE_SHARE)
        errors.append(both.where(large[-1], 0))
    flatness, orientation = torch.stack(errors, dim=2).sum(dim=2) / torch.stack(large).sum(dim=0)
    return {"flatness": flatness, "orientation": orientation}


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


_F1 = partial(MetricFormat, "F1", factor=1e2, digits=1, higher_is_better=True, position=BEFORE_THE_PAPER)
_depth_pro = {"F1": _F1("Depth Pro, %"), "ceiling": _F1("of the truth, %")}
_moge = {"1": _F1("MoGe, 1 px, %"), "2": _F1("MoGe, 2 px, %", position=None), "3": _F1("MoGe, 3 px, %", position=None)}
_coverage = partial(column, factor=1e2, higher_is_better=True)
_whole, _parts = partial(Metric, whole=True), partial(of_parts, whole=True)
_boundary = {name: column("DBE", f"{name}, px") for name in ("accuracy", "completeness")}
_directed = {
    name: MetricFormat("DDE", f"3 m, {name}, %", 1e2, 1, higher_is_better=name == "right", position=None)
    for name in ("right", "before", "beyond")
}
_planes = {"flatness": column("PE", "flatness, mm", 1e3), "orientation": column("PE", "orientation, deg")}
METRICS: tuple[Metric, ...] = (
    *_parts("DepthPro_", depth_pro_scores, target_mask, _depth_pro),
    *_parts("MoGe_F1_", moge_scores, target_mask, _moge, min_size=7),
    *_parts("DBE_", boundary_errors, target_mask, _boundary, min_size=3),
    *_parts("DDE_", directed_depth_error, depth_mask, _directed, min_size=1),
    *_parts("PE_", planarity, depth_mask, _planes, min_size=3, region=PLANES),
    _whole("PE_covered", covered, target_mask, _coverage("PE", "covered, %"), min_size=1, region=PLANES),
    _whole("Boundary_covered", covered, target_mask, _coverage("Covered", "%"), min_size=1),
)
