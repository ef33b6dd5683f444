"""The catalogue of metrics, and all of them at once for a pair of depth maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from dsr.geometry.shading import LIGHT_NAMES
from dsr.metrics import functional
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS, MIN_SIZE, lpips_v

WORST = "max"
VARIANTS = (*LIGHT_NAMES, WORST, "avg")
METRICS: dict[str, tuple[str, str, float, int]] = {
    "RMSE_d": ("RMSE_d", "mm", 1e3, 1),
    "BadPix_d_5cm": ("BadPix_d", "5 cm, %", 1e2, 2),
    "BadPix_v_5": ("BadPix_v", "5, %", 1e2, 1),
    "DSSIM_v": ("DSSIM_v", "1/1000", 1e3, 0),
    "LPIPS_v": ("LPIPS_v", "1/1000", 1e3, 0),
    "Bumpiness_d": ("Bump_d", "", 1.0, 2),
    "RMSE_v": ("RMSE_v", "1/1000", 1e3, 0),
}
"""The columns of the paper's tables: heading, unit, factor from raw units, digits after the point."""


@dataclass(frozen=True)
class Metric:
    """One metric of the paper.

    Args:
        name: as in ``scores.csv``.
        function: from a pair to (B,), or to (B, 4) where ``per_light``.
        mask: from a pair to the (B, 1, H', W') pixels that it rests on.
        per_light: whether there is a value for each of the lights e1..e4.
        min_size: smallest height and width in pixels that it is defined for.

    """

    name: str
    function: Callable[[SurfacePair], Tensor]
    mask: Callable[[SurfacePair], Tensor]
    per_light: bool = False
    min_size: int = 2

    def variants(self, pair: SurfacePair) -> dict[str, Tensor]:
        """Return the value per image, (B,), by variant: e1..e4, their maximum and average, or just "".

        NaN for images below the metric's smallest size.
        """
        count, size = len(pair.target), min(pair.target.shape[-2:])
        if size < self.min_size:
            values = pair.target.new_full((count, len(LIGHT_NAMES)) if self.per_light else (count,), torch.nan)
        else:
            values = self.function(pair)
        if not self.per_light:
            return {"": values}
        by_light = dict(zip(LIGHT_NAMES, values.unbind(1), strict=True))
        return {**by_light, WORST: values.amax(dim=1), "avg": values.mean(dim=1)}

    def share(self, pair: SurfacePair) -> Tensor:
        """Return the share of the pixels that the metric would use in a complete map and that are known, (B,)."""
        if min(pair.target.shape[-2:]) < self.min_size:
            return torch.zeros(len(pair.target), dtype=torch.float64)
        if pair.complete:
            return torch.ones(len(pair.target), dtype=torch.float64)
        return self.mask(pair).double().mean(dim=(-3, -2, -1))


def _depth_mask(pair: SurfacePair) -> Tensor:
    return pair.depth_mask


def _normal_mask(pair: SurfacePair) -> Tensor:
    return pair.normal_mask


def _ssim_mask(pair: SurfacePair) -> Tensor:
    return pair.ssim_mask


def _bumpiness_mask(pair: SurfacePair) -> Tensor:
    return pair.bumpiness_mask


def catalogue(network: LPIPS | None = None) -> tuple[Metric, ...]:
    """Return the paper's metrics in the order of its tables; LPIPS_v only where there is a network for it."""
    by_depth = [Metric("RMSE_d", functional.rmse_d, _depth_mask, min_size=1)]
    for percent in (1, 5, 10):
        bad = partial(functional.bad_pix_d, threshold=percent / 100)
        by_depth.append(Metric(f"BadPix_d_{percent}cm", bad, _depth_mask, min_size=1))
    for percent in (1, 5, 10):
        bad = partial(functional.bad_pix_d, threshold=percent / 100, relative=True)
        by_depth.append(Metric(f"BadPix_d_{percent}pct", bad, _depth_mask, min_size=1))
    by_look = [
        Metric(f"BadPix_v_{level}", partial(functional.bad_pix_v, threshold=level), _normal_mask, per_light=True)
        for level in (1, 5, 10)
    ]
    by_look.append(Metric("DSSIM_v", functional.dssim_v, _ssim_mask, per_light=True, min_size=functional.SSIM_WINDOW))
    if network is not None:
        by_look.append(
            Metric("LPIPS_v", partial(lpips_v, network=network), _normal_mask, per_light=True, min_size=MIN_SIZE)
        )
    by_look.append(Metric("RMSE_v", functional.rmse_v, _normal_mask))
    by_look.append(Metric("RMSE_v1", functional.rmse_v1, _normal_mask, per_light=True))
    return (*by_depth, *by_look, Metric("Bumpiness_d", functional.bumpiness_d, _bumpiness_mask, min_size=3))


@dataclass(frozen=True)
class Score:
    """One row of ``scores.csv``: a metric's value for one image, and the share of its pixels that it rests on."""

    metric: str
    variant: str
    value: float
    valid_share: float


@torch.no_grad()
def score_image(prediction: Tensor, target: Tensor, rays: Tensor, metrics: tuple[Metric, ...]) -> Iterator[Score]:
    """Score one predicted depth map.

    What the method does not cover is cut off first: rows and columns at the border without a single predicted pixel
    (MSG's published networks leave out the last of each). The shares count against the whole map all the same.

    Args:
        prediction: (1, H, W) orthogonal depth in metres, NaN where unknown.
        target: likewise.
        rays: (3, H, W), see :meth:`dsr.geometry.camera.Camera.rays`.
        metrics: from :func:`catalogue`.

    Yields:
        The scores, NaN where no pixel can be scored.

    """
    rows, columns = _covered(prediction)
    kept = (rows.stop - rows.start) * (columns.stop - columns.start) / target.numel()
    window = (..., rows, columns)
    pair = SurfacePair(prediction[window][None], target[window][None], rays[window][None], image_dtype=torch.float32)
    for metric in metrics:
        share = metric.share(pair).item() * kept
        for variant, value in metric.variants(pair).items():
            yield Score(metric.name, variant, value.item(), share)


def _covered(prediction: Tensor) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest window with all predicted pixels; the whole map if there are none."""
    known = prediction.isfinite()[0]
    spans = []
    for axis in (1, 0):
        hits = known.any(dim=axis).nonzero()
        spans.append(slice(int(hits[0]), int(hits[-1]) + 1) if len(hits) else slice(0, known.shape[1 - axis]))
    return spans[0], spans[1]
