"""Comparison of the errors that a method expects of its result with the measured ones.

These functions take expected and measured absolute errors of the same pixels, of any shape, and return float64. Pixels
without either error, NaN, are left out; without any pixel the result is NaN.

ENCE is that of Levi et al., Sensors 2022, with parts of equal numbers of pixels, not of equal width. AUSE is that of
Ilg et al., ECCV 2018, with the subsets of mattpoggi/mono-uncertainty (543772b), which has 50 steps and does not divide
by the mean error.
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.surface import angle_between, depth_to_normals
from dsr.metrics.formats import Metric, MetricFormat, column, depth_mask, normal_mask, of_parts, target_mask
from dsr.metrics.functional import SurfacePair, angle, masked_mean, once_per_pair

DEVIATION = math.sqrt(math.pi / 2)  # standard deviation of a Gaussian over its mean absolute value
STEPS = 100  # steps of a sparsification curve
OFF = 0.02  # metres from which on a pixel is off


def measured_errors(prediction: Tensor, target: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the absolute errors of depth in metres and of normals in degrees, (B, 1, H, W) each, or NaN."""
    angles = angle_between(depth_to_normals(prediction, rays), depth_to_normals(target, rays))
    return (prediction - target).abs(), angles


def error_ratios(expected: Tensor, measured: Tensor, parts: int = 10) -> Tensor:
    """Return the mean measured over the mean expected error, (parts,), for parts of pixels sorted by the latter."""
    expected, measured = _ordered(expected, measured)
    pairs = zip(expected.tensor_split(parts), measured.tensor_split(parts), strict=True)
    return torch.stack([theirs.mean() / own.mean() for own, theirs in pairs])


def squared_error_share(expected: Tensor, measured: Tensor, kept: float = 0.8) -> Tensor:
    """Return the fraction of the sum of squared errors in the ``kept`` pixels with the smallest expected errors, ()."""
    _, measured = _ordered(expected, measured)
    squares = measured.square()
    return squares[: round(kept * len(squares))].sum() / squares.sum()


def ence(expected: Tensor, measured: Tensor, parts: int = 10) -> Tensor:
    """Return the expected normalised calibration error: the mean of |RMSE - RMV| / RMV over equal parts of the pixels.

    RMV is the root of the mean variance: an expected absolute error is a Gaussian's, sqrt(2 / pi) of its deviation.
    """
    expected, measured = _ordered(expected, measured)
    parts = max(1, min(parts, len(expected)))  # a part without a pixel has no mean
    rmv = torch.stack([part.mean() for part in (DEVIATION * expected).square().tensor_split(parts)]).sqrt()
    rmse = torch.stack([part.mean() for part in measured.square().tensor_split(parts)]).sqrt()
    return ((rmse - rmv).abs() / rmv).mean()


def sparsification(expected: Tensor, measured: Tensor, steps: int = STEPS) -> Tensor:
    """Return the mean errors without the t / steps of the pixels with the largest expected errors, (steps + 1,)."""
    expected, measured = _ordered(expected, measured)
    count = len(measured)
    if not count:
        return measured.new_full((steps + 1,), torch.nan)
    of, sizes = expected.unique_consecutive(return_inverse=True, return_counts=True)[1:]
    means = measured.new_zeros(len(sizes)).index_add(0, of, measured) / sizes
    kept = torch.tensor([count - -(-(count - 1) * step // steps) for step in range(steps)], device=measured.device)
    return torch.cat((means[of].cumsum(0)[kept - 1] / kept, measured.new_zeros(1)))


def ause(expected: Tensor, measured: Tensor, steps: int = STEPS) -> Tensor:
    """Return the area between :func:`sparsification` and that of an oracle, relative to the mean error."""
    measured = measured.masked_fill(~expected.isfinite(), torch.nan)
    curve, oracle = sparsification(expected, measured, steps), sparsification(measured, measured, steps)
    return torch.trapezoid((curve - oracle) / curve[0], dx=1 / steps)


def off_auc(expected: Tensor, measured: Tensor, threshold: float = OFF) -> Tensor:
    """Return the area under the ROC curve of expected errors that separate pixels with large errors from the others."""
    expected, measured = _ordered(expected, measured)
    of, sizes = expected.unique_consecutive(return_inverse=True, return_counts=True)[1:]
    off = expected.new_zeros(len(sizes)).index_add(0, of, (measured > threshold).to(expected))
    right = sizes - off
    return (off * (right.cumsum(0) - right / 2)).sum() / (off.sum() * right.sum())


def stated_ratio(expected: Tensor, measured: Tensor) -> Tensor:
    """Return the median expected error over the median measured one."""
    expected, measured = _ordered(expected, measured)
    count = len(expected)
    if not count:
        return expected.new_tensor(torch.nan)
    middle = [(count - 1) // 2, count // 2]  # of an even number the mean of the middle two
    return expected[middle].mean() / measured.sort().values[middle].mean()


def _ordered(expected: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors of pixels that have both, in the order of the expected ones, (N,) float64 each."""
    valid = expected.isfinite() & measured.isfinite()
    expected, measured = expected[valid].double(), measured[valid].double()
    halves = expected.half()
    if expected.device.type == "cpu" and torch.equal(halves.double(), expected) and bool((expected >= 0).all()):
        # expected errors are stored in half precision: sorted by radix, they take a tenth of the time
        bits = halves.abs().view(torch.int16)  # ordered as the numbers are
        order = torch.from_numpy(np.argsort(bits.numpy(), kind="stable"))
    else:
        order = expected.argsort(stable=True)
    return expected[order], measured[order]


@once_per_pair
def depth_calibration(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the comparisons of the expected and the measured errors of depth in metres by name, (B,) each."""
    measured = (pair.prediction - pair.target).abs()
    functions = {"ENCE": ence, "AUSE_d": ause, "AUC_20mm": off_auc, "stated": stated_ratio}
    found = {name: _per_image(each, pair.depth_error, measured, pair.depth_mask) for name, each in functions.items()}
    return {**found, "factor": torch.maximum(found["stated"], 1 / found["stated"])}


def ause_v(pair: SurfacePair) -> Tensor:
    """Return the area under the sparsification error of the normals in degrees, (B,)."""
    return _per_image(ause, pair.angle_error, angle(pair), pair.normal_mask)


def covered(pair: SurfacePair) -> Tensor:
    """Return the fraction of the pixels with a true depth that have a predicted one and its expected error, (B,)."""
    assert pair.depth_error is not None  # noqa: S101 - the metric applies
    return masked_mean(pair.depth_mask & pair.depth_error.isfinite(), pair.target_mask).squeeze(1)


def _per_image(
    compare: Callable[[Tensor, Tensor], Tensor], expected: Tensor | None, measured: Tensor, mask: Tensor
) -> Tensor:
    assert expected is not None  # noqa: S101 - the metric applies
    errors = zip(expected.masked_fill(~mask, torch.nan), measured, strict=True)
    return torch.stack([compare(*each) for each in errors])


_of_depth = partial(of_parts, "Calibration_", depth_calibration, depth_mask, min_size=1, stated="depth_error")
_of_normals = column("AUSE", f"normals, {STEPS} steps", 1, 3)
_covered = partial(Metric, min_size=1, stated="depth_error", regional=True, whole=True)
METRICS: tuple[Metric, ...] = (
    *_of_depth({"ENCE": column("ENCE", "depth, %", 1e2), "AUSE_d": column("AUSE", f"depth, {STEPS} steps", 1, 3)}),
    Metric("Calibration_AUSE_v", ause_v, normal_mask, _of_normals, stated="angle_error"),
    *_of_depth({"AUC_20mm": column("AUC", "off by 20 mm", 1, 3, higher_is_better=True)}, unit="cm"),
    *_of_depth({"stated": MetricFormat("Stated", "of true error", position=None)}),
    *_of_depth({"factor": column("Stated off", "factor", 1, 2)}),
    _covered("Calibration_covered", covered, target_mask, column("Covered", "stated, %", 1e2, higher_is_better=True)),
)
