"""The catalogue of metrics, and the scores of all of them for a pair of depth maps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import NamedTuple

import torch
from torch import Tensor

from dsr.metrics import boundaries, calibration, depth, evalmde, functional, plane, points, sensor
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS, MIN_SIZE, lpips_v
from dsr.metrics.metric import Metric, depth_mask, normal_mask
from dsr.sample import CENTIMETRES, Unit

__all__ = [
    "KNOWN_FORMATS",
    "METRICS",
    "PROTOCOLS",
    "Metric",
    "Score",
    "catalogue",
    "depth_mask",
    "normal_mask",
    "score_image",
]


# the paper's metrics in the order of scores.csv; those with a position are the columns of its tables
METRICS: tuple[Metric, ...] = (
    Metric("RMSE_d", functional.rmse_d, depth_mask, MetricFormat("RMSE_d", "mm", 1e3, 1, position=1), min_size=1),
    *(
        Metric(
            f"BadPix_d_{percent}{unit}",
            partial(functional.bad_pix_d, threshold=percent / 100, relative=unit == "pct"),
            depth_mask,
            MetricFormat("BadPix_d", f"{percent} {of}, %", 1e2, 2, position=2 if percent == second else None),
            min_size=1,
        )
        for unit, of, second in (("cm", "cm", 5), ("pct", "% of depth", None))
        for percent in (1, 5, 10)
    ),
    *(
        Metric(
            f"BadPix_v_{level}",
            partial(functional.bad_pix_v, threshold=level),
            normal_mask,
            MetricFormat("BadPix_v", f"{level}, %", 1e2, 1, position=3 if level == 5 else None),
            per_light=True,
        )
        for level in (1, 5, 10)
    ),
    Metric(
        "DSSIM_v",
        functional.dssim_v,
        attrgetter("ssim_mask"),
        MetricFormat("DSSIM_v", "1/1000", 1e3, 0, position=4),
        per_light=True,
        min_size=functional.SSIM_WINDOW,
    ),
    Metric(
        "LPIPS_v",
        lpips_v,
        normal_mask,
        MetricFormat("LPIPS_v", "1/1000", 1e3, 0, position=5),
        per_light=True,
        min_size=MIN_SIZE,
        perceptual=True,
    ),
    Metric("RMSE_v", functional.rmse_v, normal_mask, MetricFormat("RMSE_v", "1/1000", 1e3, 0, position=7)),
    Metric(
        "RMSE_v1",
        functional.rmse_v1,
        normal_mask,
        MetricFormat("RMSE_v1", "1/1000", 1e3, 0, position=None),
        per_light=True,
    ),
    Metric(
        "Bumpiness_d",
        functional.bumpiness_d,
        attrgetter("bumpiness_mask"),
        MetricFormat("Bump_d", digits=2, position=6),
        min_size=3,
    ),
)
# sets of metrics by name: the paper's, those that the field prints, those for real sensors, of depth estimation, of
# EvalMDE, of boundaries, of stated errors and of planes
PROTOCOLS: Mapping[str, tuple[Metric, ...]] = {
    "paper": METRICS,
    "field": depth.FIELD,
    "sensor": sensor.METRICS,
    **{
        name: tuple(replace(metric, format=replace(metric.format, family=name)) for metric in metrics)
        for name, metrics in {
            "depth": depth.DEPTH,
            "normals": depth.NORMALS,
            "points": points.METRICS,
            "evalmde": evalmde.METRICS,
            "boundaries": boundaries.METRICS,
            "calibration": calibration.METRICS,
            "plane": plane.METRICS,
        }.items()
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
    metrics = (*(metric for name in dict.fromkeys(protocols) for metric in PROTOCOLS[name]), *extra)
    of_regions = [each for each in metrics if each.in_regions]
    metrics = (*metrics, *(each.within(region) for region in regions for each in of_regions))
    names = [metric.name for metric in metrics]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name}: expected metrics of different names, got two of this one")
    if network is None:
        return tuple(metric for metric in metrics if not metric.perceptual)
    return tuple(
        replace(metric, function=partial(metric.function, network=network)) if metric.perceptual else metric
        for metric in metrics
    )


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
) -> Iterator[Score]:
    """Score one predicted depth map; NaN where no pixel can be scored.

    Rows and columns at the border without any predicted pixel are cut off first (MSG's published networks leave out the
    last of each), except for metrics of the whole image. The valid fractions still refer to the complete map.

    Both maps are (1, H, W) orthogonal depth in metres, NaN where missing, the rays (3, H, W), regions (1, H, W) uint8,
    and ``errors`` the method's expected errors, (1, H, W): of depth in metres, of normals in degrees. Metrics for other
    units, absent regions or absent errors are left out.
    """
    valid = prediction.isfinite()[0]
    window: list[slice] = []  # rows and columns of the smallest one with all predicted pixels; all if there are none
    for axis in (1, 0):
        hits = valid.any(dim=axis).nonzero()
        window.append(slice(int(hits[0]), int(hits[-1]) + 1) if len(hits) else slice(0, valid.shape[1 - axis]))
    windows = [[slice(None), slice(None)]]
    if valid[*window].shape != valid.shape:
        windows.append(window)
    pairs = []
    for rows, columns in windows:
        depth_error, angle_error = (None, None) if errors is None else (e[None, :, rows, columns] for e in errors)
        pairs.append(
            SurfacePair(
                prediction[None, :, rows, columns],
                target[None, :, rows, columns],
                rays[None, :, rows, columns],
                unit=unit,
                regions={name: region[None, :, rows, columns] for name, region in (regions or {}).items()},
                depth_error=depth_error,
                angle_error=angle_error,
                image_dtype=torch.float32,
            )
        )
    for metric in metrics:
        pair = pairs[0] if metric.whole else pairs[-1]
        if not metric.applies(pair):
            continue
        share = metric.valid_fraction(pair).item() * (pair.target.numel() / target.numel())
        for variant, value in metric.variants(pair).items():
            yield Score(metric.name, variant, value.item(), share)
