"""torchmetrics classes of the paper's metrics: the mean over images, by default of the worst of four lights.

    DSSIMv()(preds, target, camera)                     # the value of this batch
    metrics = visual_metrics(network)                   # a MetricCollection
    metrics.update(preds, target, camera)               # or a SurfacePair
    metrics.compute()                                   # {"RMSE_d": ..., "DSSIM_v": ..., ...}

Masks, normals and renderings are computed once for all the metrics of such a collection, by the pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
import torchmetrics
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.metrics.alignment import align_pair
from dsr.metrics.calibration import OFF, auc_metric
from dsr.metrics.catalogue import PROTOCOLS, catalogue
from dsr.metrics.formats import MetricFormat
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS
from dsr.metrics.metric import VARIANTS, WORST, Metric


class PerImageMean(torchmetrics.Metric):
    """Mean over images of one metric.

    An image whose target has no valid pixel is left out. If a prediction has no pixel that can be scored, the mean is
    NaN, so that a method that fails never looks better than one that does not.

    Attributes:
        applied: () bool, whether the metric is for all pairs, or was for one so far.

    Args:
        metric: from :func:`dsr.metrics.catalogue.catalogue`.
        variant: ``max`` (worst of four lights, the smallest value where higher is better), ``avg`` or one of e1..e4;
            has no effect on metrics without lights.
        **settings: as for every torchmetrics class.

    Raises:
        ValueError: an unknown variant.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.classes import RMSEd
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth, metric = torch.full((1, 1, 24, 32), 2.0), RMSEd()
        >>> for offset in (0.0, 0.1):
        ...     metric.update(truth + offset, truth, camera)
        >>>
        >>> round(float(metric.compute()), 3)  # of two images
        0.054

    """

    is_differentiable = False
    full_state_update = False
    applied: Tensor
    count: Tensor

    def __init__(self, metric: Metric, variant: str = WORST, **settings: Any) -> None:
        super().__init__(**settings)
        if variant not in VARIANTS:
            raise ValueError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
        self._metric = metric
        named = metric.worst if variant == WORST else variant
        self._variant = named if metric.per_light else ""
        self._total = f"total_{metric.name}_{self._variant}"  # else compute groups merge metrics of equal first values
        self.add_state(self._total, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state(
            "applied", torch.tensor(metric.unit is metric.region is metric.stated is None), dist_reduce_fx="max"
        )

    @property
    def format(self) -> MetricFormat:
        """How tables and figures show the metric."""
        return self._metric.format

    @property
    def chart_title(self) -> str:
        """The title of a chart of the metric."""
        return self.format.chart_title(by_light=self._metric.per_light)

    @property
    def higher_is_better(self) -> bool:  # type: ignore[override]  # torchmetrics has a constant per class
        """Whether larger values are better."""
        return self._metric.format.higher_is_better

    @torch.no_grad()
    def update(
        self,
        preds: SurfacePair | Tensor | np.ndarray,
        target: Tensor | np.ndarray | None = None,
        camera: Camera | Sequence[Camera] | Tensor | np.ndarray | None = None,
        mask: Tensor | np.ndarray | None = None,
    ) -> None:
        """Add a batch, as for :meth:`dsr.metrics.functional.SurfacePair.of`.

        Args:
            preds: a pair, which is left out if it is of another benchmark than the metric's, or has no expected errors
                for a metric of these; or predicted depth.
            target: true depth.
            camera: the camera of these pixels, a list of one for each image, or their rays.
            mask: the pixels to compare.

        """
        pair = SurfacePair.of(preds, target, camera, mask)
        if not self._metric.applies(pair):
            return
        self.applied = torch.ones_like(self.applied)
        values = self._metric.variants(pair)[self._variant]
        valid = pair.target_mask.flatten(1).any(dim=1)
        setattr(self, self._total, getattr(self, self._total) + torch.where(valid, values, 0).sum().to(self.count))
        self.count = self.count + valid.sum().to(self.count)

    def compute(self) -> Tensor:
        """Return the mean, NaN where no image could be scored."""
        total: Tensor = getattr(self, self._total)
        return total / self.count

    def plot(self, val: Any = None, ax: Any = None) -> Any:
        """Plot a value, or several in a row; of matplotlib's axes, None for new ones."""
        return self._plot(val, ax)

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> Self:
        """Move the states, and the LPIPS network, which is no submodule, so that checkpoints do not contain it."""
        super()._apply(fn, exclude_state)
        if self._metric.network is not None:
            self._metric.network.to(self.device)
        return self


_KNOWN = {metric.name: metric for metrics in PROTOCOLS.values() for metric in metrics}


def _named(name: str) -> Metric:
    return _KNOWN[name]


def _with_threshold(name: str, threshold: float | str, unit: str = "") -> Metric:
    """Return the catalogue's metric of this name and threshold."""
    text = threshold if isinstance(threshold, str) else f"{threshold:g}"
    try:
        return _named(f"{name}_{text}{unit}".replace(".", "_"))
    except KeyError:
        choices = ", ".join(known for known in _KNOWN if known.startswith(name))
        raise ValueError(f"threshold: expected one that gives {choices}; got {threshold!r}") from None


class RMSEd(PerImageMean):
    """RMSE_d in metres."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("RMSE_d"), **settings)


class BadPixD(PerImageMean):
    """BadPix_d: threshold 1, 5 or 10, in cm or in percent of the target where ``relative``."""

    def __init__(self, threshold: int = 5, *, relative: bool = False, **settings: Any) -> None:
        super().__init__(_with_threshold("BadPix_d", threshold, "pct" if relative else "cm"), **settings)


class BadPixV(PerImageMean):
    """BadPix_v: threshold 1, 5 or 10 of 255."""

    def __init__(self, threshold: int = 5, variant: str = WORST, **settings: Any) -> None:
        super().__init__(_with_threshold("BadPix_v", threshold), variant, **settings)


class DSSIMv(PerImageMean):
    """DSSIM_v."""

    def __init__(self, variant: str = WORST, **settings: Any) -> None:
        super().__init__(_named("DSSIM_v"), variant, **settings)


class LPIPSv(PerImageMean):
    """LPIPS_v.

    Args:
        network: the LPIPS network.
        variant: as for :class:`PerImageMean`.
        **settings: as for every torchmetrics class.

    """

    def __init__(self, network: LPIPS, variant: str = WORST, **settings: Any) -> None:
        metric = next(metric for metric in catalogue(network) if metric.name == "LPIPS_v")
        super().__init__(metric, variant, **settings)


class RMSEv(PerImageMean):
    """RMSE_v."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("RMSE_v"), **settings)


class RMSEv1(PerImageMean):
    """RMSE_v^1."""

    def __init__(self, variant: str = WORST, **settings: Any) -> None:
        super().__init__(_named("RMSE_v1"), variant, **settings)


class BumpinessD(PerImageMean):
    """Bumpiness_d."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Bumpiness_d"), **settings)


class AbsRel(PerImageMean):
    """AbsRel, a fraction."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Depth_AbsRel"), **settings)


class DeltaAccuracy(PerImageMean):
    """delta, the fraction of pixels whose depths have a ratio of less than 1.05, 1.1, 1.25, 1.25**2 or 1.25**3."""

    def __init__(self, threshold: float = 1.25, **settings: Any) -> None:
        powers = {round(1.25**power, 6): f"125_{power}" for power in (2, 3)}
        name = powers.get(round(threshold, 6), f"{100 * threshold:.5g}")
        super().__init__(_with_threshold("Depth_delta", name), **settings)


class SIlog(PerImageMean):
    """SIlog; KITTI prints 100 times as much."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Depth_SIlog"), **settings)


class NormalAngle(PerImageMean):
    """The mean angle between normals in degrees; the median of each image where ``median``."""

    def __init__(self, *, median: bool = False, **settings: Any) -> None:
        super().__init__(_named("Normal_median" if median else "Normal_mean"), **settings)


class NormalsWithin(PerImageMean):
    """The fraction of normals less than 5, 7.5, 11.25, 22.5 or 30 degrees off."""

    def __init__(self, threshold: float = 11.25, **settings: Any) -> None:
        super().__init__(_with_threshold("Normal_within", threshold), **settings)


class FlyingPixels(PerImageMean):
    """The fraction of the points that fly between two surfaces."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Points_flying"), **settings)


class ChamferDistance(PerImageMean):
    """The Chamfer distance in metres."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Points_chamfer"), **settings)


class FScore(PerImageMean):
    """The F-score of the points: threshold 1 or 5 cm."""

    def __init__(self, threshold: int = 5, **settings: Any) -> None:
        super().__init__(_with_threshold("Points_F", threshold, "cm"), **settings)


class RelNormal(PerImageMean):
    """RelNormal of EvalMDE in radians."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("EvalMDE_RelNormal"), **settings)


class SAWAH(PerImageMean):
    """SAWA-H of EvalMDE."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("EvalMDE_SAWA_H"), **settings)


class BoundaryF1(PerImageMean):
    """Boundary F1 of Depth Pro."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("DepthPro_F1"), **settings)


class MoGeF1(PerImageMean):
    """Boundary F1 of MoGe: radius 1, 2 or 3."""

    def __init__(self, radius: int = 1, **settings: Any) -> None:
        super().__init__(_named(f"MoGe_F1_{radius}"), **settings)


class ENCE(PerImageMean):
    """The expected normalised calibration error of depth; of pairs with expected errors alone, as the next three."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Calibration_ENCE"), **settings)


class AUSE(PerImageMean):
    """The area under the sparsification error of depth, or of ``normals``."""

    def __init__(self, *, normals: bool = False, **settings: Any) -> None:
        super().__init__(_named("Calibration_AUSE_v" if normals else "Calibration_AUSE_d"), **settings)


class OffAUC(PerImageMean):
    """How well expected errors separate pixels with errors above a threshold, 0.02 m, from the others: ROC AUC.

    NaN if one of the images has no pixel above the threshold, or none below it.
    """

    def __init__(self, threshold: float = OFF, **settings: Any) -> None:
        super().__init__(auc_metric(threshold), **settings)


class StatedRatio(PerImageMean):
    """The median expected error of depth over the median measured one."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Calibration_stated"), **settings)


class PlaneDeviation(PerImageMean):
    """The standard deviation of depth about a plane in metres."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Plane_std"), **settings)


class PlaneAngle(PerImageMean):
    """The mean angle between normals and a plane's in degrees."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(_named("Plane_angle"), **settings)


class SurfaceMetrics(torchmetrics.MetricCollection):
    """A collection that makes one :class:`~dsr.metrics.functional.SurfacePair` of a batch for all of its metrics.

    Args:
        *metrics: as for every torchmetrics collection.
        alignment: one of :data:`dsr.metrics.alignment.ALIGNMENTS`, of each prediction to its truth.
        **settings: as for every torchmetrics collection.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.classes import DSSIMv, RMSEv, SurfaceMetrics
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth = torch.full((1, 1, 24, 32), 2.0)
        >>> sorted(SurfaceMetrics([RMSEv(), DSSIMv()])(truth, truth, camera))
        ['DSSIMv', 'RMSEv']

    """

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
    """Return all metrics of some protocols, each of the worst of four lights, as one collection.

    Args:
        network: for perceptual metrics; None leaves them out.
        extra: metrics beside those of the protocols.
        protocols: names of :data:`dsr.metrics.catalogue.PROTOCOLS`.
        alignment: see :class:`SurfaceMetrics`.
        **settings: as for every torchmetrics class.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.classes import visual_metrics
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth, metrics = torch.full((1, 1, 24, 32), 2.0), visual_metrics()
        >>> metrics.update(1.02 * truth, truth, camera)
        >>> float(metrics.compute()["BadPix_d_1pct"])
        1.0

    """
    chosen = catalogue(network, extra, protocols)
    metrics: dict[str, Any] = {metric.name: PerImageMean(metric, **settings) for metric in chosen}
    return SurfaceMetrics(metrics, alignment=alignment, compute_groups=False)  # no two have the same states


def compute_means(metrics: torchmetrics.MetricCollection) -> dict[str, Tensor]:
    """Return the means of a collection of :func:`visual_metrics` by name, without metrics of other benchmarks."""
    return {name: metric.compute() for name, metric in metrics.items() if _applies(metric)}


def _applies(metric: Any) -> bool:
    """Return whether a metric is for the benchmark of a pair of any process."""
    with metric.sync_context():
        return bool(getattr(metric, "applied", True))


def in_table_units(metrics: torchmetrics.MetricCollection, means: Mapping[str, float]) -> dict[str, float]:
    """Return means of metrics of a collection of :func:`visual_metrics`, by name, in the units of tables."""
    collection: Any = metrics
    return {name: value * collection[name].format.factor for name, value in means.items()}
