"""The metrics that a configuration chooses: of protocols, LPIPS if its network is available, and the user's own."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dsr.app.schema import MetricsConfig
from dsr.metrics.alignment import ALIGNMENTS
from dsr.metrics.catalogue import PROTOCOLS, Metric, catalogue
from dsr.metrics.lpips import GET_TRUNK, LPIPS, load_lpips
from dsr.utils.configuration import ConfigError, load_object
from dsr.utils.console import one_line

if TYPE_CHECKING:
    import torchmetrics


def chosen_metrics(settings: MetricsConfig, regions: Sequence[str] = ()) -> tuple[Metric, ...]:
    """Return the metrics to compute, those of some regions of the scenes, too."""
    extra = extra_metrics(settings)
    return catalogue(_network(settings, extra), extra, settings.protocols, regions)


def metric_collection(settings: MetricsConfig) -> torchmetrics.MetricCollection:
    """Return the same metrics as one collection, for a validation pass, which is always judged by the paper's too."""
    from dsr.metrics.classes import visual_metrics  # noqa: PLC0415 - torchmetrics takes seconds to import

    settings = replace(settings, protocols=list(dict.fromkeys((*settings.protocols, "paper"))))
    extra = extra_metrics(settings)
    return visual_metrics(_network(settings, extra), extra, settings.protocols, settings.alignment)


def check_metrics(settings: MetricsConfig) -> None:
    """Check a configuration's metrics, their alignment and the file of LPIPS's network, before anything is written."""
    extra_metrics(settings)
    if settings.alignment not in ALIGNMENTS:
        raise ConfigError(f"metrics.alignment: expected one of {', '.join(ALIGNMENTS)}, got {settings.alignment!r}")
    if settings.lpips and settings.lpips_trunk is not None:
        perceptual_network(settings.lpips_trunk)


def extra_metrics(settings: MetricsConfig) -> tuple[Metric, ...]:
    """Return the metrics beside those of the protocols, whose names have to be unique."""
    metrics = tuple(load_object("metrics.extra", path, "a dsr.metrics.catalogue.Metric") for path in settings.extra)
    for path, metric in zip(settings.extra, metrics, strict=True):
        if not isinstance(metric, Metric):
            raise ConfigError(f"metrics.extra: expected a dsr.metrics.catalogue.Metric, {path!r} is none")
    try:
        catalogue(None, metrics, settings.protocols)
    except ValueError as error:
        about = str(error)
        raise ConfigError(f"metrics.{'' if about.startswith('protocols') else 'extra: '}{about}") from error
    return metrics


def _network(settings: MetricsConfig, extra: Sequence[Metric]) -> LPIPS | None:
    """Return the LPIPS network; None if it is disabled, not used, or not available."""
    chosen = (*(metric for name in settings.protocols for metric in PROTOCOLS[name]), *extra)
    used = any(metric.perceptual for metric in chosen)
    return perceptual_network(settings.lpips_trunk) if settings.lpips and used else None


@functools.cache
def perceptual_network(trunk: str | None) -> LPIPS | None:
    """Return the LPIPS network; without weights of its trunk, print one line of advice, and return None."""
    try:
        return load_lpips(None if trunk is None else Path(trunk).expanduser())
    except (OSError, ValueError) as error:
        if trunk is not None or isinstance(error, ValueError):
            raise ConfigError(f"metrics.lpips_trunk: {error}") from error
        print(f"LPIPS_v is left out: AlexNet's weights {one_line(error)}; {GET_TRUNK}", file=sys.stderr)  # noqa: T201
        return None
