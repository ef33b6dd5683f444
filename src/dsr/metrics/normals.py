"""The angles between predicted and true normals that papers on surface normals print.

Mean, median and the fractions below five angles are those of Bae and Davison, *Rethinking Inductive Biases for Surface
Normal Estimation*, CVPR 2024: ``compute_normal_metrics`` in ``utils/utils.py`` of baegwangbin/DSINE (ef0c2af); the
largest three angles are Fouhey et al.'s, ICCV 2013. They pool the pixels of a data set; here each image has its value,
and a median of an even number is the mean of the middle two, as numpy's.

The normals are of depth maps, both by the same forward differences (:func:`dsr.geometry.surface.depth_to_normals`),
which tables name: central differences have smaller angles for a noisy map, by a fifth and more. A normal that needs a
missing depth is left out; ``Normal_covered`` says how many of the true ones are compared.
"""

from __future__ import annotations

from functools import partial

from torch import Tensor

from dsr.geometry.surface import normal_mask as mask_of_normals
from dsr.metrics.formats import column
from dsr.metrics.functional import SurfacePair, angle, masked_mean, masked_median
from dsr.metrics.metric import Metric, normal_mask

ANGLES = (5, 7.5, 11.25, 22.5, 30)
"""Degrees below which a normal is right."""


def mean(pair: SurfacePair) -> Tensor:
    """Return the mean angle between the normals in degrees, (B,); 0 to 180, lower is better.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.metrics.functional import SurfacePair
        >>> from dsr.metrics import normals
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> truth = torch.full((1, 1, 24, 32), 2.0)
        >>> tilted = truth + 0.1 * torch.linspace(-1, 1, 32)
        >>> normals.mean(SurfacePair(tilted, truth, camera.rays()[None])).round(decimals=1)
        tensor([5.1000])

    """
    return masked_mean(angle(pair), pair.normal_mask).squeeze(1)


def median(pair: SurfacePair) -> Tensor:
    """Return the median angle between the normals in degrees, (B,); 0 to 180, lower is better."""
    return masked_median(angle(pair), pair.normal_mask).flatten()


def within(pair: SurfacePair, degrees: float) -> Tensor:
    """Return the fraction of normals that are less than ``degrees`` off, (B,); higher is better."""
    return masked_mean(angle(pair) < degrees, pair.normal_mask).squeeze(1)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the true normals that have a predicted one, (B,); higher is better."""
    return masked_mean(pair.normal_mask, _true_normals(pair)).squeeze(1)


def _true_normals(pair: SurfacePair) -> Tensor:
    return mask_of_normals(pair.target_mask)


def _within(degrees: float) -> Metric:
    name, function = f"Normal_within_{degrees:g}".replace(".", "_"), partial(within, degrees=degrees)
    return Metric(name, function, normal_mask, column(f"< {degrees:g} deg", "forward, %", 1e2, higher_is_better=True))


METRICS: tuple[Metric, ...] = (
    Metric("Normal_mean", mean, normal_mask, column("Mean angle", "forward, deg", 1, 2)),
    Metric("Normal_median", median, normal_mask, column("Median angle", "forward, deg", 1, 2)),
    *map(_within, ANGLES),
    Metric(
        "Normal_covered",
        covered,
        _true_normals,
        column("Covered", "normals, %", 1e2, higher_is_better=True),
        regional=True,
        whole=True,
    ),
)
"""The metrics of ``metrics=normals``."""
