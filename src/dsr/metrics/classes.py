"""torchmetrics classes of the metrics: the mean over images, by default of the worst of four lights.

They are updated with (prediction, target, camera) or with a SurfacePair; a collection computes masks, normals and
renderings once for all of its metrics.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torchmetrics
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.metrics.alignment import align_pair
from dsr.metrics.catalogue import PROTOCOLS, catalogue
from dsr.metrics.formats import VARIANTS, WORST, Metric
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS


class PerImageMean(torchmetrics.Metric):
    """Mean over images of one metric, or of the one of a name, as in ``scores.csv``.

    An image whose target has no valid pixel is left out. If a prediction has no pixel that can be scored, the mean is
    NaN, so that a method that fails never looks better than one that does not. ``variant``, one of ``VARIANTS``, has no
    effect on metrics without lights; ``max`` is the worst light, the smallest value if higher is better.
    """

    is_differentiable = False
    full_state_update = False
    applied: Tensor  # whether the metric is for all pairs, or was for one so far
    total: Tensor
    count: Tensor

    def __init__(self, metric: Metric | str, variant: str = WORST, **settings: Any) -> None:
        super().__init__(**settings)
        if isinstance(metric, str):
            known = {each.name: each for each in catalogue(protocols=tuple(PROTOCOLS))}
            if metric not in known:
                raise ValueError(f"metric: expected one of {', '.join(known)}, got {metric!r}")
            metric = known[metric]
        if variant not in VARIANTS:
            raise ValueError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
        self._metric, self._variant = metric, ""
        if metric.per_light:
            self._variant = metric.worst if variant == WORST else variant
        self.format, self.chart_title = metric.format, metric.format.chart_title(by_light=metric.per_light)
        applied = torch.tensor(metric.unit is metric.region is metric.stated is None)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("applied", applied, dist_reduce_fx="max")
        # a state of its own name, without which compute groups merge metrics whose first values are equal
        self.add_state(f"of_{metric.name}_{self._variant}", torch.zeros(()), dist_reduce_fx="sum")

    @property
    def higher_is_better(self) -> bool:  # type: ignore[override]  # torchmetrics has a constant per class
        """Whether larger values are better."""
        return self.format.higher_is_better

    @torch.no_grad()
    def update(
        self,
        preds: SurfacePair | Tensor | np.ndarray,
        target: Tensor | np.ndarray | None = None,
        camera: Camera | Sequence[Camera] | Tensor | np.ndarray | None = None,
        mask: Tensor | np.ndarray | None = None,
    ) -> None:
        """Add a batch, as for :meth:`dsr.metrics.functional.SurfacePair.of`, unless the metric is not for it."""
        pair = SurfacePair.of(preds, target, camera, mask)
        if not self._metric.applies(pair):
            return
        self.applied = torch.ones_like(self.applied)
        values = self._metric.variants(pair)[self._variant]
        valid = pair.target_mask.flatten(1).any(dim=1)
        self.total = self.total + torch.where(valid, values, 0).sum().to(self.total)
        self.count = self.count + valid.sum().to(self.count)

    def compute(self) -> Tensor:
        """Return the mean, NaN where no image could be scored."""
        return self.total / self.count

    def plot(self, val: Any = None, ax: Any = None) -> Any:
        """Plot a value, or several in a row; of matplotlib's axes, None for new ones."""
        return self._plot(val, ax)


class RMSEd(PerImageMean):
    """RMSE_d in metres."""

    def __init__(self, **settings: Any) -> None:
        super().__init__("RMSE_d", **settings)


class RMSEv(PerImageMean):
    """RMSE_v."""

    def __init__(self, **settings: Any) -> None:
        super().__init__("RMSE_v", **settings)


class DSSIMv(PerImageMean):
    """DSSIM_v."""

    def __init__(self, variant: str = WORST, **settings: Any) -> None:
        super().__init__("DSSIM_v", variant, **settings)


class LPIPSv(PerImageMean):
    """LPIPS_v, with the LPIPS network."""

    def __init__(self, network: LPIPS, variant: str = WORST, **settings: Any) -> None:
        metric = next(metric for metric in catalogue(network) if metric.name == "LPIPS_v")
        super().__init__(metric, variant, **settings)


class SurfaceMetrics(torchmetrics.MetricCollection):
    """A collection whose metrics share one :class:`~dsr.metrics.functional.SurfacePair` of a batch, perhaps aligned."""

    def __init__(self, *metrics: Any, alignment: str = "none", **settings: Any) -> None:
        super().__init__(*metrics, **settings)
        self._alignment = alignment

    def update(self, *batch: Any, **named: Any) -> None:
        """Add a batch; arguments as for :meth:`dsr.metrics.functional.SurfacePair.of`."""
        super().update(align_pair(SurfacePair.of(*batch, **named), self._alignment))

    def forward(self, *batch: Any, **named: Any) -> dict[str, Any]:
        """Add a batch as :meth:`update` does, and return its own values by name."""
        return super().forward(align_pair(SurfacePair.of(*batch, **named), self._alignment))


def visual_metrics(
    network: LPIPS | None = None,
    extra: Sequence[Metric] = (),
    protocols: Sequence[str] = ("paper",),
    alignment: str = "none",
    **settings: Any,
) -> SurfaceMetrics:
    """Return the metrics of :func:`dsr.metrics.catalogue.catalogue`, of the worst of four lights, as one collection."""
    chosen = catalogue(network, extra, protocols)
    metrics: dict[str, Any] = {metric.name: PerImageMean(metric, **settings) for metric in chosen}
    return SurfaceMetrics(metrics, alignment=alignment, compute_groups=False)


def compute_means(metrics: torchmetrics.MetricCollection) -> dict[str, Tensor]:
    """Return the means of a collection of :func:`visual_metrics` by name, without metrics of other benchmarks."""
    means = {}
    for name, metric in metrics.items():
        with metric.sync_context():  # whether a pair of any process is of its benchmark
            applied = bool(getattr(metric, "applied", True))
        if applied:
            means[name] = metric.compute()
    return means


def in_table_units(metrics: torchmetrics.MetricCollection, means: Mapping[str, float]) -> dict[str, float]:
    """Return means of a collection of :func:`visual_metrics`, by name, in the units of tables."""
    collection: Any = metrics
    return {name: value * collection[name].format.factor for name, value in means.items()}
