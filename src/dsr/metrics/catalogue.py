"""The catalogue of metrics, and the scores of all of them for a pair of depth maps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dsr.metrics import boundaries, calibration, depth, evalmde, field, functional, normals, plane, points, sensor
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


def _ssim_mask(pair: SurfacePair) -> Tensor:
    return pair.ssim_mask


def _bumpiness_mask(pair: SurfacePair) -> Tensor:
    return pair.bumpiness_mask


def _bad_pix_d(percent: int, position: int | None = None) -> Metric:
    function = partial(functional.bad_pix_d, threshold=percent / 100)
    shown = MetricFormat("BadPix_d", f"{percent} cm, %", 1e2, 2, position=position)
    return Metric(f"BadPix_d_{percent}cm", function, depth_mask, shown, min_size=1)


def _bad_pix_d_relative(percent: int) -> Metric:
    function = partial(functional.bad_pix_d, threshold=percent / 100, relative=True)
    shown = MetricFormat("BadPix_d", f"{percent} % of depth, %", 1e2, 2, position=None)
    return Metric(f"BadPix_d_{percent}pct", function, depth_mask, shown, min_size=1)


def _bad_pix_v(level: int, position: int | None = None) -> Metric:
    function = partial(functional.bad_pix_v, threshold=level)
    shown = MetricFormat("BadPix_v", f"{level}, %", 1e2, 1, position=position)
    return Metric(f"BadPix_v_{level}", function, normal_mask, shown, per_light=True)


METRICS: tuple[Metric, ...] = (
    Metric("RMSE_d", functional.rmse_d, depth_mask, MetricFormat("RMSE_d", "mm", 1e3, 1, position=1), min_size=1),
    _bad_pix_d(1),
    _bad_pix_d(5, position=2),
    _bad_pix_d(10),
    *map(_bad_pix_d_relative, (1, 5, 10)),
    _bad_pix_v(1),
    _bad_pix_v(5, position=3),
    _bad_pix_v(10),
    Metric(
        "DSSIM_v",
        functional.dssim_v,
        _ssim_mask,
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
        _bumpiness_mask,
        MetricFormat("Bump_d", digits=2, position=6),
        min_size=3,
    ),
)
"""The metrics of the paper, in the order of ``scores.csv``; those with a position are the columns of its tables."""
PROTOCOLS: Mapping[str, tuple[Metric, ...]] = {
    "paper": METRICS,
    "field": field.METRICS,
    "sensor": sensor.METRICS,
    **{
        name: tuple(replace(metric, format=replace(metric.format, family=name)) for metric in metrics)
        for name, metrics in {
            "depth": depth.METRICS,
            "normals": normals.METRICS,
            "points": points.METRICS,
            "evalmde": evalmde.METRICS,
            "boundaries": boundaries.METRICS,
            "calibration": calibration.METRICS,
            "plane": plane.METRICS,
        }.items()
    },
}
"""Sets of metrics by name: the paper's, those that the field prints, those for real sensors, of depth estimation, of
EvalMDE, of boundaries, of stated errors and of planes."""
KNOWN_FORMATS = {metric.name: metric.format for metric in METRICS}


def catalogue(
    network: LPIPS | None = None,
    extra: Sequence[Metric] = (),
    protocols: Sequence[str] = ("paper",),
    regions: Sequence[str] = (),
) -> tuple[Metric, ...]:
    """Return the metrics that can be computed: those of some protocols, then others.

    Args:
        network: for perceptual metrics; None leaves them out.
        extra: metrics beside those of the protocols.
        protocols: names of protocols, in the order of the metrics.
        regions: parts of the scenes, for which the columns of tables that are means over pixels follow once more.

    Raises:
        ValueError: there is no such protocol, or two metrics have one name.

    Example:
        >>> from dsr.metrics.catalogue import catalogue
        >>> [metric.name for metric in catalogue()][:3]
        ['RMSE_d', 'BadPix_d_1cm', 'BadPix_d_5cm']

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
    return tuple(replace(metric, network=network) if metric.perceptual else metric for metric in metrics)


@dataclass(frozen=True)
class Score:
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
    """Score one predicted depth map.

    Rows and columns at the border without any predicted pixel are cut off first (MSG's published networks leave out the
    last of each), except for metrics of the whole image. The valid fractions still refer to the complete map.

    Args:
        prediction: (1, H, W) orthogonal depth in metres, NaN where missing.
        target: (1, H, W) orthogonal depth in metres, NaN where missing.
        rays: (3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.
        metrics: from :func:`catalogue`; those for other units are left out, and those of regions or stated errors that
            there are not.
        unit: of the benchmark.
        regions: parts of the image by name, (1, H, W) uint8.
        errors: the method's expected errors, (1, H, W): of depth in metres, of normals in degrees.

    Yields:
        The scores, NaN where no pixel can be scored.

    """

    def pair_of(window: tuple[Any, ...]) -> SurfacePair:
        maps = (values[window][None] for values in (prediction, target, rays))
        parts = {name: region[window][None] for name, region in (regions or {}).items()}
        named = zip(("depth_error", "angle_error"), errors or (), strict=False)
        stated = {name: each[window][None] for name, each in named}
        return SurfacePair(*maps, unit=unit, regions=parts, image_dtype=torch.float32, **stated)

    window = (..., *_covered(prediction))
    whole = covered = pair_of((...,))
    if prediction[window].shape != prediction.shape:
        covered = pair_of(window)
    for metric in metrics:
        pair = whole if metric.whole else covered
        if not metric.applies(pair):
            continue
        valid = metric.valid_fraction(pair).item() * (pair.target.numel() / target.numel())
        for variant, value in metric.variants(pair).items():
            yield Score(metric.name, variant, value.item(), valid)


def _covered(prediction: Tensor) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest window with all predicted pixels; all of them if there are none."""
    valid = prediction.isfinite()[0]
    ranges = []
    for axis in (1, 0):
        hits = valid.any(dim=axis).nonzero()
        ranges.append(slice(int(hits[0]), int(hits[-1]) + 1) if len(hits) else slice(0, valid.shape[1 - axis]))
    return ranges[0], ranges[1]
