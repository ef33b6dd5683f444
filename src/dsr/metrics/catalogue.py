"""The catalogue of metrics, and the scores of all of them for a pair of depth maps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from dsr.geometry.shading import LIGHT_NAMES
from dsr.metrics import functional
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS, MIN_SIZE, lpips_v
from dsr.sample import CENTIMETRES, Unit

WORST, AVERAGE = "max", "avg"
VARIANTS = (*LIGHT_NAMES, WORST, AVERAGE)


@dataclass(frozen=True)
class Metric:
    """A metric: how it is computed and how it is shown.

    Args:
        name: as in ``scores.csv``.
        function: from a pair to (B,), or to (B, 4) where ``per_light``.
        mask: from a pair to the (B, 1, H', W') pixels that the metric uses.
        format: how tables and figures show it.
        per_light: whether there is a value for each of the lights e1..e4.
        min_size: smallest height and width in pixels that it is defined for.
        perceptual: whether the function takes an LPIPS network, ``network``.

    """

    name: str
    function: Callable[..., Tensor]
    mask: Callable[[SurfacePair], Tensor]
    format: MetricFormat
    per_light: bool = False
    min_size: int = 2
    perceptual: bool = False

    @property
    def worst(self) -> str:
        """The variant that is the worst of four lights: the largest value, the smallest where higher is better."""
        return "min" if self.format.higher_is_better else WORST

    def variants(self, pair: SurfacePair) -> dict[str, Tensor]:
        """Return the value per image, (B,), by variant: e1..e4, the worst of them and their average, or just "".

        NaN for images below the metric's smallest size.
        """
        count, size = len(pair.target), min(pair.target.shape[-2:])
        if size < self.min_size:
            values = pair.target.new_full((count, len(LIGHT_NAMES)) if self.per_light else (count,), torch.nan)
        else:
            values = self._values(pair)
        if not self.per_light:
            return {"": values}
        by_light = dict(zip(LIGHT_NAMES, values.unbind(1), strict=True))
        worst = values.amin(dim=1) if self.format.higher_is_better else values.amax(dim=1)
        return {**by_light, self.worst: worst, AVERAGE: values.mean(dim=1)}

    def _values(self, pair: SurfacePair) -> Tensor:
        """Return the function's values, of the right shape."""
        values = self.function(pair)
        expected = (len(pair.target), len(LIGHT_NAMES)) if self.per_light else (len(pair.target),)
        if tuple(values.shape) != expected:
            raise ValueError(f"{self.name}: expected values of shape {expected}, got {tuple(values.shape)}")
        return values

    def valid_fraction(self, pair: SurfacePair) -> Tensor:
        """Return the valid fraction of the pixels that the metric would use in a complete map, (B,)."""
        if min(pair.target.shape[-2:]) < self.min_size:
            return torch.zeros(len(pair.target), dtype=torch.float64)
        if pair.complete:
            return torch.ones(len(pair.target), dtype=torch.float64)
        return self.mask(pair).double().mean(dim=(-3, -2, -1))


def depth_mask(pair: SurfacePair) -> Tensor:
    """Return the pixels with a depth in both maps."""
    return pair.depth_mask


def normal_mask(pair: SurfacePair) -> Tensor:
    """Return the pixels with a normal in both maps."""
    return pair.normal_mask


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
KNOWN_FORMATS = {metric.name: metric.format for metric in METRICS}


def catalogue(network: LPIPS | None = None, extra: Sequence[Metric] = ()) -> tuple[Metric, ...]:
    """Return the metrics that can be computed: the paper's, then others.

    Args:
        network: for perceptual metrics; None leaves them out.
        extra: metrics beside the paper's.

    Raises:
        ValueError: two metrics have one name.

    """
    names = [metric.name for metric in (*METRICS, *extra)]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name}: expected metrics of different names, got two of this one")
    return tuple(_with_network((*METRICS, *extra), network))


def _with_network(metrics: Iterable[Metric], network: LPIPS | None) -> Iterator[Metric]:
    """Yield the metrics with the network as an argument where they need one; leave these out if there is none."""
    for metric in metrics:
        if not metric.perceptual:
            yield metric
        elif network is not None:
            yield replace(metric, function=partial(metric.function, network=network), perceptual=False)


@dataclass(frozen=True)
class Score:
    """One row of ``scores.csv``: a metric's value for one image, and the valid fraction of the pixels that it uses."""

    metric: str
    variant: str
    value: float
    valid_share: float


@torch.no_grad()
def score_image(
    prediction: Tensor, target: Tensor, rays: Tensor, metrics: tuple[Metric, ...], unit: Unit = CENTIMETRES
) -> Iterator[Score]:
    """Score one predicted depth map.

    Rows and columns at the border without any predicted pixel are cut off first (MSG's published networks leave out the
    last of each). The valid fractions still refer to the complete map.

    Args:
        prediction: (1, H, W) orthogonal depth in metres, NaN where missing.
        target: (1, H, W) orthogonal depth in metres, NaN where missing.
        rays: (3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.
        metrics: from :func:`catalogue`.
        unit: of the metrics that are in the benchmark's own.

    Yields:
        The scores, NaN where no pixel can be scored.

    """
    rows, columns = _covered(prediction)
    kept = (rows.stop - rows.start) * (columns.stop - columns.start) / target.numel()
    window = (..., rows, columns)
    pair = SurfacePair(
        prediction[window][None], target[window][None], rays[window][None], unit=unit, image_dtype=torch.float32
    )
    for metric in metrics:
        valid = metric.valid_fraction(pair).item() * kept
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
