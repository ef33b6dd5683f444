"""The catalogue of metrics, and the scores of all of them for a pair of depth maps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import NamedTuple

import torch
from torch import Tensor

from dsr.metrics import boundaries, calibration, depth, evalmde, functional, harm, sensor
from dsr.metrics.formats import Metric, MetricFormat, depth_mask, normal_mask
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS, MIN_SIZE, lpips_v
from dsr.sample import CENTIMETRES, Unit

__all__ = ["KNOWN_FORMATS", "PROTOCOLS", "Metric", "Score", "catalogue", "depth_mask", "normal_mask", "score_image"]


def _bad_pixels(percent: int, unit: str, shown: str, position: int | None = None) -> Metric:
    """Return BadPix_d of a threshold in centimetres, or in per cent of depth."""
    function = partial(functional.bad_pix_d, threshold=percent / 100, relative=unit == "pct")
    form = MetricFormat("BadPix_d", f"{percent} {shown}, %", 1e2, 2, position=position)
    return Metric(f"BadPix_d_{percent}{unit}", function, depth_mask, form, min_size=1)


_by_light = partial(Metric, per_light=True)
_visual = partial(MetricFormat, unit="1/1000", factor=1e3, digits=0)
_bump = MetricFormat("Bump_d", digits=2, position=6)
_windows, _curvatures = attrgetter("ssim_mask"), attrgetter("bumpiness_mask")
# the paper's metrics in the order of scores.csv; those with a position are the columns of its tables
METRICS: tuple[Metric, ...] = (
    Metric("RMSE_d", functional.rmse_d, depth_mask, MetricFormat("RMSE_d", "mm", 1e3, 1, position=1), min_size=1),
    *(_bad_pixels(percent, "cm", "cm", 2 if percent == 5 else None) for percent in (1, 5, 10)),
    *(_bad_pixels(percent, "pct", "% of depth") for percent in (1, 5, 10)),
    *(
        _by_light(
            f"BadPix_v_{level}",
            partial(functional.bad_pix_v, threshold=level),
            normal_mask,
            MetricFormat("BadPix_v", f"{level}, %", 1e2, 1, position=3 if level == 5 else None),
        )
        for level in (1, 5, 10)
    ),
    _by_light("DSSIM_v", functional.dssim_v, _windows, _visual("DSSIM_v", position=4), min_size=functional.SSIM_WINDOW),
    _by_light("LPIPS_v", lpips_v, normal_mask, _visual("LPIPS_v", position=5), min_size=MIN_SIZE, perceptual=True),
    Metric("RMSE_v", functional.rmse_v, normal_mask, _visual("RMSE_v", position=7)),
    _by_light("RMSE_v1", functional.rmse_v1, normal_mask, _visual("RMSE_v1", position=None)),
    Metric("Bumpiness_d", functional.bumpiness_d, _curvatures, _bump, min_size=3),
)


_FAMILIES: Mapping[str, Sequence[Metric]] = {  # each with a table of its own
    "depth": depth.DEPTH,
    "normals": depth.NORMALS,
    "points": depth.POINTS,
    "evalmde": evalmde.METRICS,
    "boundaries": boundaries.METRICS,
    "calibration": calibration.METRICS,
    "plane": sensor.PLANE,
    "harm": harm.METRICS,
}
PROTOCOLS: Mapping[str, tuple[Metric, ...]] = {
    "paper": METRICS,
    "field": depth.FIELD,
    "sensor": sensor.SENSOR,
    **{
        name: tuple(replace(metric, format=replace(metric.format, family=name)) for metric in metrics)
        for name, metrics in _FAMILIES.items()
    },
}
KNOWN_FORMATS = {metric.name: metric.format for metric in METRICS}


def catalogue(
    network: LPIPS | None = None,
    extra: Sequence[Metric] = (),
    protocols: Sequence[str] = ("paper",),
    regions: Sequence[str] = (),
) -> tuple[Metric, ...]:
    """Return the metrics that can be computed: those of some protocols, then ``extra``.

    Perceptual metrics need the network. For each region, the columns of tables that are means over pixels follow again.
    """
    if not protocols or not set(protocols) <= set(PROTOCOLS):
        raise ValueError(f"protocols: expected some of {', '.join(PROTOCOLS)}, got {', '.join(protocols) or 'none'}")
    metrics = [*(metric for name in dict.fromkeys(protocols) for metric in PROTOCOLS[name]), *extra]
    metrics += [each.within(region) for region in regions for each in metrics if each.in_regions]
    found: dict[str, Metric] = {}
    for metric in metrics:
        if metric.name in found:
            raise ValueError(f"{metric.name}: expected metrics of different names, got two of this one")
        bound = partial(metric.function, network=network) if metric.perceptual else metric.function
        found[metric.name] = replace(metric, function=bound)
    return tuple(metric for metric in found.values() if network is not None or not metric.perceptual)


class Score(NamedTuple):
    """One row of ``scores.csv``: a metric's value for one image, and the valid fraction of the pixels that it uses."""

    metric: str
    variant: str
    value: float
    valid_share: float


@torch.no_grad()
def score_image(
    prediction: Tensor,
    target: Tensor,
    rays: Tensor,
    metrics: tuple[Metric, ...],
    unit: Unit = CENTIMETRES,
    *,
    regions: Mapping[str, Tensor] | None = None,
    errors: tuple[Tensor, Tensor] | None = None,
    measured: Tensor | None = None,
) -> Iterator[Score]:
    """Score one predicted depth map; NaN where no pixel can be scored.

    Both maps are (1, H, W) orthogonal depth in metres, NaN where missing, the rays (3, H, W), regions (1, H, W) uint8,
    ``errors`` the method's expected errors, (1, H, W): of depth in metres, of normals in degrees, and ``measured`` the
    low-resolution map, (1, h, w). Metrics for other units, or of what is absent, are left out.
    """
    needed = any(each.stated == "measured" for each in metrics)
    measured = None if measured is None or not needed else harm.enlarge(measured, (target.shape[-2], target.shape[-1]))

    def pair_of(*window: slice) -> SurfacePair:
        at = (None, slice(None), *window)
        parts = [values[at] for values in (prediction, target, rays)]
        inside = {name: region[at] for name, region in (regions or {}).items()}
        stated = {"depth_error": errors[0][at], "angle_error": errors[1][at]} if errors else {}
        if measured is not None:
            stated["measured"] = measured[at]
        return SurfacePair(*parts, unit=unit, regions=inside, image_dtype=torch.float32, **stated)

    # Rows and columns at the border without any predicted pixel, which MSG's published networks leave out, are cut off.
    whole = inner = pair_of()
    valid = prediction.isfinite()[0]
    if valid.any():
        v, u = valid.nonzero().unbind(1)
        window = slice(int(v.min()), int(v.max()) + 1), slice(int(u.min()), int(u.max()) + 1)
        if valid[window].shape != valid.shape:
            inner = pair_of(*window)
    for metric in metrics:
        pair = whole if metric.whole else inner
        if not metric.applies(pair):
            continue
        share = metric.valid_fraction(pair).item() * (pair.target.numel() / target.numel())
        for variant, value in metric.variants(pair).items():
            yield Score(metric.name, variant, value.item(), share)
